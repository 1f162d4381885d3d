"""Numbers in sentences: one of a thing, or several."""

from __future__ import annotations


def either(count: int, one: str, many: str) -> str:
    """`one` of one, `many` of several and of none."""
    return one if count == 1 else many


def counted(count: int, noun: str) -> str:
    """`1 point`, `3 points`, `0 points`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
