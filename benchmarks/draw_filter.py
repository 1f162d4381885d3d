"""What both campaigns choose their seeds by."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Filtered:
    """Words about a seed, a field each."""

    def matches(self, only: dict[str, str]) -> bool:
        """Whether all `only` hold; KeyError names an unknown key."""
        mine = asdict(self)
        return all(mine[key] == value for key, value in only.items())
