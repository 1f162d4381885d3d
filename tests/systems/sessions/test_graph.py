"""Sessions in one graph, and which meetings are believed together; no points in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus import residuals
from boxplus.errors import InputError
from boxplus.manifolds import se3
from boxplus.manifolds.se3 import SE3
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.optimization.problem import Problem
from boxplus.runs.sessions.joined import merge_facts
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.encounter import Encounter, Meeting
from boxplus.systems.sessions.graph import join
from boxplus.systems.sessions.session import OwnLoop, Session
from boxplus.systems.sessions.sessions import IN_DOUBT, JointWorld, SessionAlignment, align_sessions, place_sessions, place_surely
from tests.systems.sessions.sessions import drawn, measured

GRAVITY = 0.005


def turned(yaw: float, x: float, y: float, z: float = 0.0) -> NDArray[np.float64]:
    return np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw), x, y, z])


def lane(n: int, yaw: float = 0.0) -> NDArray[np.float64]:
    """Level poses along a bend, 20 m apart, from the origin."""
    poses = [turned(0.0, 0.0, 0.0)]
    for _ in range(n - 1):
        poses.append(se3.compose(poses[-1], turned(yaw, 20.0, 0.0)))
    return np.stack(poses)


A = lane(6, 0.1)
ANCHOR = turned(2.5, 40.0, -30.0, 1.0)
B = se3.compose(np.broadcast_to(se3.inverse(ANCHOR), (4, 7)), A[1:5] + np.array([0.0, 0.0, 0.0, 0.0, 0.3, -0.2, 0.1]))


def met(a: int, b: int, pairs: list[tuple[int, int]], T_a: NDArray[np.float64], T_b: NDArray[np.float64]) -> list[Encounter]:
    """Encounters (place of a, query of b) of two sessions whose maps are at these poses of one world."""
    return [Encounter(a, b, measured(i, j, se3.compose(se3.inverse(T_a[i]), T_b[j]))) for i, j in pairs]


def test_anchors_are_found_from_anywhere_and_a_false_encounter_is_left_out() -> None:
    world_b = se3.compose(np.broadcast_to(ANCHOR, B.shape), B)
    encounters = met(0, 1, [(1, 0), (2, 1), (3, 2), (4, 3)], A, world_b)
    wrong = replace(encounters[0].loop, T_place_query=turned(0.4, 3.0, 5.0))
    start = np.stack([turned(0.0, 0.0, 0.0), turned(2.0, 30.0, -20.0)])
    graph = join([drawn("a", A), drawn("b", B)], [*encounters, Encounter(0, 1, wrong)], start, GRAVITY)
    assert graph.is_kept.tolist() == [True] * 4 + [False]
    np.testing.assert_allclose(SE3.boxminus(graph.T_world_session[1], ANCHOR), 0.0, atol=1e-6)
    np.testing.assert_allclose(graph.T_world_map[1], world_b, atol=1e-6)
    np.testing.assert_allclose(graph.T_world_session[0], turned(0.0, 0.0, 0.0), atol=1e-12)
    assert not graph.covariance[0].any() and (np.linalg.eigvalsh(graph.covariance[1]) > 0).all()


def test_the_covariance_of_an_anchor_is_that_of_the_first_pose_in_a_graph_without_anchors() -> None:
    """The same measurements with every pose in the world: the anchor's covariance is that of the session's held first pose."""
    a, b = drawn("a", A), drawn("b", B)
    world_b = se3.compose(np.broadcast_to(ANCHOR, B.shape), B)
    encounters = met(0, 1, [(1, 0), (3, 2), (4, 3)], A, world_b)
    graph = join(
        [a, b], encounters, np.stack([turned(0.0, 0.0, 0.0), ANCHOR]), 1e4
    )  # no vertical, which anchors have their own of
    problem = Problem()
    x = problem.add_variables(SE3, np.concatenate([A, world_b]))
    steps = np.array([0, 1, 2, 3, 4, 6, 7, 8])
    poses = np.concatenate([A, world_b])
    covariance = np.stack([a.maps[1].covariance] * len(steps))
    step = residuals.RelativePose(se3.compose(se3.inverse(poses[steps]), poses[steps + 1]), covariance=covariance)
    problem.add_residuals(step, x[steps], x[steps + 1])
    for e in encounters:
        problem.add_residuals(
            residuals.RelativePose([e.loop.T_place_query], covariance=e.loop.covariance), x[[e.loop.place]], x[[6 + e.loop.query]]
        )
    problem.fix(x[0:1])
    free = problem.solve().covariance(x[[6]])[0]
    Ad = se3.adjoint(B[0])
    np.testing.assert_allclose(graph.covariance[1], Ad @ free @ Ad.T, rtol=1e-6, atol=1e-12)


def test_the_way_to_the_first_map_is_part_of_what_a_frame_is_off_by() -> None:
    """A session's frame is where it began; encounters tell where its maps are, and the odometry drifted on the way to these."""

    def later(session: Session, way: float) -> Session:
        return replace(session, maps=[replace(m, path_m=m.path_m + way) for m in session.maps])

    a, b = drawn("a", A), drawn("b", B)
    encounters = met(0, 1, [(1, 0), (3, 2), (4, 3)], A, se3.compose(np.broadcast_to(ANCHOR, B.shape), B))
    start = np.stack([turned(0.0, 0.0, 0.0), ANCHOR])
    without, with_it = (join([later(a, way), later(b, 2 * way)], encounters, start, 1e4).covariance[1] for way in (0.0, 10.0))
    own = a.maps[1].covariance / 20.0  # of a metre of way
    to_b, to_a = se3.adjoint(B[0]), se3.adjoint(se3.compose(se3.inverse(ANCHOR), A[0]))
    expected = without + 20.0 * to_b @ own @ to_b.T + 10.0 * to_a @ own @ to_a.T
    np.testing.assert_allclose(with_it, expected, rtol=1e-5, atol=1e-10)


