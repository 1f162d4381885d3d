"""What an incremental problem tells: what an update did, and where the estimate is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.terms.variables import VariableRows, Variables


@dataclass(frozen=True, slots=True)
class IncrementalUpdate:
    """What an update did.

    Attributes:
        rounds: eliminations.
        relinearized: variables that were linearised anew, in all rounds.
        eliminated: variables that were eliminated anew, in the largest round.
        solved: variables that were solved for, in the largest round.
        waiting: variables with residuals that are off their linearisation, which the next update linearises anew. Where there are
            none, the estimate is at the optimum, up to the thresholds.
    """

    rounds: int
    relinearized: int
    eliminated: int
    solved: int
    waiting: int

    @property
    def is_settled(self) -> bool:
        """Whether no variable waits."""
        return self.waiting == 0


@dataclass(frozen=True, slots=True)
class IncrementalSolution:
    """The estimate at one moment.

    Attributes:
        values: (n, size) of every block; also `solution[block]` and `solution[block[rows]]`.
        cost: ½ Σ ρ(‖r‖²) there, whitened, of all residuals.
        waiting: see `IncrementalUpdate`.
        doubts: what speaks against the values, one sentence each: residuals that no noise explains, a χ² that the standard
            deviations do not promise, residuals that hardly count under a robust loss, Jacobians of one's own that are wrong.
    """

    values: tuple[NDArray[np.float64], ...]
    cost: float
    waiting: int
    doubts: tuple[str, ...] = ()

    def __getitem__(self, selected: Variables | VariableRows) -> NDArray[np.float64]:
        """Values (n, size) of a block, or (k, size) of rows of it."""
        if isinstance(selected, VariableRows):
            return self.values[selected.block.number][selected.rows]
        return self.values[selected.number]
