"""The records of the tree: cliques, and what kernels hand each other."""

from __future__ import annotations

import numpy as np

CLIQUE = np.dtype(
    [
        (name, np.int64)
        for name in (
            "parent",  # clique, 0 for the roots
            "first_child",  # clique, -1 for none
            "next_sibling",
            "mark",  # number of the update that last touched it
            "frontals",  # variables that it eliminates
            "separators",  # variables below, which its ancestors eliminate
            "variables_at",  # first of the frontals and then the separators in the arena of integers
            "width",  # scalar columns
            "below",  # scalar rows below, the right-hand side not counted
            "memory_at",  # first element in the arena of numbers: reciprocals of the diagonal, panel, update matrix
            "panel_at",
            "panel_ld",
            "update_at",
            "update_ld",
        )
    ]
)
"""A clique of the Bayes tree. Record 0 is the parent of all roots; `parent` is -1 where a record is free."""

ROOT, NONE = 0, -1
