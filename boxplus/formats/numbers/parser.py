"""Text to numbers at the speed of the disk: one kernel splits a chunk of text into lines and numbers.

A decimal number is w·10^q with an integer w. Where w and 10^|q| are exact in float64, one multiplication or division is
correctly rounded (Clinger 1990). Otherwise the 64 leading bits of w·5^q decide (D. Lemire, "Number parsing at a gigabyte
per second", Softw. Pract. Exp. 51(8), 2021); the few numbers that they leave undecided are handed back to the caller.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

NO_TAG = np.uint8(255)
UNKNOWN_TAG = np.uint8(254)
REAL, INTEGER, OTHER = np.uint8(0), np.uint8(1), np.uint8(2)

LINE = np.dtype(
    [
        ("number", np.uint32),  # of the line within the chunk, from 0
        ("begin", np.uint32),  # offset of its first byte
        ("first", np.uint32),  # index of its first token
        ("count", np.uint32),  # tokens, the tag not counted
        ("tag", np.uint8),
    ],
    align=True,
)

LOWEST_POWER, HIGHEST_POWER = -342, 308
_NONE, _ONE, _THREE = np.uint64(0), np.uint64(1), np.uint64(3)
_TEN = np.uint64(10)
_LOW32 = np.uint64(0xFFFFFFFF)
_S9, _S32, _S52, _S63 = (np.uint64(n) for n in (9, 32, 52, 63))
_TOP = np.uint64(1 << 63)
_IMPLICIT = np.uint64(1 << 52)
_EXACT = np.uint64(1 << 53)
_NINE_BITS = np.uint64(0x1FF)
_NEARLY_ALL = np.uint64((1 << 64) - 2)
_LARGEST_EXACT = 27  # 5^27 is the largest power that fits into 64 bits
_BELOW_IMPLICIT = np.uint64((1 << 52) - 1)
_LARGEST_INTEGER = np.uint64((1 << 63) - 1)
_NEWLINE, _SPACE, _HASH = np.uint8(10), np.uint8(32), np.uint8(35)
_PLUS, _MINUS, _POINT = np.uint8(43), np.uint8(45), np.uint8(46)
_ZERO, _NINE = np.uint8(48), np.uint8(57)
_EXPONENT, _EXPONENT_CAPITAL = np.uint8(101), np.uint8(69)
_MAX_DIGITS = 19  # of an integer that always fits into 64 bits
_EXPONENT_LIMIT = np.int64(100000)
_EXACT_POWER = 22
EXACT_POWERS = 10.0 ** np.arange(_EXACT_POWER + 1)


@functools.cache
def powers_of_five() -> tuple[NDArray[np.uint64], NDArray[np.int64]]:
    """For q from -342 to 308 the 128 leading bits of 5^q, rounded down, and e with 10^q ≈ (upper 64 bits)·2^e.

    Returns:
        (651, 2) uint64, upper and lower bits, and (651,) int64.
    """
    bits, exponents = [], []
    for q in range(LOWEST_POWER, HIGHEST_POWER + 1):
        power = 5 ** abs(q)
        length = power.bit_length()
        if q >= 0:
            leading = power << 128 - length if length <= 128 else power >> length - 128
            exponents.append(length - 64 + q)
        else:
            leading = (1 << 127 + length) // power
            exponents.append(q - 63 - length)
        bits.append((leading >> 64, leading & (1 << 64) - 1))
    return np.array(bits, np.uint64), np.array(exponents, np.int64)


@kernel(inline=True)
def product(x: np.uint64, y: np.uint64) -> tuple[np.uint64, np.uint64]:
    """The high and the low half of the 128-bit product of two 64-bit numbers."""
    a, b = x >> _S32, x & _LOW32
    c, d = y >> _S32, y & _LOW32
    low = b * d
    middle = (low >> _S32) + ((a * d) & _LOW32) + ((b * c) & _LOW32)
    high = a * c + ((a * d) >> _S32) + ((b * c) >> _S32) + (middle >> _S32)
    return high, (middle << _S32) | (low & _LOW32)


@kernel(inline=True)
def long_product(x: np.uint64, power: NDArray[np.uint64]) -> tuple[np.uint64, np.uint64]:
    """The upper 128 of the 192 bits of x times a row of `powers_of_five()`; the true product is larger by less than 2."""
    high, rest = product(x, power[0])
    carry, _ = product(x, power[1])
    low = rest + carry
    return high + (_ONE if low < rest else _NONE), low


@kernel(inline=True)
def float_bits(w: np.uint64, q: np.int64, powers: NDArray[np.uint64], exponents: NDArray[np.int64]) -> np.uint64:
    """The bits of the float64 nearest to w·10^q (w > 0), or 0 where this method cannot tell."""
    if q < LOWEST_POWER or q > HIGHEST_POWER:
        return np.uint64(0)
    shift = np.uint64(0)
    for step in (np.uint64(32), np.uint64(16), np.uint64(8), np.uint64(4), np.uint64(2), np.uint64(1)):
        if w >> (np.uint64(64) - step) == _NONE:
            w <<= step
            shift += step
    slot = np.uint64(q - LOWEST_POWER)
    high, rest = product(w, powers[slot, _NONE])
    if high & _NINE_BITS == _NINE_BITS:
        # The upper 64 bits of the power alone leave open whether a carry reaches the kept bits.
        high, rest = long_product(w, powers[slot])
        if high & _NINE_BITS == _NINE_BITS and rest >= _NEARLY_ALL:
            return np.uint64(0)
    upper = high >> _S63
    cut = _S9 + upper
    mantissa = high >> cut  # 54 bits, the last for rounding
    if rest == _NONE and high == mantissa << cut and 0 <= q <= _LARGEST_EXACT and mantissa & _THREE == _ONE:
        mantissa -= _ONE  # exactly half way: to the even one
    mantissa = (mantissa + _ONE) >> _ONE
    # 52 places of the mantissa, 10 + upper cut off above, 64 for the lower half of the product, 1023 the bias
    biased = np.int64(upper) + exponents[slot] - np.int64(shift) + (52 + 10 + 64 + 1023)
    if mantissa == _EXACT:
        mantissa = _IMPLICIT
        biased += 1
    if biased <= 0 or biased >= 2047:
        return np.uint64(0)
    return np.uint64((mantissa & _BELOW_IMPLICIT) | (np.uint64(biased) << _S52))


@kernel(inline=True)
def _is_digit(byte: np.uint8) -> np.bool_:
    return (byte >= _ZERO) & (byte <= _NINE)


@kernel
def _match_tag(
    text: NDArray[np.uint8], begin: np.uint64, end: np.uint64, tags: NDArray[np.uint8], tag_ends: NDArray[np.uint32]
) -> np.uint8:
    """Index of the tag that stands in text[begin:end]."""
    start = np.uint64(0)
    for k in range(np.uint64(len(tag_ends))):
        stop = np.uint64(tag_ends[k])
        if stop - start == end - begin:
            equal = True
            for m in range(stop - start):
                equal = equal and text[begin + m] == tags[start + m]
            if equal:
                return np.uint8(k)
        start = stop
    return UNKNOWN_TAG


@kernel
def tokenise(
    text: NDArray[np.uint8],
    end: np.uint64,
    tags: NDArray[np.uint8],
    tag_ends: NDArray[np.uint32],
    powers: NDArray[np.uint64],
    exponents: NDArray[np.int64],
    lines: NDArray[np.void],
    values: NDArray[np.float64],
    bits: NDArray[np.uint64],
    integers: NDArray[np.int64],
    kinds: NDArray[np.uint8],
    begins: NDArray[np.uint32],
) -> tuple[np.int64, np.int64]:
    """Split text[:end], whose last byte is a newline, into lines and numbers.

    Lines that begin with # are left out; empty lines are kept, with no tokens.

    Args:
        tags, tag_ends: concatenated words that may stand at the beginning of a line, and where each ends. Where there are
            any, the first word of every line is taken as a tag, and a line of an unknown one gets no tokens.
        powers, exponents: `powers_of_five()`.
        lines: receives the `LINE`s.
        values, integers, kinds, begins: receive for each token its value, its value as an integer (kind `INTEGER`, exact
            up to 64 bits), its kind (`OTHER`: not decided here, perhaps no number) and the offset of its first byte.
        bits: the memory of `values`.

    Returns:
        The numbers of lines and tokens.
    """
    tagged = len(tag_ends) > 0
    at = np.uint64(0)
    number = np.uint64(0)
    found, tokens = np.uint64(0), np.uint64(0)
    while at < end:
        begin = at
        while text[at] <= _SPACE and text[at] != _NEWLINE:
            at += _ONE
        if text[at] == _HASH:
            while text[at] != _NEWLINE:
                at += _ONE
            at += _ONE
            number += _ONE
            continue
        first, tag = tokens, NO_TAG
        if tagged and text[at] != _NEWLINE:
            word = at
            while text[at] > _SPACE:
                at += _ONE
            tag = _match_tag(text, word, at, tags, tag_ends)
            if tag == UNKNOWN_TAG:
                while text[at] != _NEWLINE:
                    at += _ONE
        while True:
            while text[at] <= _SPACE and text[at] != _NEWLINE:
                at += _ONE
            if text[at] == _NEWLINE:
                break
            begins[tokens] = np.uint32(at)
            negative = text[at] == _MINUS
            if negative or text[at] == _PLUS:
                at += _ONE
            w = np.uint64(0)
            digits, significant, fraction = np.int64(0), np.int64(0), np.int64(0)
            while _is_digit(text[at]):
                w = w * _TEN + np.uint64(text[at] - _ZERO)
                digits += 1
                significant += 1 if significant > 0 or w > np.uint64(0) else 0
                at += _ONE
            whole = True
            if text[at] == _POINT:
                whole = False
                at += _ONE
                while _is_digit(text[at]):
                    w = w * _TEN + np.uint64(text[at] - _ZERO)
                    digits += 1
                    fraction += 1
                    significant += 1 if significant > 0 or w > np.uint64(0) else 0
                    at += _ONE
            known = np.bool_(digits > 0 and significant <= _MAX_DIGITS)
            q = -fraction
            if digits > 0 and (text[at] == _EXPONENT or text[at] == _EXPONENT_CAPITAL):
                whole = False
                at += _ONE
                down = text[at] == _MINUS
                if down or text[at] == _PLUS:
                    at += _ONE
                known &= _is_digit(text[at])
                exponent = np.int64(0)
                while _is_digit(text[at]):
                    exponent = min(exponent * 10 + np.int64(text[at] - _ZERO), _EXPONENT_LIMIT)
                    at += _ONE
                q += -exponent if down else exponent
            if text[at] > _SPACE:
                known = np.bool_(False)
                while text[at] > _SPACE:
                    at += _ONE
            kind = OTHER
            if known:
                if w == np.uint64(0):
                    values[tokens] = -0.0 if negative else 0.0
                    kind = REAL
                elif q == 0:
                    values[tokens] = -float(w) if negative else float(w)
                    kind = REAL
                elif w <= _EXACT and -_EXACT_POWER <= q <= _EXACT_POWER:
                    value = float(w)
                    value = value / EXACT_POWERS[np.uint64(-q)] if q < 0 else value * EXACT_POWERS[np.uint64(q)]
                    values[tokens] = -value if negative else value
                    kind = REAL
                else:
                    pattern = float_bits(w, q, powers, exponents)
                    if pattern != np.uint64(0):
                        bits[tokens] = pattern | _TOP if negative else pattern
                        kind = REAL
                if whole and w <= _LARGEST_INTEGER and kind == REAL:
                    integers[tokens] = -np.int64(w) if negative else np.int64(w)
                    kind = INTEGER
            kinds[tokens] = kind
            tokens += _ONE
        line = lines[found]
        line["number"] = np.uint32(number)
        line["begin"] = np.uint32(begin)
        line["first"] = np.uint32(first)
        line["count"] = np.uint32(tokens - first)
        line["tag"] = tag
        found += _ONE
        at += _ONE
        number += _ONE
    return np.int64(found), np.int64(tokens)
