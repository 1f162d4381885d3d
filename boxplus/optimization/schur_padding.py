"""How rows of W and Z are padded: to whole vectors, so that no loop over them needs a remainder."""

from __future__ import annotations

VECTOR = 4


def padded(dof: int) -> int:
    """Numbers that a row of `dof` takes."""
    return -(-dof // VECTOR) * VECTOR
