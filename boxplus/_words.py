"""Numbers in sentences: one of a thing, or several; the parts of a vector."""

from __future__ import annotations

from collections.abc import Iterable


def either(count: int, one: str, many: str) -> str:
    """`one` of one, `many` of several and of none."""
    return one if count == 1 else many


def counted(count: int, noun: str) -> str:
    """`1 point`, `3 points`, `0 points`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def signed(values: Iterable[float], digits: int) -> str:
    """`(+0.50, -1.00)`, each with so many digits behind the point."""
    return "(" + ", ".join(f"{value:+.{digits}f}" for value in values) + ")"
