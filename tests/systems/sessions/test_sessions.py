"""Sessions of simulated drives with unknown start poses: joined where they met, apart where they did not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from boxplus.manifolds import se3
from boxplus.maps.descriptors.config import DescriptorConfig
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.worlds import raycast
from boxplus.simulation.worlds.alike import parallel_corridors
from boxplus.simulation.worlds.world import World
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.session import Session
from boxplus.systems.sessions.sessions import SessionAlignment, align_sessions
from boxplus.systems.slam.config import SlamConfig
from tests.systems.sessions.sessions import driven
from tests.systems.slam.drives import MappedDrive

OUTDOORS = DriftConfig(channels=16, azimuth_steps=240, step_m=2.0)
INDOORS = DriftConfig(
    speed=1.5, step_m=1.0, corner_radius=1.0, height=1.2, max_range=40.0, vertical_fov_deg=(-25.0, 25.0), channels=16
)
QUICK = SessionsConfig(slam=SlamConfig(least_overlap=0.6, rival_fit=0.85, descriptor=DescriptorConfig(candidates=2)))
Sessions = tuple[list[Session], list[MappedDrive]]


@pytest.fixture(scope="module")
def sessions() -> Sessions:
    """Two drives through one street from both ends, and one through another city."""
    world = city(2, 2, seed=5)
    made = [
        driven("monday", world, [[0.0, 0.0], [60.0, 0.0], [60.0, 40.0]], OUTDOORS, 5),
        driven("friday", world, [[60.0, 50.0], [60.0, 0.0], [10.0, 0.0]], OUTDOORS, 6),
        driven("elsewhere", city(2, 2, seed=99), [[60.0, 50.0], [60.0, 0.0], [10.0, 0.0]], OUTDOORS, 7),
    ]
    return [session for session, _ in made], [drive for _, drive in made]


@pytest.fixture(scope="module")
def alignment(sessions: Sessions) -> SessionAlignment:
    return align_sessions(sessions[0], QUICK)


@pytest.mark.slow
def test_sessions_that_met_are_in_one_world(sessions: Sessions, alignment: SessionAlignment) -> None:
    world = alignment.worlds[0]
    assert world.members == (0, 1)
    start = [drive.drive.T_world_body[0] for drive in sessions[1]]
    xi = se3.log(se3.compose(se3.inverse(se3.compose(se3.inverse(start[0]), start[1])), world.T_world_session[1]))
    assert np.linalg.norm(xi[3:]) < 0.3 and np.linalg.norm(xi[:3]) < np.deg2rad(0.5)
    assert xi @ np.linalg.solve(world.covariance[1], xi) < chi2.ppf(0.999, 6)
    truth = se3.compose(np.broadcast_to(se3.inverse(start[0]), sessions[1][1].T_true.shape), sessions[1][1].T_true)
    assert np.linalg.norm(world.T_world_map[1][:, 4:] - truth[:, 4:], axis=1).max() < 0.3


def test_what_it_rests_on_is_told(alignment: SessionAlignment) -> None:
    (meeting,) = [m for m in alignment.meetings if m.refusal is None]
    assert meeting.confirmed >= 0.7 * meeting.predicted > 0
    assert len(meeting.accepted) >= len(alignment.worlds[0].encounters) >= 3
    assert all((loop.refusal is None) == loop.is_accepted for loop in meeting.encounters)


def test_another_city_is_left_apart_and_named(alignment: SessionAlignment) -> None:
    assert [world.members for world in alignment.worlds] == [(0, 1), (2,)]
    why = alignment.why_apart(2)
    assert len(why) == 2 and all(text.startswith("elsewhere and ") and len(text) > 30 for text in why)


@pytest.mark.slow
def test_two_corridors_that_are_the_same_are_not_joined() -> None:
    """What they have in common fits at every door, and turned round."""
    world = parallel_corridors()
    first, _ = driven("first", world, [[-20.0, 0.0], [20.0, 0.0]], INDOORS, 1)
    second, _ = driven("second", world, [[-18.0, 12.0], [22.0, 12.0]], INDOORS, 2)
    alignment = align_sessions([first, second], QUICK)
    assert [world.members for world in alignment.worlds] == [(0,), (1,)]
    assert alignment.meetings[0].T_place_query is None


@pytest.mark.slow
def test_two_stretches_of_one_street_are_not_one() -> None:
    """182 m apart: ground and fronts lie over each other, 60 to 72 % of all points, and seven local maps agree where."""
    solids, few_rays = city(40, 2, seed=5).solids, DriftConfig(channels=16, azimuth_steps=180, step_m=2.0, max_range=45.0)
    sessions = []
    for k in (86, 99):
        first, last = 14.0 * k, 14.0 * k + 40.0
        is_ground = solids[:, raycast.ENCLOSING] > 200.0
        in_sight = (solids[:, raycast.CENTRE] > first - 120.0) & (solids[:, raycast.CENTRE] < last + 120.0)
        world = World(list(solids[is_ground | in_sight]))
        sessions.append(driven(f"drive_{k}", world, [[first, 0.0], [last, 0.0]], few_rays, k, LocalMapConfig(length=6.0))[0])
    found = align_sessions(sessions, QUICK)
    (meeting,) = found.meetings
    assert len(found.worlds) == 2
    assert meeting.refusal is not None and "of what stands upright in one stands at the same place" in meeting.refusal
    assert meeting.confirmed == 7 and meeting.standing < 0.65  # no fit speaks against it


@pytest.mark.slow
def test_how_far_along_a_street_of_even_fronts_is_told_by_all_encounters_together() -> None:
    """Two drives share 26 m of it; their starts lie 14 m apart, and each encounter fits at 11.7 m, where likeness put it."""
    solids, few_rays = city(40, 2, seed=5).solids, DriftConfig(channels=16, azimuth_steps=180, step_m=2.0, max_range=45.0)
    is_near = (solids[:, raycast.ENCLOSING] > 200.0) | (np.abs(solids[:, raycast.CENTRE] - 447.0) < 150.0)
    world = World(list(solids[is_near]))
    sessions = [
        driven(f"drive_{k}", world, [[14.0 * k, 0.0], [14.0 * k + 40.0, 0.0]], few_rays, k, LocalMapConfig(length=6.0))[0]
        for k in (30, 31)
    ]
    (meeting,) = align_sessions(sessions, QUICK).meetings
    assert meeting.refusal is None and meeting.T_place_query is not None and meeting.covariance is not None
    assert abs(meeting.T_place_query[4] - 14.0) < 0.15 and np.sqrt(meeting.covariance[3, 3]) < 0.1
