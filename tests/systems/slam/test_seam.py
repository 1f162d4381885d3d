"""Whether successive local maps fit where the odometry puts them: what one sees through in the other is a slip between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.maps.local_maps.registration import Surface
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.worlds.alike import estates
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.loop import Loop
from boxplus.systems.slam.odometry_chain import OdometryChain
from boxplus.systems.slam.seam import Seam, Seams
from boxplus.systems.slam.slam import Slam
from tests.systems.slam.drives import MappedDrive, mapped_drive

Points = NDArray[np.float32]

HERE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
ASIDE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 6.0, 0.0])
ROUTE = [[20.0, 0.0], [60.0, 0.0], [60.0, 60.0], [0.0, 60.0], [0.0, 0.0], [60.0, 0.0], [60.0, 25.0]]


def street(seed: int = 1, begin: float = -15.0, end: float = 15.0, aside: float = 0.0) -> Points:
    """The ground, fronts at y = 5 and -9 m with a porch each, moved aside; the sensor stands at the origin."""
    random = np.random.default_rng(seed)
    parts = [np.column_stack([random.uniform(-20.0, 20.0, (6000, 2)), np.full(6000, -1.8)])]
    for y in (5.0, -9.0):
        n = int(200 * (end - begin))
        x = random.uniform(begin, end, n)
        parts.append(np.column_stack([x, y - 1.5 * np.sign(y) * ((x > 3.0) & (x < 6.0)), random.uniform(-1.8, 2.0, n)]))
    points = np.concatenate(parts)
    points[:, 1] += aside
    return points.astype(np.float32)


def chain(parts: Sequence[Points], poses: Sequence[NDArray[np.float64]], sigma: float = 0.05) -> list[LocalMap]:
    covariance = np.diag(np.repeat([0.002, sigma], 3) ** 2)
    return [
        LocalMap(k, 10**9 * (5 * k + 2), 10**9 * 5 * k, 10**9 * 5 * (k + 1), T, covariance, 20.0 * k, points, 20)
        for k, (points, T) in enumerate(zip(parts, poses, strict=True))
    ]


def seams_of(maps: Sequence[LocalMap], config: SlamConfig | None = None) -> Seams:
    seams, odometry = Seams(config or SlamConfig()), OdometryChain()
    for local_map in maps:
        odometry.add(local_map)
        seams.add(local_map, Surface.of(local_map.points), odometry)
    return seams


def loop(place: int, query: int, measured: int = 6) -> Loop:
    return Loop(query, place, "appearance", 9, HERE, HERE, np.eye(6), np.eye(6), measured=measured, weight=1.0)


def test_maps_that_fit_have_no_seam() -> None:
    seams = seams_of(chain([street(1), street(2), street(3)], [HERE, HERE, HERE]))
    assert seams.torn == [] and seams.doubt([]) is None


def test_a_slip_between_two_maps_is_seen_through() -> None:
    seams = seams_of(chain([street(k) for k in range(4)], [HERE, ASIDE, ASIDE, ASIDE]))
    assert [(seam.before, seam.after) for seam in seams.torn] == [(0, 1), (0, 2)]
    text = seams.doubt([])
    assert text is not None and text.startswith("the odometry slipped between local maps 0 and ")
    assert "s after the first scan" in text and "--start" in text and "elsewhere" not in text


def test_a_slip_in_the_middle_of_a_map_shows_between_the_maps_beside_it() -> None:
    """Its first half fits the map before, its second half the one after; its frame stands where the slip has been already."""
    torn = np.concatenate([street(2, end=0.0, aside=-6.0), street(3, begin=0.0)])
    parts = [street(0), street(1), torn, street(4), street(5)]
    seams = seams_of(chain(parts, [HERE, HERE, ASIDE, ASIDE, ASIDE]))
    worst = max(seams.torn, key=lambda seam: seam.share)
    assert (worst.before, worst.after) == (1, 3) and worst.share > 0.8
    text = seams.doubt([])
    assert text is not None and "between local maps 1 and 3, 7 to 17 s after the first scan" in text


def test_slips_at_two_places_are_both_counted() -> None:
    parts = [street(k) for k in range(6)]
    text = seams_of(chain(parts, [HERE, ASIDE, ASIDE, ASIDE, HERE, HERE])).doubt([])
    assert text is not None and "of maps elsewhere" in text


def test_where_one_sees_through_everything_everywhere_no_pair_stands_out() -> None:
    """Among things that move, say: every map is another one's contradiction."""
    poses = [np.array([1.0, 0.0, 0.0, 0.0, 0.0, 6.0 * (k % 3), 0.0]) for k in range(12)]
    seams = seams_of(chain([street(k) for k in range(12)], poses))
    assert max(seam.share for seam in seams.pairs) > 0.8 and seams.torn == []


def test_things_that_move_leave_the_rest_to_fit() -> None:
    """A lorry alongside in one map, say."""
    random = np.random.default_rng(9)
    lorry = np.column_stack([random.uniform(-7.0, 7.0, 900), np.full(900, -3.0), random.uniform(-1.5, 2.0, 900)])
    parts = [np.concatenate([street(k), lorry.astype(np.float32)]) if k == 4 else street(k) for k in range(9)]
    seams = seams_of(chain(parts, [HERE] * 9), SlamConfig(seam=0.05))
    assert max(sum(seam.contradicted) for seam in seams.pairs) > 100 and seams.torn == []


def alongside(seed: int) -> Points:
    """Lorries on both sides for a whole map: nothing but them and the ground is seen."""
    random = np.random.default_rng(seed)
    parts = [np.column_stack([random.uniform(-20.0, 20.0, (6000, 2)), np.full(6000, -1.8)])]
    for y in (2.5, -2.5):
        parts.append(np.column_stack([random.uniform(-15.0, 15.0, 6000), np.full(6000, y), random.uniform(-1.7, 2.0, 6000)]))
    return np.concatenate(parts).astype(np.float32)


