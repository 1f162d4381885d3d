"""Do the fixes slide away slowly, or turn, against the odometry? And by how much might they without a word?

A jump shows within seconds. A base station that drifts, or a datum that is turned from somewhere on, bends the map all along, and
nothing stands out; what speaks against it is the odometry alone, as far as its covariance allows no such bend, and as far as the
heading of the map, which nobody knows, does not take it up. Slides along a line over a part of the recording and turns about
the place where they begin are asked what they explain beside all of that (`shifts`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import SingularProblemError
from boxplus.systems.georeference.attachment import AttachedFixes
from boxplus.systems.georeference.shifts import Shift, Shifts

Floats = NDArray[np.float64]

_EDGES = (0.0, 0.25, 0.5, 0.75, 1.0)  # of the recording, where a slide begins and ends
_TURNS = (0.2, 0.35, 0.5, 0.65, 0.8)  # and where a turn begins
_LEAST = 22.0  # by which it lowers the cost: noise that stays for a minute, of some two dozen shapes, comes to 19


@dataclass(frozen=True, slots=True)
class Slide:
    """The slide or turn that explains most.

    Attributes:
        begin, end: since the first fix [s]. size: [m], or with `is_turn` [°], sigma: its standard deviation.
    """

    begin: float
    end: float
    size: float
    sigma: float
    is_turn: bool

    @property
    def text(self) -> str:
        what = f"turn by {self.size:.1f}° (± {self.sigma:.1f}°) from {self.begin:.0f} s on"
        if not self.is_turn:
            what = f"slide by {self.size:.1f} m (± {self.sigma:.1f} m) between {self.begin:.0f} and {self.end:.0f} s"
        return (
            f"fixes {what} against the odometry, which may not drift so by its covariance: their datum or base station wanders, "
            "or the odometry drifts more than it claims; the map is bent between the two"
        )


@dataclass(frozen=True, slots=True)
class Unshown:
    """What the fixes may do without a word, as the odometry may have drifted so: infinite where it holds nothing.

    Attributes:
        slide_m: from the begin to the end, along the worse direction [m]. turn_deg: half way [°].
    """

    slide_m: float
    turn_deg: float


def slide_of(attached: AttachedFixes, shifts: Shifts) -> Slide | None:
    """The slide or turn of the fixes that the odometry contradicts most; None where none is told from noise."""
    seconds = (attached.time_ns - attached.time_ns[0]) * 1e-9
    best: Slide | None = None
    most = _LEAST
    for begin, end, shape in _shapes(seconds, shifts.p_enu):
        shift = _asked(shifts, shape)
        if shift is None or shift.gain < most:
            continue
        most, size = shift.gain, float(np.linalg.norm(shift.size))
        sigma = math.sqrt(float(shift.size @ shift.covariance @ shift.size)) / size
        is_turn = shape.shape[2] == 1
        if is_turn:
            size, sigma = math.degrees(size), math.degrees(sigma)
        best = Slide(begin, end, size, sigma, is_turn)
    return best


def unshown_of(attached: AttachedFixes, shifts: Shifts) -> Unshown:
    """The slide over all of the recording, and the turn half way, that are told only from there on."""
    seconds = (attached.time_ns - attached.time_ns[0]) * 1e-9
    sizes = []
    for shape in (_line(seconds, 0.0, float(seconds[-1])), _turn(seconds, 0.5 * float(seconds[-1]), shifts.p_enu)):
        shift = _asked(shifts, shape)
        sizes.append(math.inf if shift is None else math.sqrt(_LEAST * float(np.linalg.eigvalsh(shift.covariance)[-1])))
    return Unshown(sizes[0], math.degrees(sizes[1]))


def _asked(shifts: Shifts, shape: Floats) -> Shift | None:
    try:
        return shifts.along(shape)
    except SingularProblemError:
        return None


def _shapes(seconds: Floats, p_enu: Floats) -> Iterator[tuple[float, float, Floats]]:
    last = float(seconds[-1])
    for a, b in itertools.combinations(_EDGES, 2):
        yield a * last, b * last, _line(seconds, a * last, b * last)
    for a in _TURNS:
        yield a * last, last, _turn(seconds, a * last, p_enu)


def _line(seconds: Floats, begin: float, end: float) -> Floats:
    """(N, 2, 2) along east and north: none before, all of it after."""
    share = np.clip((seconds - begin) / max(end - begin, 1e-9), 0.0, 1.0)
    return share[:, None, None] * np.eye(2)


def _turn(seconds: Floats, begin: float, p_enu: Floats) -> Floats:
    """(N, 2, 1) per radian, about where the antenna is when it begins."""
    after = seconds > begin
    arm = p_enu - p_enu[min(int(np.argmax(after)), len(p_enu) - 1)]
    return (np.column_stack([-arm[:, 1], arm[:, 0]]) * after[:, None])[:, :, None]
