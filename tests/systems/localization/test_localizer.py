"""Starts in a known map that are found and followed, places that are lost and found again, and starts that must not be found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.manifolds import se3
from boxplus.simulation.worlds.alike import parallel_corridors
from boxplus.simulation.worlds.sites import warehouse
from boxplus.simulation.worlds.world import World
from boxplus.simulation.worlds.worlds import yard
from boxplus.systems.localization.config import LocalizationConfig
from boxplus.systems.localization.localizer import Localizer
from boxplus.systems.localization.tracking import Tracker
from tests.systems.localization.days import INDOORS, KnownMap, drive_of, errors, known_map, own_world, push_all

FEW = LocalizationConfig(candidates=5)


@pytest.fixture(scope="module")
def world() -> World:
    return yard(60.0, seed=3)


@pytest.fixture(scope="module")
def place_map(world: World) -> KnownMap:
    return known_map(world, [[-18, 0], [18, 0], [18, 12]], INDOORS, seed=3)


def test_a_start_elsewhere_is_found_and_followed(world: World, place_map: KnownMap) -> None:
    drive = drive_of(world, [[14, 1.5], [0, 1.5]], seed=5)
    localizer = Localizer(place_map, FEW)
    found = push_all(localizer, drive, own_world(drive))
    assert found[0].status == "searching" and found[-1].status == "localised"
    for one in found:
        assert (one.T_map_body is None) == (one.covariance is None) == (one.status == "searching")
    xi = errors(found, drive)
    assert 5 < len(xi) < len(found)
    assert np.linalg.norm(xi[:, 3:], axis=1).max() < 0.1 and np.linalg.norm(xi[:, :3], axis=1).max() < np.deg2rad(1.0)
    covariance = found[-1].covariance
    assert covariance is not None
    assert xi[-1] @ np.linalg.solve(covariance, xi[-1]) < 40.0  # of 6, beyond the 0.999999 quantile
    assert np.sqrt(covariance.diagonal()[3:]).max() < 0.1
    search = localizer.last_search
    assert search is not None and search.verdict == "" and search.candidates[0].refusal is None
    # Scans that the odometry has lost are not looked at, and after two seconds of them nothing is known.
    T, end = own_world(drive)[-1], int(drive.time_ns[-1])
    lost = [localizer.push(end + k * 400_000_000, T, drive.scans[-1], lost=True) for k in range(1, 8)]
    assert all(one.matched is None for one in lost)
    assert lost[-1].status == "searching" and lost[-1].T_map_body is None
    assert localizer.losses == 1 and localizer.doubt is None  # nothing speaks against where it was until then


@pytest.mark.parametrize("is_blind", [False, True])
def test_a_lidar_alone_that_leans_is_found_and_followed(world: World, place_map: KnownMap, is_blind: bool) -> None:
    """Nobody says where up is: surfaces of every query do (the first may show none) while it is looked for, then the map."""
    drive = drive_of(world, [[14, 1.5], [-8, 1.5]], seed=5)
    T_body_lidar = se3.exp([np.radians(15.0), np.radians(-10.0), 0.0, 0.0, 0.0, 0.0])
    back = se3.inverse(T_body_lidar)
    scans = [se3.act(back, scan.astype(np.float64)).astype(np.float32) for scan in drive.scans]
    leaning = replace(drive, scans=scans, T_world_body=se3.compose(drive.T_world_body, T_body_lidar))
    T_odo, localizer, found = se3.compose(back, se3.compose(own_world(drive), T_body_lidar)), Localizer(place_map, FEW), []
    for time_ns, T, scan in zip(drive.time_ns.tolist(), T_odo, scans, strict=True):
        is_lost = is_blind and localizer.last_search is None
        found.append(localizer.push(time_ns, T, scan, None, lost=is_lost))
    xi = errors(found, leaning)
    assert found[-1].status == "localised" and len(xi) > 5
    assert np.linalg.norm(xi[:, 3:], axis=1).max() < 0.1 and np.linalg.norm(xi[:, :3], axis=1).max() < np.deg2rad(1.0)


def test_one_query_that_has_to_be_borne_out_tells_how_much_more_is_asked(world: World, place_map: KnownMap) -> None:
    """A recording that ended just before the second query said only that there had to be one."""
    drive = drive_of(world, [[14, 1.5], [0, 1.5]], seed=5)
    careful = LocalizationConfig(candidates=5, decisive=1e6, query_length=7.0, query_duration=60.0)
    verdicts = [one.search.verdict for one in push_all(Localizer(place_map, careful), drive, own_world(drive)) if one.search]
    assert verdicts[0].endswith("a second query has to agree, of 60 s or 7 m more")


@pytest.mark.parametrize("ratio", [1.01, 0.99])
def test_a_map_of_other_lengths_is_named(world: World, place_map: KnownMap, ratio: float) -> None:
    """A hundredth too long it fits, and once poses in it were given without a word."""
    places = [
        replace(m, points=ratio * m.points, T_odo_map=m.T_odo_map * ([1.0] * 4 + [ratio] * 3)) for m in place_map.local_maps
    ]
    drive = drive_of(world, [[14, 1.5], [-6, 1.5]], seed=5)
    localizer = Localizer(KnownMap(places, np.float32(ratio) * place_map.points), FEW)
    found = push_all(localizer, drive, own_world(drive))
    assert found[-1].T_map_body is not None
    assert localizer.doubt is not None and localizer.doubt.startswith(f"lengths in the map are {ratio:.3f}")
    assert localizer.lengths.log_ratio[0] == pytest.approx(np.log(ratio), abs=0.001)


def test_a_sensor_that_is_carried_away_is_noticed_and_found_again(world: World, place_map: KnownMap) -> None:
    first, second = drive_of(world, [[10, 0], [-1, 0]], seed=6), drive_of(world, [[-16, 0], [-3, 0]], seed=7)
    localizer = Localizer(place_map, FEW)
    before = push_all(localizer, first, own_world(first))
    assert before[-1].status == "localised"
    # The odometry noticed nothing: its poses go on as if the sensor had stayed.
    T_odo = se3.compose(own_world(first)[-1], se3.compose(se3.inverse(second.T_odo_body[0]), second.T_odo_body))
    after = push_all(localizer, second, T_odo, int(first.time_ns[-1]) + 300_000_000)
    statuses = [one.status for one in after]
    assert "searching" in statuses and statuses[-1] == "localised"
    assert "localised" not in statuses[: statuses.index("searching")]
    assert localizer.losses == 1 and localizer.lost_because is not None and "of what stands" in localizer.lost_because
    begin = statuses.index("searching")
    again = errors(after[begin:], replace(second, T_world_body=second.T_world_body[begin:]))
    assert len(again) and np.linalg.norm(again[:, 3:], axis=1).max() < 0.1
    assert localizer.stays.doubt is not None and "from where the odometry has it" in localizer.stays.doubt
    end = after[-1].time_ns + 3_000_000_000
    assert localizer.push(end, T_odo[-1], second.scans[-1]).status == "searching"
    assert localizer.lost_because == "no scan for 3.0 s"


def test_beyond_the_map_is_only_where_nothing_of_it_is_seen_through(world: World, place_map: KnownMap) -> None:
    drive = drive_of(world, [[-16, 0], [-3, 0]], seed=7)
    truth, scan = drive.T_world_body[0], drive.scans[0]
    # Carried away to the other end: what is seen would lie behind the last wall, where the map has nothing.
    elsewhere = truth + np.array([0.0, 0.0, 0.0, 0.0, 52.0, 0.0, 0.0])
    matched = Tracker(place_map, elsewhere, 1e-4 * np.eye(6), LocalizationConfig()).correct(scan, np.eye(3))
    assert not matched.is_mapped and not matched.is_beyond and matched.share < 0.5
    # A map that ends 12 m ahead, and one that begins 40 m ahead: what they have is seen where it is.
    for keep in (place_map.points[:, 0] < -4.0, place_map.points[:, 0] > 24.0):
        part = replace(place_map, points=place_map.points[keep])
        matched = Tracker(part, truth, 1e-4 * np.eye(6), LocalizationConfig()).correct(scan, np.eye(3))
        assert matched.is_beyond or matched.share > 0.5


def test_another_place_is_not_found_and_it_is_said_why(place_map: KnownMap) -> None:
    drive = drive_of(yard(60.0, seed=4), [[14, 1.5], [0, 1.5]], seed=5)
    localizer = Localizer(place_map, FEW)
    assert {one.status for one in push_all(localizer, drive, own_world(drive))} == {"searching"}
    search = localizer.last_search
    assert search is not None and search.verdict
    assert all(candidate.refusal for candidate in search.candidates)


def test_another_warehouse_with_the_same_racks_is_not_taken_for_the_one_of_the_map() -> None:
    place_map = known_map(warehouse(seed=31), [[-10, 0], [6, 0]], INDOORS, seed=31)
    at_once = LocalizationConfig(candidates=4, decisive=1.0, telling=0.05)  # so that nothing else refuses it, nor asks for more
    ends = []
    for seed in (31, 131):
        drive = drive_of(warehouse(seed=seed), [[-8, 0.4], [-2.5, 0.4]], seed=5)
        localizer = Localizer(place_map, at_once)
        ends.append(push_all(localizer, drive, own_world(drive))[-1].status)
    search = localizer.last_search
    assert ends == ["localised", "searching"]
    assert search is not None and search.candidates[0].refusal is None and "place of the same kind" in search.verdict


@pytest.mark.slow
@pytest.mark.parametrize(("lead_margin", "is_told"), [(0.0, True), (0.9, False)])
def test_a_place_is_asked_again_until_it_is_told_from_its_kind(
    world: World, place_map: KnownMap, lead_margin: float, is_told: bool
) -> None:
    config = LocalizationConfig(candidates=5, query_duration=1.5, lead_margin=lead_margin)
    drive = drive_of(world, [[14, 1.5], [2, 1.5]], seed=5)
    localizer = Localizer(place_map, config)
    found = push_all(localizer, drive, own_world(drive))
    begin = next(k for k, one in enumerate(found) if one.T_map_body is not None)
    assert localizer.losses == 0 and "searching" not in [one.status for one in found[begin:]]  # nothing is taken back
    again = [one.time_ns - found[begin].time_ns for one in found[begin + 1 :] if one.search is not None]
    assert bool(again and again[0] < 3e9) != is_told
    assert localizer.kind.is_told == is_told and (localizer.doubt is None) == is_told
    assert is_told or "may be another one of the same kind: over " in str(localizer.doubt)


@pytest.mark.slow
@pytest.mark.parametrize("lean_deg", [1.0, 2.5, -4.0])
def test_a_map_that_leans_is_named(world: World, place_map: KnownMap, lean_deg: float) -> None:
    """Once poses in it were given without a word: registration has all six directions."""
    T_lean = se3.exp(np.radians([0.8 * lean_deg, 0.6 * lean_deg, 0.0, 0.0, 0.0, 0.0]))
    places = [replace(m, T_odo_map=se3.compose(T_lean, m.T_odo_map)) for m in place_map.local_maps]
    points = se3.act(T_lean, place_map.points.astype(np.float64)).astype(np.float32)
    drive = drive_of(world, [[14, 1.5], [0, 1.5]], seed=5)
    T_odo, ends = own_world(drive), []
    for up in ((0.0, 0.0, 1.0), None):  # without an IMU nobody can tell
        localizer = Localizer(KnownMap(places, points), FEW)
        found = push_all(localizer, drive, T_odo, up_odo=up)
        xi = errors(found, replace(drive, T_world_body=se3.compose(T_lean, drive.T_world_body)))
        assert len(xi) > 5 and np.linalg.norm(xi[:, 3:], axis=1).max() < 0.1
        ends.append(localizer.tilt)
    assert np.rad2deg(ends[0].angle) == pytest.approx(abs(lean_deg), abs=0.2) and ends[1].angle == 0.0
    assert (ends[0].doubt is not None) == (abs(lean_deg) > 1.5) and ends[1].doubt is None


@pytest.mark.slow
def test_a_place_that_fits_as_one_alike_does_is_noticed_to_be_another_one() -> None:
    place_map = known_map(warehouse(seed=31), [[-12, 0], [12, 0]], INDOORS, seed=31)
    bay, drive = 2.8, drive_of(warehouse(seed=31), [[-8, 0.4], [-4.5, 0.4]], seed=5)
    after = drive_of(warehouse(seed=31), [[-4.5 + bay, 0.4], [4.5, 0.4]], seed=6)
    # The odometry noticed nothing of a way of one bay, and the racks stand as they did.
    T_odo = se3.compose(own_world(drive)[-1], se3.compose(se3.inverse(after.T_odo_body[0]), after.T_odo_body))
    ends = []
    for recheck_after in (0.0, 0.4):
        config = LocalizationConfig(
            candidates=5, decisive=1.0, query_duration=1.5, recheck_after=recheck_after, recheck_interval=0.5
        )
        localizer = Localizer(place_map, config)
        assert push_all(localizer, drive, own_world(drive))[-1].status == "localised" and localizer.losses == 0
        rows, begin, found, doubts = zip(after.time_ns, T_odo, after.scans, strict=True), int(drive.time_ns[-1]), [], []
        for time_ns, T, scan in rows:
            found.append(localizer.push(begin + 300_000_000 + int(time_ns), T, scan))
            doubts.append(localizer.doubt)
        ends.append([one.status for one in found])
        if recheck_after:  # a recording may end as soon as the first search contradicts
            first = next(k for k, one in enumerate(found) if one.search is not None and one.search.verdict)
            assert localizer.losses == 1 and "searching" not in ends[-1][: first + 1]
            assert "may be" in str(doubts[first])
    assert set(ends[0]) == {"localised"} and "searching" in ends[1]
    assert "localised" not in ends[1][5 : ends[1].index("searching")]  # what is doubted is not claimed
    assert localizer.losses == 1 and "2 times in a row another pose" in str(localizer.lost_because)
    assert localizer.stays.doubt is not None and "another pose" in localizer.stays.doubt


def test_corridors_that_are_alike_are_not_told_apart() -> None:
    world = parallel_corridors(count=2, length=36.0)
    route = [[-19.5, 0], [19.5, 0], [19.5, 12], [-19.5, 12], [-19.5, 2]]
    place_map = known_map(world, route, INDOORS, seed=1)
    drive = drive_of(world, [[-6, 12], [6, 12]], seed=2)
    found = push_all(Localizer(place_map, FEW), drive, own_world(drive))
    xi = errors(found, drive)
    assert not len(xi) or np.linalg.norm(xi[:, 3:], axis=1).max() < 0.5


def test_input_is_checked(place_map: KnownMap) -> None:
    localizer = Localizer(place_map, FEW)
    here = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    localizer.push(10, here, np.zeros((0, 3)))
    with pytest.raises(InputError, match="in order of time"):
        localizer.push(10, here, np.zeros((0, 3)))
    with pytest.raises(InputError, match="shape"):
        localizer.push(20, here, np.zeros((4, 2)))
    with pytest.raises(InputError, match="T_odo_body"):
        localizer.push(20, [2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], np.zeros((0, 3)))
