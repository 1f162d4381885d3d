"""Numbers to text, digit by digit as Python's `repr`: the fewest digits that read back as the same float64.

The 17 leading digits of a float64, and what is behind them, are its product with a power of ten of 128 bits. 15, 16 and 17
digits are tried in turn, with the parser's own conversion back; the few numbers that stay undecided are left to the caller.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.formats.numbers.parser import EXACT_POWERS, LOWEST_POWER, float_bits, long_product

LONGEST_NUMBER = 26
"""Bytes of the longest number, with the space or newline behind it."""

_ZERO64, _ONE, _TEN = np.uint64(0), np.uint64(1), np.uint64(10)
_S52, _S63 = np.uint64(52), np.uint64(63)
_NO_SIGN = np.uint64((1 << 63) - 1)
_FRACTION = np.uint64((1 << 52) - 1)
_IMPLICIT = np.uint64(1 << 52)
_EXACT = np.uint64(1 << 53)
_SEVENTEEN_DIGITS, _EIGHTEEN_DIGITS = np.uint64(10**16), np.uint64(10**17)
_SPACE, _MINUS, _PLUS, _POINT, _ZERO, _E = (np.uint8(ord(c)) for c in " -+.0e")
_DIGITS = np.uint64(20)


@kernel(inline=True)
def _write_digits(w: np.uint64, digits: NDArray[np.uint8]) -> np.uint64:
    """Write the digits of w at the end of `digits`; returns where they begin."""
    at = _DIGITS
    while True:
        at -= _ONE
        digits[at] = _ZERO + np.uint8(w % _TEN)
        w //= _TEN
        if w == _ZERO64:
            return at


@kernel(inline=True)
def _read(
    w: np.uint64,
    q: np.int64,
    powers: NDArray[np.uint64],
    exponents: NDArray[np.int64],
    number: NDArray[np.float64],
    number_bits: NDArray[np.uint64],
) -> np.uint64:
    """The bits of the float64 that the parser makes of w·10^q, 0 where it cannot tell.

    `number` is memory for one, and `number_bits` the same memory.
    """
    if w <= _EXACT and -22 <= q <= 22:
        value = np.float64(w)
        number[0] = value / EXACT_POWERS[np.uint64(-q)] if q < 0 else value * EXACT_POWERS[np.uint64(q)]
        return np.uint64(number_bits[0])
    return np.uint64(float_bits(w, q, powers, exponents))


@kernel
def _fewest_digits(
    bits: np.uint64,
    powers: NDArray[np.uint64],
    exponents: NDArray[np.int64],
    number: NDArray[np.float64],
    number_bits: NDArray[np.uint64],
) -> tuple[np.uint64, np.int64]:
    """17 digits w, the last of them zeros where fewer will do, and E: w·10^(E − 16) reads back as `bits`.

    w is 0 where that is undecided.
    """
    mantissa = ((bits & _FRACTION) | _IMPLICIT) << np.uint64(11)
    binary = np.int64(bits >> _S52) - 1086  # the number is mantissa·2^binary
    decimal = ((binary + 63) * 78913) >> 18  # 78913/2^18 ≈ log10(2); at most one too small
    high, rest, shift, w = _ZERO64, _ZERO64, _ZERO64, _ZERO64
    for _ in range(2):
        slot = np.uint64(16 - decimal - LOWEST_POWER)
        high, rest = long_product(mantissa, powers[slot])
        shift = np.uint64(-(64 + binary + exponents[slot]))
        w = high >> shift
        if w < _EIGHTEEN_DIGITS:
            break
        decimal += 1
    if w < _SEVENTEEN_DIGITS or w >= _EIGHTEEN_DIGITS:
        return _ZERO64, decimal
    fraction = high - (w << shift)
    cut, q = np.uint64(100), decimal - 14
    while cut > _ZERO64:
        shorter = w // cut
        if cut > _ONE:
            tail, half, exact = w - shorter * cut, cut >> _ONE, fraction == _ZERO64 and rest <= _ONE
        else:
            tail, half, exact = fraction, _ONE << (shift - _ONE), rest <= _ONE
        if tail >= half:
            shorter += _ONE
        found = _read(shorter, q, powers, exponents, number, number_bits)
        if found == bits:
            return (_ZERO64 if tail == half and exact else shorter * cut), decimal
        if found == _ZERO64:
            break
        cut //= _TEN
        q -= 1
    return _ZERO64, decimal


@kernel
def _write_number(
    bits: np.uint64,
    text: NDArray[np.uint8],
    at: np.uint64,
    digits: NDArray[np.uint8],
    powers: NDArray[np.uint64],
    exponents: NDArray[np.int64],
    number: NDArray[np.float64],
    number_bits: NDArray[np.uint64],
) -> np.uint64:
    """Write the positive number with these bits at text[at:]; returns the end, or 0 where its digits are undecided."""
    w, decimal = _fewest_digits(bits, powers, exponents, number, number_bits)
    if w == _ZERO64:
        return _ZERO64
    if w == _EIGHTEEN_DIGITS:  # rounding has carried
        w = _SEVENTEEN_DIGITS
        decimal += 1
    first = _write_digits(w, digits)
    last = _DIGITS
    while digits[last - _ONE] == _ZERO and last > first + _ONE:
        last -= _ONE
    if -4 <= decimal < 0:
        text[at] = _ZERO
        text[at + _ONE] = _POINT
        at += np.uint64(2)
        for _ in range(-decimal - 1):
            text[at] = _ZERO
            at += _ONE
        for k in range(first, last):
            text[at] = digits[k]
            at += _ONE
        return at
    plain = 0 <= decimal < 16
    point = first + (np.uint64(decimal) + _ONE if plain else _ONE)
    end = max(last, point + _ONE) if plain else last
    for k in range(first, end):
        if k == point:
            text[at] = _POINT
            at += _ONE
        text[at] = digits[k] if k < last else _ZERO
        at += _ONE
    if not plain:
        text[at] = _E
        text[at + _ONE] = _MINUS if decimal < 0 else _PLUS
        at += np.uint64(2)
        first = _write_digits(np.uint64(abs(decimal)), digits)
        if first + _ONE == _DIGITS:  # two digits at least
            text[at] = _ZERO
            at += _ONE
        for k in range(first, _DIGITS):
            text[at] = digits[k]
            at += _ONE
    return at


@kernel
def format_rows(
    row: np.uint64,
    at: np.uint64,
    prefix: NDArray[np.uint8],
    cells: NDArray[np.uint64],
    is_whole: NDArray[np.bool_],
    separator: np.uint8,
    powers: NDArray[np.uint64],
    exponents: NDArray[np.int64],
    text: NDArray[np.uint8],
    ends: NDArray[np.int64],
    number: NDArray[np.float64],
    number_bits: NDArray[np.uint64],
) -> tuple[np.uint64, np.uint64]:
    """Write the rows from `row` to text[at:], each as prefix, numbers and `separator`.

    Args:
        cells: (m, c) the bits of int64 in the columns that are whole, of float64 in the others.
        ends: (m,) receives where each row ends.
        number, number_bits: the same memory, of one number.

    Returns:
        The row it stopped at, m or the first with a number that it could not decide, and where that one is to begin.
    """
    digits = np.empty(20, np.uint8)
    rows, columns = np.uint64(cells.shape[0]), np.uint64(cells.shape[1])
    for i in range(row, rows):
        begin = at
        for k in range(np.uint64(len(prefix))):
            text[at] = prefix[k]
            at += _ONE
        for k in range(columns):
            cell = cells[i, k]
            negative = cell >> _S63 != _ZERO64
            if negative:
                text[at] = _MINUS
                at += _ONE
            if is_whole[k]:
                first = _write_digits(~cell + _ONE if negative else cell, digits)
                for m in range(first, _DIGITS):
                    text[at] = digits[m]
                    at += _ONE
            else:
                pattern = cell & _NO_SIGN
                exponent = np.int64(pattern >> _S52) - 1023
                if pattern == _ZERO64:
                    text[at] = text[at + np.uint64(2)] = _ZERO
                    text[at + _ONE] = _POINT
                    at += np.uint64(3)
                elif -900 < exponent < 900:
                    end = _write_number(pattern, text, at, digits, powers, exponents, number, number_bits)
                    if end == _ZERO64:
                        return np.uint64(i), begin
                    at = end
                else:
                    return np.uint64(i), begin
            text[at] = _SPACE
            at += _ONE
        text[at - _ONE] = separator
        ends[i] = np.int64(at)
    return rows, at
