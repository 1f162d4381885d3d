"""Loop closure as a whole: a block that is driven round, and a real revisit."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.maps.local_maps.registration import Surface, register
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.slam import Pair, Slam
from tests.systems.slam.drives import MappedDrive, ate, mapped_drive

ROUTE = [[20.0, 0.0], [60.0, 0.0], [60.0, 60.0], [0.0, 60.0], [0.0, 0.0], [60.0, 0.0], [60.0, 25.0]]
REVISIT = Path(__file__).resolve().parents[3].parent / "shared" / "data" / "slam" / "lidar_balm_177_revisit" / "scans.npz"


@pytest.fixture(scope="module")
def block() -> MappedDrive:
    return mapped_drive(city(2, 2, seed=5), ROUTE, DriftConfig(channels=24, azimuth_steps=240), seed=5)


def closed(block: MappedDrive, config: SlamConfig | None = None, forbidden: list[Pair] = [], forced: list[Pair] = []) -> Slam:  # noqa: B006
    slam = Slam(config, forbidden=forbidden, forced=forced)
    for local_map in block.maps:
        slam.add(local_map)
    return slam


@pytest.fixture(scope="module")
def slam(block: MappedDrive) -> Slam:
    return closed(block)


@pytest.mark.slow
def test_a_block_driven_round_is_closed(block: MappedDrive, slam: Slam) -> None:
    accepted = [loop for loop in slam.loops if loop.is_accepted]
    assert len(accepted) >= 2
    for loop in accepted:
        assert np.linalg.norm(block.error(loop)[3:]) < 0.25 and block.distance(loop) < 20.0
    drive = block.drive
    corrected = slam.correction().apply(drive.time_ns, drive.T_odo_body)
    truth = drive.T_world_body[:, 4:]
    assert ate(corrected[:, 4:], truth) < 0.6 * ate(drive.T_odo_body[:, 4:], truth)


def test_what_is_refused_says_why(slam: Slam) -> None:
    for loop in slam.loops:
        assert (loop.refusal is None) == (loop.weight > 0.5)
        assert loop.refusal is None or len(loop.refusal) > 10


def test_a_forbidden_loop_is_not_looked_at_and_a_forced_one_is_believed(block: MappedDrive, slam: Slam) -> None:
    pairs = [(loop.query, loop.place) for loop in slam.loops if loop.is_accepted]
    without = closed(block, forbidden=pairs)
    assert not {(loop.query, loop.place) for loop in without.loops} & set(pairs)
    forced = closed(block, SlamConfig(appearance="none", nearby=0.0), forced=pairs[:1])
    assert [(loop.query, loop.place, loop.source, loop.is_accepted) for loop in forced.loops] == [(*pairs[0], "forced", True)]


def test_what_speaks_against_a_forced_loop_is_kept(block: MappedDrive, slam: Slam) -> None:
    """The odometry slipped by 12 m before its query: from where the map has the two the registration comes to rest 11 m off."""
    query, place = next((loop.query, loop.place) for loop in slam.loops if loop.is_accepted)
    jump = np.array([1.0, 0.0, 0.0, 0.0, 7.0, -10.0, 0.0])
    maps = [replace(m, T_odo_map=se3.compose(jump, m.T_odo_map)) if m.number > place + 1 else m for m in block.maps]
    (slipped,) = closed(replace(block, maps=maps), SlamConfig(appearance="none", nearby=0.0), forced=[(query, place)]).loops
    assert slipped.is_accepted and np.linalg.norm(block.error(slipped)[3:]) > 5.0
    assert slipped.objection == "the surfaces determine 4 of 6 directions only"
    (sound,) = closed(block, SlamConfig(appearance="none", nearby=0.0), forced=[(query, place)]).loops
    assert sound.is_accepted and sound.objection is None


def test_without_opencv_places_are_still_found(block: MappedDrive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    nearby = closed(block, SlamConfig(appearance="none"))
    assert any(loop.is_accepted for loop in nearby.loops)
    contexts = closed(block, SlamConfig(appearance="scan_context", nearby=0.0))
    accepted = [loop for loop in contexts.loops if loop.is_accepted]
    assert accepted and all(loop.source == "scan context" for loop in accepted)
    assert all(np.linalg.norm(block.error(loop)[3:]) < 0.25 for loop in accepted)
    with pytest.raises(InputError, match=r"pip install .*opencv"):
        closed(block)


def test_an_odometry_that_claims_too_much_is_doubted(block: MappedDrive, slam: Slam) -> None:
    assert slam.doubt is None
    sure = Slam(SlamConfig(nearby=0.0))
    for local_map in block.maps:
        sure.add(replace(local_map, covariance=0.004 * local_map.covariance))
    assert sure.doubt is not None and "standard deviations from the odometry: it drifts more" in sure.doubt


@pytest.mark.slow
@pytest.mark.parametrize("seed", [12, 26])
def test_with_three_times_the_drift_nothing_is_laid_beside_its_place(seed: int) -> None:
    """Two metres beside the ends of the houses nothing tells where along the street one is, and a loop stayed where the odometry
    had put it. It belongs where they tell, and the odometry does not allow that place."""
    claimed = DriftConfig(channels=24, azimuth_steps=240)
    config = claimed.model_copy(
        update={name: 3.0 * getattr(claimed, name) for name in ("yaw_drift", "tilt_drift", "position_drift")}
    )
    block = mapped_drive(city(2, 2, seed=seed), ROUTE, config, seed)
    slam = closed(block)
    for loop in slam.loops:
        assert not loop.is_accepted or np.linalg.norm(block.error(loop)[3:]) < 0.5
    found = [loop for loop in slam.loops if loop.measured == 6 and min(loop.overlap) > 0.6]
    assert max(np.linalg.norm(block.error(loop)[3:]) for loop in found) < 0.3
    assert slam.doubt is not None and "it drifts more than claimed" in slam.doubt


def test_a_map_without_points_is_a_link_of_the_chain_only(block: MappedDrive) -> None:
    slam, none = Slam(SlamConfig(nearby=0.0)), np.zeros((0, 3), np.float32)
    for local_map in block.maps:
        found = slam.add(local_map if local_map.number != 1 else replace(local_map, points=none))
    assert not any(1 in (loop.query, loop.place) for loop in slam.loops)
    assert any(loop.is_accepted for loop in found)  # the places after it are still found under their numbers


def test_pairs_that_make_no_sense_are_refused(block: MappedDrive) -> None:
    with pytest.raises(InputError, match="the later one first"):
        Slam(forbidden=[(1, 4)])
    with pytest.raises(InputError, match="forbidden or forced"):
        Slam(forbidden=[(4, 1)], forced=[(4, 1)])
    with pytest.raises(InputError, match="local map 0 – got number 1"):
        Slam().add(block.maps[1])
    with pytest.raises(InputError, match="a local map at least"):
        Slam().correction()


@pytest.mark.skipif(not REVISIT.exists(), reason="needs the recorded revisit")
def test_a_recorded_revisit_is_closed_to_centimetres() -> None:
    """Scans that come back after 60 others: registered directly they are 7 cm off the odometry; after closing at most 1.5 cm."""
    data = np.load(REVISIT)
    ends, T = data["start"], data["T_world_lidar_initial"]
    U, _, Vt = np.linalg.svd(T[:, :3, :3])
    poses = np.hstack([quaternion.from_matrix(U @ Vt), T[:, :3, 3]])
    time_ns = np.rint((data["time_s"] - data["time_s"][0]) * 1e9).astype(np.int64)
    scans: list[NDArray[np.float32]] = [
        data_mm.astype(np.float32) * np.float32(0.005) for data_mm in np.split(data["xyz_5mm"], ends[1:-1])
    ]
    builder, slam, maps, zero = LocalMapBuilder(), Slam(), list[LocalMap](), np.zeros((6, 6))
    for k in range(len(poses)):
        maps += builder.push(int(time_ns[k]), poses[k], zero, scans[k])
    maps += builder.flush()
    for local_map in maps:
        slam.add(local_map)
    corrected = slam.correction().apply(time_ns, poses)
    for i, j in ((113, 171), (112, 172)):
        start = se3.compose(se3.inverse(poses[i]), poses[j])
        found = register(Surface.of(scans[j]), Surface.of(scans[i]), start)
        assert found is not None
        before, after = (
            np.linalg.norm(se3.log(se3.compose(se3.inverse(se3.compose(se3.inverse(p[i]), p[j])), found.T_target_source))[3:])
            for p in (poses, corrected)
        )
        assert before > 0.05 and after < 0.015
    # The revisit itself, by the scans of its two local maps; and none of the others is false: each measures what the odometry
    # has, but for the centimetres that it drifted, and what the corrected map has.
    spans = [tuple(np.searchsorted(time_ns, [own.begin_ns, own.end_ns]).tolist()) for own in maps]
    accepted = [loop for loop in slam.loops if loop.is_accepted]
    assert ((169, 176), (106, 117)) in [(spans[loop.query], spans[loop.place]) for loop in accepted]
    for loop in accepted:
        for place, query, drift in (
            (slam._odometry.poses[loop.place], slam._odometry.poses[loop.query], 0.25),
            (slam.T_map[loop.place], slam.T_map[loop.query], 0.05),
        ):
            xi = se3.log(se3.compose(se3.inverse(se3.compose(se3.inverse(place), query)), loop.T_place_query))
            assert np.linalg.norm(xi[3:]) < drift and np.linalg.norm(xi[:3]) < np.deg2rad(0.5)
