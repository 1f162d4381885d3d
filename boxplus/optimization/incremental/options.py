"""How closely an incremental problem follows the optimum."""

from __future__ import annotations

from pydantic import Field

from boxplus._settings import Settings


class IncrementalOptions(Settings):
    """Options of `IncrementalProblem`.

    Example:
        >>> bp.IncrementalProblem(tolerance=0.01).options.max_rounds
        3
    """

    tolerance: float = Field(
        0.04, ge=0, description="[standard deviations] residuals whose linearisation is off by more are linearised anew"
    )
    wildfire: float = Field(
        0.02, ge=0, description="[standard deviations] a variable that an update moves by no more stays where it is"
    )
    max_rounds: int = Field(
        3, ge=1, description="eliminations an update makes at most, as long as residuals are off their linearisation"
    )
