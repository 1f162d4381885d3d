"""The target of a calibration: a plane with corners at known places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import shown
from boxplus._numbers import is_finite
from boxplus.errors import InputError


@dataclass(frozen=True, slots=True)
class AprilGrid:
    """Kalibr's grid of AprilTags (Furgale, Rehder and Siegwart, IROS 2013; its wiki, "calibration targets").

    Tags are numbered from the lower left one, row by row. Corner `4 · tag + k` is, for k from 0 to 3, the lower left, lower
    right, upper right and upper left one of a tag. The target's frame has its origin in corner 0, x to the right, y up, z
    towards the viewer.

    Attributes:
        rows, columns: of tags.
        tag_size: edge of a tag [m]. It is the only length there is: every translation of the calibration scales with it.
        spacing: the gap between two tags, as a share of `tag_size`.

    Raises:
        InputError: fewer than one row or column, a length that is not positive.

    Example:
        >>> bp.AprilGrid(rows=6, columns=6, tag_size=0.088, spacing=0.3).corners.shape
        (144, 3)
    """

    rows: int
    columns: int
    tag_size: float
    spacing: float

    def __post_init__(self) -> None:
        if not all(is_finite(n) and int(n) == n and n >= 1 for n in (self.rows, self.columns)):
            raise InputError("at least one row and column of tags", f"{self.rows} x {self.columns}", "check tagRows and tagCols")
        if not (is_finite(self.tag_size) and self.tag_size > 0.0):
            raise InputError("tag_size positive [m]", shown(self.tag_size), "measure the edge of a tag, in metres")
        if not (is_finite(self.spacing) and self.spacing >= 0.0):
            raise InputError("spacing not negative", shown(self.spacing), "give the gap between tags divided by their size")

    @property
    def count(self) -> int:
        """Corners on the target."""
        return 4 * self.rows * self.columns

    @property
    def corners(self) -> NDArray[np.float64]:
        """Places (count, 3) of the corners in the target's frame [m]."""
        tag, corner = np.divmod(np.arange(self.count), 4)
        row, column = np.divmod(tag, self.columns)
        right, up = np.isin(corner, (1, 2)), corner >= 2
        pitch = self.tag_size * (1.0 + self.spacing)
        x, y = column * pitch + right * self.tag_size, row * pitch + up * self.tag_size
        return np.stack([x, y, np.zeros(self.count)], axis=1)

    def describe(self) -> str:
        """Such as `6 x 6 tags of 0.088 m, spacing 0.3`."""
        return f"{self.rows} x {self.columns} tags of {self.tag_size:g} m, spacing {self.spacing:g}"
