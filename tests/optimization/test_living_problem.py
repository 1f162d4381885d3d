"""A problem to which variables and residuals come and go: what stays is what a problem built afresh would be."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus import SE3, Euclidean, InputError, Problem
from boxplus.manifolds import se3
from boxplus.residuals import Prior, RelativePose
from tests.optimization.conftest import make_ring, make_scene

NOISE = 0.05


def edges_between(rng, truth, i, j):
    return SE3.boxplus(se3.compose(se3.inverse(truth[i]), truth[j]), NOISE * rng.standard_normal((len(i), 6)))


@settings(max_examples=20, deadline=None)
@given(
    st.integers(0, 10**6), st.lists(st.sampled_from(["extend", "remove poses", "remove edges", "fix"]), min_size=1, max_size=8)
)
def test_any_sequence_of_changes_ends_as_a_problem_built_afresh(seed, steps):
    rng = np.random.default_rng(seed)
    truth = SE3.random(rng, 60)
    problem = Problem()
    poses = problem.add_variables(SE3, truth[:4], name="poses")
    alive, fixed = list(range(4)), {0}
    problem.fix(poses[0])
    kept = {}  # group name: (group, i, j, measured, alive mask)

    def connect(name, ids):
        i, j = np.array([(a, b) for a in ids for b in alive if a != b][: 3 * len(ids) + 3]).T
        Z = edges_between(rng, truth, i, j)
        group = problem.add_residuals(RelativePose(Z, sigma=NOISE), poses[i], poses[j], name=name)
        kept[name] = [group, i, j, Z, np.ones(len(i), dtype=bool)]

    connect("0", alive[:])
    for n, step in enumerate(steps, start=1):
        if step == "extend":
            fresh = problem.extend(poses, truth[poses.next_id : poses.next_id + 2])
            alive += fresh.ids.tolist()
            connect(str(n), fresh.ids.tolist())
        elif step == "fix":
            k = int(rng.choice(alive))
            fixed.add(k)
            problem.fix(poses[k])
        elif step == "remove poses" and len(alive) > 3:
            gone = rng.choice(alive[1:], 2, replace=False)
            problem.remove(poses[gone])
            alive = [k for k in alive if k not in gone]
            for own in kept.values():
                own[4] &= ~np.isin(own[1], gone) & ~np.isin(own[2], gone)
        elif step == "remove edges":
            name = str(rng.choice([own for own, group in kept.items() if group[4].any()] or ["0"]))
            group, chosen = kept[name][0], rng.random(len(kept[name][4])) < 0.4
            if any(group is own for own in problem.groups):
                problem.remove(group[chosen])
                kept[name][4] &= ~chosen
    assert poses.ids.tolist() == alive
    assert {g.name for g in problem.groups} == {name for name, own in kept.items() if own[4].any()}
    if not problem.groups or set(alive) <= fixed:
        return
    fresh = Problem()
    place = {k: n for n, k in enumerate(alive)}
    rows = fresh.add_variables(SE3, truth[alive], name="poses")
    fresh.fix(rows[[place[k] for k in fixed if k in place]])
    for name, (_, i, j, Z, there) in kept.items():
        if there.any():
            a, b = ([place[k] for k in ends[there]] for ends in (i, j))
            fresh.add_residuals(RelativePose(Z[there], sigma=NOISE), rows[a], rows[b], name=name)
    expected, found = fresh.solve(max_iterations=6), problem.solve(max_iterations=6)
    np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found[poses], expected[rows], atol=1e-9)
    assert len(found.notes) == len(expected.notes)


def test_ids_stay_and_stale_ones_are_refused():
    ring = make_ring(8)
    poses, problem = ring.poses, ring.problem
    third, some = poses[3], poses[[3, 6]]
    lost = problem.remove(poses[[1, 2]])
    assert lost == {"edges": 7} and len(poses) == 6 and poses.ids.tolist() == [0, 3, 4, 5, 6, 7]
    assert third.rows.tolist() == [1] and some.rows.tolist() == [1, 4]
    with pytest.raises(InputError, match=r"poses\[2\], which was removed"):
        _ = poses[[3, 2]]
    with pytest.raises(InputError, match="from 0 to 7"):
        _ = poses[8]
    fresh = problem.extend(poses, ring.truth[1])
    assert fresh.ids.tolist() == [8] and poses[8].rows.tolist() == [6]
    measured = se3.compose(se3.inverse(ring.truth[:1]), ring.truth[1:2])
    problem.add_residuals(RelativePose(measured), poses[0], fresh, name="again")
    problem.fix(poses[0])
    solution = problem.solve()
    np.testing.assert_array_equal(solution[poses[8]], solution[poses][6:])
    assert solution.covariance(third).shape == (1, 6, 6)


def test_solutions_from_before_have_values_and_refuse_covariances():
    ring = make_ring(8)
    ring.problem.fix(ring.poses[0])
    before = ring.problem.solve()
    values = before[ring.poses[5]].copy()
    ring.problem.remove(ring.poses[3])
    np.testing.assert_array_equal(before[ring.poses[5]], values)
    with pytest.raises(InputError, match="removed since"):
        before.covariance(ring.poses[5])
    with pytest.raises(InputError, match="removed since"):
        before.undetermined()
    fresh = ring.problem.extend(ring.poses, ring.truth[3])
    with pytest.raises(InputError, match="there when the problem was solved"):
        _ = before[fresh]
    # As a start it gives every variable that it knows its value; new ones have their own.
    at = ring.problem.values_at(before)[0]
    np.testing.assert_array_equal(at[ring.poses[5].rows], values)
    np.testing.assert_array_equal(at[fresh.rows[0]], ring.truth[3])
    ring.problem.set_values(before)
    np.testing.assert_array_equal(ring.poses.values, at)


def test_extending_keeps_earlier_solutions_whole():
    ring = make_ring(6)
    ring.problem.fix(ring.poses[0])
    before = ring.problem.solve()
    expected = before.covariance(ring.poses[3])
    ring.problem.extend(ring.poses, ring.truth[0])
    again = ring.problem.solve(start=before)
    np.testing.assert_allclose(before.covariance(ring.poses[3]), expected)
    np.testing.assert_allclose(again.covariance(ring.poses[3]), expected, rtol=1e-6)


def test_removed_residuals_count_nowhere():
    scene = make_scene(points=20)
    pixels = scene.problem.groups[0]
    fresh = make_scene(points=20).problem
    fresh.set_weights(fresh.groups[0], np.arange(pixels.residual.count) % 3 > 0)
    assert scene.problem.remove(pixels[np.arange(pixels.residual.count) % 3 == 0]) == {"pixels": -(-pixels.residual.count // 3)}
    assert scene.problem.remove(pixels[[0, 3]]) == {}  # again
    np.testing.assert_allclose(scene.problem.cost(), fresh.cost(), rtol=1e-12)
    found, expected = scene.problem.solve(), fresh.solve()
    np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-9)
    np.testing.assert_allclose(found[scene.cameras], expected.values[0], atol=1e-7)
    assert found.invalid == {"pixels": 0}
    scene.problem.remove(pixels)
    assert scene.problem.groups == []
    with pytest.raises(InputError, match="a group of this problem"):
        scene.problem.set_weights(pixels, None)


def test_what_is_not_of_the_problem_or_not_removable_is_refused():
    ring, other = make_ring(4), make_ring(4)
    with pytest.raises(InputError, match="a group of this problem"):
        ring.problem.remove(other.problem.groups[0])
    with pytest.raises(InputError, match="variables of this problem"):
        ring.problem.remove(other.poses[0])
    with pytest.raises(InputError, match="variables of this problem"):
        ring.problem.extend(other.poses, ring.truth[0])
    with pytest.raises(InputError, match=r"rows of 'edges' from 0 to 7"):
        _ = ring.problem.groups[0][[3, 8]]


@pytest.mark.parametrize("solver", ["dense", "sparse", "schur"])
def test_held_components_stay_and_the_rest_is_solved(solver):
    """Against the same with those components told by tight priors."""
    scene = make_scene(cameras=5, points=30)
    problem, cameras, points = scene.problem, scene.cameras, scene.points
    problem.free(cameras[1])
    problem.fix(cameras[1:3], components=[3])
    problem.fix(points[4], components=[2])
    start = [block.values.copy() for block in problem.blocks]
    solution = problem.solve(linear_solver=solver)
    assert solution.status == "converged"
    np.testing.assert_array_equal(solution[points[4]][0, 2], start[1][4, 2])
    covariance = solution.covariance(cameras[1])[0]
    assert not covariance[3].any() and not covariance[:, 3].any() and (np.diag(covariance)[[0, 1, 2, 4, 5]] > 0).all()
    joint = solution.joint_covariance(cameras[1], points[4])
    assert not joint[3].any() and not joint[8].any()
    tight = make_scene(cameras=5, points=30)
    tight.problem.free(tight.cameras[1])
    sigma = np.full(6, 1e6)
    sigma[3] = 1e-7
    tight.problem.add_residuals(Prior(tight.cameras.manifold, solution[cameras[1:3]], sigma=sigma), tight.cameras[1:3])
    tight.problem.add_residuals(Prior(Euclidean(3), solution[points[4]], sigma=[1e6, 1e6, 1e-7]), tight.points[4])
    expected = tight.problem.solve(start=solution.values)
    np.testing.assert_allclose(expected[tight.cameras], solution[cameras], atol=1e-5)
    np.testing.assert_allclose(expected.covariance(tight.cameras[1])[0], covariance, atol=1e-4 * covariance.max())
    problem.free(cameras[1:3])
    problem.free(points[4])
    assert problem.solve(start=solution).cost <= solution.cost


def test_holding_every_translation_fixes_the_gauge_of_a_ring():
    ring = make_ring(6)
    problem = ring.problem
    problem.fix(ring.poses[0], components=range(6))
    assert problem.defects() == [] and problem.solve().undetermined() == []
    problem.free(ring.poses[0])
    problem.fix(ring.poses[0], components=[0, 1, 2])
    sentences = problem.solve().undetermined()
    assert len(sentences) == 1 and "translation in any direction" in sentences[0]
    with pytest.raises(InputError, match="rotation x"):
        problem.fix(ring.poses[0], components=[6])
    with pytest.raises(InputError, match="places in the tangent"):
        problem.fix(ring.poses[0], components=[0.5])


def test_a_pattern_that_comes_again_is_not_analysed_again_and_the_bits_stay():
    rng = np.random.default_rng(4)
    truth = SE3.random(rng, 40)
    i, j = np.array([(a, b) for a in range(40) for b in (a + 1, a + 3) if b < 40]).T
    measured = [edges_between(rng, truth, i, j) for _ in range(2)]
    solutions = []
    problem = Problem()
    poses = problem.add_variables(SE3, truth, name="poses")
    problem.fix(poses[0])
    for Z in measured:
        group = problem.add_residuals(RelativePose(Z, sigma=NOISE), poses[i], poses[j])
        solutions.append(problem.solve(linear_solver="sparse"))
        problem.remove(group)
    assert len(problem._known._kept) == 1
    fresh = Problem()
    own = fresh.add_variables(SE3, truth, name="poses")
    fresh.fix(own[0])
    fresh.add_residuals(RelativePose(measured[1], sigma=NOISE), own[i], own[j])
    assert np.array_equal(fresh.solve(linear_solver="sparse")[own], solutions[1][poses])


def test_whole_groups_leave_without_the_others():
    rng = np.random.default_rng(5)
    truth = SE3.random(rng, 5)
    problem = Problem()
    poses = problem.add_variables(SE3, truth, name="poses")
    kept = problem.add_residuals(Prior(SE3, truth, sigma=0.1), poses, name="kept")
    gone = problem.add_residuals(Prior(SE3, truth, sigma=0.1), poses, name="gone")
    assert problem.remove(gone) == {"gone": 5} and problem.groups == [kept]
    with pytest.raises(InputError, match="a group of this problem"):
        problem.remove(gone)
    problem.solve()


@given(st.integers(0, 10**6), st.integers(1, 60), st.integers(1, 400))
def test_rows_are_found_whether_few_are_asked_for_or_many(seed, left, asked):
    rng = np.random.default_rng(seed)
    problem = Problem()
    block = problem.add_variables(Euclidean(1), np.arange(500.0)[:, None], name="numbers")
    alive = np.sort(rng.choice(500, left, replace=False))
    problem.remove(block[np.setdiff1d(np.arange(500), alive)])
    ids = rng.choice(alive, asked)
    assert np.array_equal(block.values[block[ids].rows, 0], ids)
    gone = int(rng.choice(np.setdiff1d(np.arange(500), alive)))
    with pytest.raises(InputError, match=rf"numbers\[{gone}\], which was removed"):
        block[np.append(ids, gone)]
