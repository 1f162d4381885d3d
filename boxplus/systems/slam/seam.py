"""Do successive local maps fit where the odometry puts them? Where one sees through what the other has, it slipped between.

A loop far from where the odometry puts it is mostly two places that look alike, and says little of a slip. A slip happens at a
place of the way, though, between maps that see the same things: its seam. Of what stands in one of two maps the other one tells
in three ways: it has a surface there, and the point *fits*; it looked through there to what is farther away, and the point is
*contradicted*; or something hides the place, and it says nothing. Towns, decks and storeys that are built alike have no seam:
from map to map everything fits there as anywhere else. Behind a door or a corner little is seen of the map before, but nothing is
seen through either.

A slip tears both ways: each map sees through what stands in the other. What moved along and hid the world, a lorry beside the
sensor, say, stands in one map alone and is seen through by the other one only, and nothing is seen through it.

A slip in the middle of a local map leaves half of it fit the map before, and half the one after. So each map is also held against
the next but one, between which the whole slip lies.

Source: what a beam passed through is free (Hähnel, Triebel, Burgard and Thrun, Map Building with Mobile Robots in Dynamic
Environments, ICRA 2003), here by a buffer of ranges (maps/local_maps/visibility.py). Measured in docs/slam.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._words import counted
from boxplus.manifolds import se3
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.maps.local_maps.registration import Surface, planes_beside, register
from boxplus.maps.local_maps.visibility import directions, nearest_ranges
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.loop import Floats, Loop
from boxplus.systems.slam.odometry_chain import RelativePoses
from boxplus.systems.slam.structure import upright_points

_APART = 2  # numbers of maps that are held against each other: neighbours, and the next but one
_PLANE_WITHIN, _TOLERANCE = 0.8, 0.15  # m: of a plane's points, and of a point that fits from the plane
_REACH = 40.0  # m: beyond, a drift of milliradians moves a point out of its direction
_SPLAT = 0.4  # m: surfaces have no holes for thin things to be seen through
_THROUGH, _THROUGH_M = 0.8, 0.7  # a point is seen through that is nearer than this share of what is behind it, less so much
_FEWEST = 60  # contradicted points
_EITHER, _FEWEST_EITHER = 0.2, 10  # share and points of either map alone that the other one contradicts
_STANDS_OUT, _OF_ONE_SLIP = 4.0, 5  # times the median share of a run, but for the pairs that one slip can tear
_COLLAPSED = 0.4  # of what fits in the run's other pairs of that distance
_KNOWN_M, _KNOWN_RAD = 0.5, 0.05  # standard deviations of the odometry between two maps beyond which it claims too little to slip
_SAME_M = 1.0  # by which a registration moves maps that fit a little beside where they are
_BEARING = 2  # maps on either side of a seam between which loops bear the odometry out


@dataclass(frozen=True, slots=True)
class Seam:
    """Two local maps that contradict each other where the odometry puts them.

    Attributes:
        before, after: their numbers.
        standing: points that stand in either of them, about 6,000 of each looked at.
        fitting, contradicted: those of the later map and those of the earlier one that the other one has a surface at, or saw
            through.
    """

    before: int
    after: int
    standing: int
    fitting: tuple[int, int]
    contradicted: tuple[int, int]

    @property
    def told(self) -> int:
        """Points that stand in either and the other one tells of."""
        return sum(self.fitting) + sum(self.contradicted)

    @property
    def share(self) -> float:
        """Of what stands in either and the other one tells of, what it saw through."""
        return sum(self.contradicted) / max(self.told, 1)

    @property
    def is_mutual(self) -> bool:
        """Whether each map sees through what stands in the other, as after a slip, rather than one of them alone."""
        return all(
            seen >= max(_FEWEST_EITHER, _EITHER * (seen + fitting))
            for seen, fitting in zip(self.contradicted, self.fitting, strict=True)
        )

    @property
    def fitting_share(self) -> float:
        """Of what stands in either, what the other one has too."""
        return sum(self.fitting) / max(self.standing, 1)

    def is_under(self, loop: Loop) -> bool:
        """Whether a loop leads from before it to after it."""
        return loop.place <= self.before and loop.query >= self.after

    def is_apart(self, other: Seam) -> bool:
        """Whether no map is of both: then they are two slips, if they are any."""
        return other.before > self.after or other.after < self.before

    def is_borne_out(self, loops: Sequence[Loop]) -> bool:
        """Whether accepted loops across it say that the odometry is right all the same."""
        across = [
            loop for loop in loops if loop.is_accepted and loop.source != "forced" and loop.measured == 6 and self.is_under(loop)
        ]
        return min(len({loop.place for loop in across}), len({loop.query for loop in across})) >= _BEARING


class Seams:
    """Holds every local map against the two before it.

    Attributes:
        pairs: what they make of each other, in the order of `after`.

    Example:
        `seams = Seams(SlamConfig())`, for every local map `seams.add(local_map, Surface.of(local_map.points), odometry)`, and
        `seams.doubt(loops)` in the end.
    """

    def __init__(self, config: SlamConfig) -> None:
        self._config = config
        self._before: list[_Seen] = []
        self._time_ns: list[int] = []
        self._begin_ns = 0
        self.pairs: list[Seam] = []

    def add(self, local_map: LocalMap, surface: Surface, odometry: RelativePoses) -> None:
        """The next local map, z up, the sensor at its origin; `surface` is that of its points."""
        if not self._time_ns:
            self._begin_ns = local_map.begin_ns
        self._time_ns.append(local_map.time_ns)
        if self._config.seam >= 1.0:
            return
        newest = _Seen.of(local_map.number, surface, self._config)
        for before in reversed(self._before):
            seam = _held_against(before, newest, odometry, self._config)
            if seam is not None:
                self.pairs.append(seam)
        self._before = [*self._before, newest][-_APART:]

    @property
    def torn(self) -> list[Seam]:
        """Pairs of which each contradicts the other, and that hardly fit, beside the other pairs of the run.

        Among leaves or in traffic much is seen through everywhere, and what does not move fits all the same.
        """
        told = sorted(seam.share for seam in self.pairs if seam.told >= _FEWEST)
        others = told[:-_OF_ONE_SLIP]
        least = max(self._config.seam, _STANDS_OUT * float(np.median(others)) if others else 0.0)
        suspects = [seam for seam in self.pairs if sum(seam.contradicted) >= _FEWEST and seam.share >= least]
        usual = {apart: self._usual_fit(apart, set(suspects)) for apart in range(1, _APART + 1)}
        return [
            seam for seam in suspects if seam.is_mutual and seam.fitting_share <= _COLLAPSED * usual[seam.after - seam.before]
        ]

    def _usual_fit(self, apart: int, suspects: set[Seam]) -> float:
        """How much fits in the pairs of one distance that are not suspected; 0 where there are none."""
        shares = [seam.fitting_share for seam in self.pairs if seam.after - seam.before == apart and seam not in suspects]
        return float(np.median(shares)) if shares else 0.0

    def doubt(self, loops: Sequence[Loop]) -> str | None:
        """A sentence on where the odometry slipped; None where it did nowhere, or accepted loops across say otherwise."""
        torn = _not_borne_out(self.torn, loops)
        if not torn:
            return None
        worst = max(torn, key=lambda seam: (seam.share, seam.told))
        from_s, to_s = (1e-9 * (self._time_ns[number] - self._begin_ns) for number in (worst.before, worst.after))
        elsewhere = sum(seam.is_apart(worst) for seam in torn)
        also = f", as it is in {counted(elsewhere, 'pair')} of maps elsewhere" if elsewhere else ""
        return (
            f"the odometry slipped between local maps {worst.before} and {worst.after}, {from_s:.0f} to {to_s:.0f} s after the "
            f"first scan: laid where it puts them, {100.0 * worst.share:.0f} % of what stands in one and the other one tells of "
            f"is seen through{also}; look at the map there, and run what comes before and after by themselves (--start, "
            "--duration): with an IMU 'boxplus map merge' joins the two; where only things moved, --set slam.seam=1 asks no more"
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A local map: what stands in it (N, 3), and the range of what is nearest in every direction from its origin [m]."""

    number: int
    surface: Surface
    standing: NDArray[np.float32]
    ranges: Floats

    @classmethod
    def of(cls, number: int, surface: Surface, config: SlamConfig) -> _Seen:
        ranges = nearest_ranges(*directions(surface.points, np.zeros(3)), _SPLAT)
        return cls(number, surface, upright_points(surface, config.registration), ranges)

    def tells(self, other: _Seen, T_self_other: Floats, config: SlamConfig) -> tuple[int, int]:
        """Of what stands in another map: how many points fit, and how many were seen through."""
        if not len(other.standing) or not len(self.surface.points):
            return 0, 0
        planes, valid = planes_beside(other.standing, self.surface, T_self_other, _PLANE_WITHIN, config.registration)
        fits = valid & (np.abs(planes[:, 3]) <= _TOLERANCE)
        moved = se3.act(T_self_other, other.standing.astype(np.float64)).reshape(-1, 3)
        u, v, r = directions(moved.astype(np.float32), np.zeros(3))
        behind = self.ranges[v, u]
        is_through = np.isfinite(behind) & (r <= _REACH) & (r < _THROUGH * behind - _THROUGH_M)
        # Beams pass through leaves and between bars as well as they hit them.
        is_near = self.surface.tree.nearest(moved[is_through], 1, max_distance=config.registration.near).counts > 0
        return int(fits.sum()), int(np.count_nonzero(~is_near & ~fits[is_through]))


