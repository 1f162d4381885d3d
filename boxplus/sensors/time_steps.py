"""Times that step back for good: what a sensor delivers afterwards lies in the past, and is left out until time catches up."""

from __future__ import annotations

from dataclasses import dataclass

_PROOF_NS = 1_000_000_000
"""A stream that has gone on for so long in the past has stepped there; less is samples out of order."""
_MOST_STEPS = 100


@dataclass(slots=True)
class _Step:
    last_ns: int  # newest time before the step
    begin_ns: int  # first and newest time after it
    newest_ns: int

    @property
    def lost_ns(self) -> int:
        return self.newest_ns - self.begin_ns


class TimeSteps:
    """Follows the times of one stream that are rejected as going back.

    Args:
        stream: its name, for the messages.
    """

    def __init__(self, stream: str) -> None:
        self._stream = stream
        self._proven: list[_Step] = []
        self._open: _Step | None = None

    def went_back(self, time_ns: int, last_ns: int) -> None:
        """A sample at `time_ns` came, though one at `last_ns` had been taken."""
        step = self._open
        if step is None or not 0 < time_ns - step.newest_ns < _PROOF_NS:
            self._open = _Step(last_ns, time_ns, time_ns)
            return
        proven_before = step.lost_ns >= _PROOF_NS
        step.newest_ns = time_ns
        if step.lost_ns >= _PROOF_NS and not proven_before and len(self._proven) < _MOST_STEPS:
            self._proven.append(step)

    def went_on(self) -> None:
        """A sample was taken: time has caught up."""
        self._open = None

    def sentences(self) -> list[str]:
        """What is wrong, one sentence for every step."""
        return [
            f"the times of the {self._stream} step back by {(step.last_ns - step.begin_ns) * 1e-9:.3f} s after "
            f"{step.last_ns * 1e-9:.3f} s and go on from there: {step.lost_ns * 1e-9:.1f} s of it are left out; use one clock "
            "that never steps, or split the recording there and run its parts"
            for step in self._proven
        ]