@pytest.mark.parametrize("way", [2.0, 10.0])
def test_a_session_of_one_map_is_as_uncertain_as_the_settings_say_of_its_way(way: float) -> None:
    a, b = drawn("a", A), drawn("b", B[:1])
    encounters = met(0, 1, [(1, 0)], A, se3.compose(ANCHOR[None], B[:1]))
    start = np.stack([turned(0.0, 0.0, 0.0), ANCHOR])
    later = Session.of("b", [replace(b.maps[0], path_m=way)])
    without, with_it = (join([a, session], encounters, start, 1e4).covariance[1] for session in (b, later))
    to_b, settings = se3.adjoint(B[0]), LocalMapConfig()
    own = np.diag(np.repeat([settings.drift_rotation**2, settings.drift_position**2], 3)) * way
    np.testing.assert_allclose(with_it, without + to_b @ own @ to_b.T, rtol=1e-5, atol=1e-10)


def test_own_loops_hold_a_session_together() -> None:
    stiff = np.linalg.inv(np.diag(np.repeat([1e-8, 1e-6], 3)))
    bent = lane(6, 0.1)
    moved = [*met(0, 1, [(0, 0), (1, 1), (5, 5)], A, bent)]
    pulled = replace(moved[2].loop, T_place_query=se3.compose(moved[2].loop.T_place_query, turned(0.0, 0.08, 0.0)))
    moved[2] = replace(moved[2], loop=pulled)
    start = np.stack([turned(0.0, 0.0, 0.0)] * 2)

    def length(loops: list[OwnLoop]) -> float:
        graph = join([drawn("a", A, loops), drawn("b", bent, loops)], moved, start, GRAVITY)
        return float(np.linalg.norm(graph.T_world_map[1][5, 4:] - graph.T_world_map[1][0, 4:]))

    rigid = float(np.linalg.norm(A[5, 4:] - A[0, 4:]))
    assert abs(length([OwnLoop(5, 0, stiff)]) - rigid) < 0.002 < abs(length([]) - rigid)


def meeting(a: int, b: int, T_a_b: NDArray[np.float64], T: list[NDArray[np.float64]], count: int = 4) -> Meeting:
    """Two drawn sessions that met at `count` places, T_a_b of their frames."""
    there = se3.compose(np.broadcast_to(T_a_b, T[b].shape), T[b])
    loops = [e.loop for e in met(a, b, [(k, k) for k in range(count)], T[a], there)]
    return Meeting(a, b, loops, T_a_b, np.diag(np.repeat([1e-6, 1e-4], 3)))


def test_sessions_meet_through_others_and_those_that_met_nobody_stay_apart() -> None:
    T = [A, A, A, A]
    sessions = [drawn(name, poses) for name, poses in zip("abcd", T, strict=True)]
    found = [meeting(0, 2, turned(1.0, 5.0, 0.0), T), meeting(2, 1, turned(0.5, 0.0, 7.0), T)]
    found.append(Meeting(0, 3, [], refusal="no local map of one looks like one of the other"))
    alignment = place_sessions(sessions, found, SessionsConfig())
    assert [world.members for world in alignment.worlds] == [(0, 1, 2), (3,)]
    expected = se3.compose(turned(1.0, 5.0, 0.0), turned(0.5, 0.0, 7.0))
    np.testing.assert_allclose(SE3.boxminus(alignment.worlds[0].T_world_session[1], expected), 0.0, atol=1e-6)
    assert alignment.why_apart(3) == ["d and a: no local map of one looks like one of the other"]