def test_what_moves_along_and_hides_the_rest_is_contradicted_one_way_only() -> None:
    seams = seams_of(chain([alongside(k) if k == 4 else street(k) for k in range(9)], [HERE] * 9))
    hidden = [seam for seam in seams.pairs if 4 in (seam.before, seam.after)]
    usual = np.median([seam.fitting_share for seam in seams.pairs if seam not in hidden])
    assert min(seam.share for seam in hidden) > 0.5 and max(seam.fitting_share for seam in hidden) < 0.2 * usual
    assert {min(seam.contradicted) for seam in hidden} == {0} and seams.doubt([]) is None


def test_what_lies_behind_a_wall_says_nothing() -> None:
    """As behind a door or a corner: hardly anything of the map before is seen again, and nothing is seen through."""
    next_room = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 30.0, 0.0])
    assert seams_of(chain([street(1), street(2)], [HERE, next_room])).torn == []


def test_drift_of_some_decimetres_is_no_slip() -> None:
    a_little = np.array([1.0, 0.0, 0.0, 0.0, 0.1, 0.4, 0.0])
    assert seams_of(chain([street(1), street(2)], [HERE, a_little])).torn == []


def test_an_odometry_that_claims_little_is_not_asked() -> None:
    """It began anew after a gap, say."""
    assert seams_of(chain([street(1), street(2)], [HERE, ASIDE], sigma=1.0)).torn == []
    assert seams_of(chain([street(1), street(2)], [HERE, ASIDE]), SlamConfig(seam=1.0)).torn == []


def test_a_map_without_points_says_nothing() -> None:
    none = np.zeros((0, 3), np.float32)
    assert seams_of(chain([none, street(1), none, none], [HERE, HERE, ASIDE, ASIDE])).torn == []


def test_accepted_loops_across_a_seam_bear_the_odometry_out() -> None:
    seam = Seam(5, 7, 2000, (4, 6), (100, 200))
    assert seam.share == pytest.approx(300 / 310)
    assert seam.is_borne_out([loop(4, 20), loop(5, 21)])
    for loops in (
        [],
        [loop(4, 20)],
        [loop(4, 20), loop(4, 21)],
        [loop(4, 20), loop(6, 21)],
        [loop(4, 6), loop(5, 21)],
        [loop(4, 20, measured=5), loop(5, 21)],
        [loop(4, 20), replace(loop(5, 21), source="forced")],
        [loop(4, 20), replace(loop(5, 21), weight=0.0)],
    ):
        assert not seam.is_borne_out(loops)
    seams = seams_of(chain([street(k) for k in range(3)], [HERE, ASIDE, ASIDE]))
    assert seams.torn and seams.doubt([loop(0, 1), loop(0, 2)]) is not None  # of one place
    seams = seams_of(chain([street(k) for k in range(5)], [HERE, HERE, HERE, ASIDE, ASIDE]))
    assert seams.doubt([]) is not None and seams.doubt([loop(0, 4), loop(1, 5)]) is None


def test_loops_across_two_seams_bear_neither_out_as_slips_may_cancel() -> None:
    seams = seams_of(chain([street(k) for k in range(12)], [ASIDE if 4 <= k < 8 else HERE for k in range(12)]))
    assert {(seam.before, seam.after) for seam in seams.torn} >= {(3, 4), (7, 8)}
    round_both = [loop(0, 10), loop(1, 11)]
    text = seams.doubt(round_both)
    assert text is not None and "of maps elsewhere" in text
    # One that is borne out by itself leaves the other one alone under the loops round both.
    assert seams.doubt([*round_both, loop(4, 10), loop(5, 11)]) is None


def slipped(drive: MappedDrive, first: int, by: Sequence[float]) -> list[LocalMap]:
    jump = np.array([1.0, 0.0, 0.0, 0.0, *by])
    return [replace(m, T_odo_map=se3.compose(jump, m.T_odo_map)) if m.number >= first else m for m in drive.maps]


def closed(maps: Sequence[LocalMap]) -> Slam:
    slam = Slam()
    for local_map in maps:
        slam.add(local_map)
    return slam


@pytest.mark.slow
@pytest.mark.parametrize("metres", [0.0, 8.0, 20.0])
def test_a_drive_round_a_block_whose_odometry_slips_is_in_doubt_and_a_sound_one_is_not(metres: float) -> None:
    """Half way; no loop is within reach of the odometry any more, and none says a word by itself."""
    drive = mapped_drive(city(2, 2, seed=7003), ROUTE, DriftConfig(channels=24, azimuth_steps=240), seed=7003)
    doubt = closed(slipped(drive, 7, [0.8 * metres, -0.6 * metres, 0.0])).doubt
    assert (doubt is not None) == (metres > 0.0)
    assert doubt is None or doubt.startswith(
        ("the odometry slipped between local maps 5 and 7", "the odometry slipped between local maps 6 and")
    )


@pytest.mark.slow
def test_two_estates_that_are_built_alike_are_no_slip() -> None:
    route = [[0, 0], [60, 0], [60, 60], [0, 60], [0, 0], [180, 0], [240, 0], [240, 60], [180, 60], [180, 0], [200, 0]]
    drive = mapped_drive(estates(seed=3), route, DriftConfig(channels=24, azimuth_steps=240), seed=3)
    slam = closed(drive.maps)
    alike = [loop for loop in slam.loops if loop.refusal is not None and loop.place < 12 and loop.query > 20]
    assert len(alike) >= 3  # of the other estate, and refused
    assert slam.doubt is None
