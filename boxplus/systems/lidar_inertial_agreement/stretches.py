"""What stretches of a run that do not overlap say, each for itself."""

from __future__ import annotations

from typing import Generic, TypeVar

from boxplus.systems.lidar_inertial_agreement.agreement import Agreement

Said = TypeVar("Said")

_OVERLAP_NS = 500_000_000  # of stretches that count as two


class Stretches(Generic[Said]):
    """One after the other.

    Attributes:
        said: by each that counts.
    """

    def __init__(self) -> None:
        self.said: list[Said] = []
        self._until_ns = 0

    def add(self, agreement: Agreement, said: Said) -> None:
        """One more, unless it overlaps the last one."""
        if int(agreement.path.time_ns[0]) > self._until_ns - _OVERLAP_NS:
            self.said.append(said)
            self._until_ns = int(agreement.path.time_ns[-1])