def test_a_meeting_that_contradicts_others_is_refused() -> None:
    T = [A, A, A]
    sessions = [drawn(name, poses) for name, poses in zip("abc", T, strict=True)]
    found = [meeting(0, 1, turned(0.0, 5.0, 0.0), T), meeting(1, 2, turned(0.0, 5.0, 0.0), T)]
    found.append(meeting(0, 2, turned(0.0, 30.0, 0.0), T, count=3))
    alignment = place_sessions(sessions, found, SessionsConfig())
    assert [world.members for world in alignment.worlds] == [(0, 1, 2)]
    assert [m.refusal is None for m in alignment.meetings] == [True, True, False]
    assert "standard deviations from where other sessions put the two" in str(alignment.meetings[2].refusal)
    np.testing.assert_allclose(alignment.worlds[0].T_world_session[2], turned(0.0, 10.0, 0.0), atol=1e-6)


def test_where_nobody_can_be_asked_what_only_a_doubt_joins_stays_apart() -> None:
    """And what met it soundly goes along; a doubt between two that sound meetings join through others costs nothing."""
    T = [A] * 5
    sessions = [drawn(name, poses) for name, poses in zip("abcde", T, strict=True)]
    doubt = "are at two places of a kind, perhaps"
    step = turned(0.0, 5.0, 0.0)
    found = [meeting(k, k + 1, step, T) for k in range(4)] + [meeting(0, 2, turned(0.0, 10.0, 0.0), T)]
    found[2], found[4] = replace(found[2], doubt=doubt), replace(found[4], doubt=doubt)
    assert [world.members for world in place_sessions(sessions, found, SessionsConfig()).worlds] == [(0, 1, 2, 3, 4)]
    alignment = place_surely(sessions, found, SessionsConfig())
    assert [world.members for world in alignment.worlds] == [(0, 1, 2), (3, 4)]
    assert alignment.why_apart(3) == [f"d and c: {IN_DOUBT}the two {doubt}"]
    assert [m.refusal is None for m in alignment.meetings] == [True, True, False, True, True]
    assert alignment.doubtful_joins(0) == {}


def test_what_makes_no_session_is_refused() -> None:
    a = drawn("a", A)
    with pytest.raises(InputError, match="local maps 0, 1, … of session b"):
        Session.of("b", a.maps[1:])
    with pytest.raises(InputError, match="6 poses, one for each local map"):
        Session.of("b", a.maps, A[:3])
    with pytest.raises(InputError, match="loops between local maps of b"):
        Session.of("b", a.maps, A, [OwnLoop(0, 3, np.eye(6))])
    with pytest.raises(InputError, match="of different names"):
        align_sessions([a, drawn("a", A)])
    with pytest.raises(InputError, match="two sessions at least"):
        align_sessions([a])


@pytest.mark.parametrize("scale", [1.0, 0.99, 0.9945, 1.0055, 1.01])
def test_a_session_of_another_scale_is_named(scale: float) -> None:
    """Encounters are where both sessions truly are; the steps of one are too long, as its LiDAR's ranges are."""
    T = lane(10, 0.1)
    stretched = T.copy()
    stretched[:, 4:] *= scale
    encounters = [Encounter(0, 1, measured(k, k, turned(0.0, 0.0, 0.0), 0.2)) for k in range(10)]
    start = np.stack([turned(0.0, 0.0, 0.0)] * 2)
    sessions = [drawn("a", T), drawn("b", stretched)]
    graph = join(sessions, encounters, start, GRAVITY)
    fits, sigma = graph.scale[1]
    assert graph.is_kept.all() and fits == pytest.approx(1.0 / scale, abs=2e-4) and 1e-4 < sigma < 5e-3
    np.testing.assert_array_equal(graph.scale[0], [1.0, 0.0])
    world = JointWorld((0, 1), graph.T_world_session, graph.covariance, graph.T_world_map, encounters, graph.scale)
    summary = merge_facts(SessionAlignment(sessions, [world], []), ["a", "b"], [None, None])
    assert len(summary.doubts) == (abs(scale - 1.0) > 0.006) and len(summary.warnings) == (0.0 < abs(scale - 1.0) < 0.006)
    told = [*summary.doubts, *summary.warnings]
    assert all("b has another scale" in text and f"times {fits:.4f}" in text for text in told)
