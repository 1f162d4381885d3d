"""The programs on the pages about residuals of one's own and about manifolds run, and do what the pages say."""

import re
from pathlib import Path

import numpy as np
import pytest

import boxplus as bp
from boxplus.manifolds import se2
from boxplus.manifolds.se3 import SE3
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.optimization.problem import Problem
from boxplus.residuals.relative_pose import RelativePose
from boxplus.residuals.user.residual import UserResidual

DOCS = Path(__file__).parents[3] / "docs"


def _programs(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


def test_beacons_are_found_by_the_program_on_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    poses, places = bp.SE2.random(rng, 20), 5.0 * rng.normal(size=(15, 2))
    pose_of, beacon_of = (index.ravel() for index in np.meshgrid(np.arange(20), np.arange(15)))
    relative = se2.act(se2.inverse(poses[pose_of]), places[beacon_of])
    problem = Problem()
    robot = problem.add_variables(bp.SE2, bp.SE2.boxplus(poses, rng.normal(0.0, 0.1, (20, 3))))
    beacons = problem.add_variables(bp.Euclidean(2), places + rng.normal(0.0, 0.1, (15, 2)))
    scope = {
        "distances": np.linalg.norm(relative, axis=1),
        "problem": problem,
        "robot": robot,
        "beacons": beacons,
        "pose_of": pose_of,
        "beacon_of": beacon_of,
        "T_world_robot": bp.SE2.random(rng, 300),
        "p_world_beacon": 5.0 * rng.normal(size=(300, 2)),
    }
    for program in _programs("residuals/user_residual.md"):
        exec(program, scope)
    said = capsys.readouterr().out
    assert "UserResidual: Jacobians agree with differences (300 of 300 residuals compared" in said
    assert "by T_world_robot on SE2: agrees" in said

    # Distances tell no headings, nor where the plane lies: a prior does.
    problem.add_residuals(bp.residuals.Prior(bp.SE2, poses, sigma=[0.01, 1.0, 1.0]), robot)
    solution = problem.solve()
    assert solution.cost < 1.0 < problem.cost()

    analytic = UserResidual(
        scope["beacon_distance"],
        dim=1,
        manifolds=(bp.SE2, bp.Euclidean(2)),
        data=(scope["distances"],),
        jacobian=scope["beacon_jacobian"],
    )
    assert check_jacobian(analytic, scope["T_world_robot"], scope["p_world_beacon"]).passed

    Z, T_i, T_j = (SE3.random(rng, 5) for _ in range(3))
    own = UserResidual(scope["relative_pose"], dim=6, manifolds=(SE3, SE3), data=(Z,))
    assert np.allclose(own.evaluate(T_i, T_j), RelativePose(Z).evaluate(T_i, T_j), atol=1e-14)


def test_the_program_about_manifolds_runs() -> None:
    scope: dict[str, object] = {}
    for program in _programs("manifolds.md"):
        exec(program, scope)
    assert np.allclose(scope["xi_again"], scope["xi"], atol=1e-12)
    assert np.shape(scope["J"]) == (100_000, 6, 6)
    assert np.shape(scope["points"]) == (1000, 50, 3)