def _held_against(before: _Seen, after: _Seen, odometry: RelativePoses, config: SlamConfig) -> Seam | None:
    """What two maps make of each other where the odometry has them; None where it claims to know little of that."""
    T, S = odometry.between(before.number, after.number)
    rotation, position = (config.odometry_scale * np.sqrt(np.linalg.eigvalsh(own)[-1]) for own in (S[:3, :3], S[3:, 3:]))
    if rotation > _KNOWN_RAD or position > _KNOWN_M:
        return None
    seam = _seam(before, after, T, config)
    if seam.share < config.seam:
        return seam
    # Maps that drift moved by decimetres fit where they are registered, and a slip is out of reach of that.
    found = register(after.surface, before.surface, T, config.registration)
    if found is None or np.linalg.norm(found.T_target_source[4:] - T[4:]) > _SAME_M:
        return seam
    return min(seam, _seam(before, after, found.T_target_source, config), key=lambda own: own.share)


def _seam(before: _Seen, after: _Seen, T_before_after: Floats, config: SlamConfig) -> Seam:
    first = before.tells(after, T_before_after, config)
    second = after.tells(before, se3.inverse(T_before_after), config)
    standing = len(before.standing) + len(after.standing)
    return Seam(before.number, after.number, standing, (first[0], second[0]), (first[1], second[1]))


def _not_borne_out(torn: list[Seam], loops: Sequence[Loop]) -> list[Seam]:
    """Seams that loops do not bear out. One across two that are apart may hold two slips that cancel, and bears neither out."""
    left = [
        seam
        for seam in torn
        if not seam.is_borne_out([own for own in loops if not any(o.is_under(own) and o.is_apart(seam) for o in torn)])
    ]
    return left if len(left) == len(torn) else _not_borne_out(left, loops)
