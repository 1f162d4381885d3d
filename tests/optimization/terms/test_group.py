"""Groups of residuals that are linearised in part."""

from __future__ import annotations

import numpy as np

from boxplus import SE3, Problem, losses
from boxplus.residuals import RelativePose


def test_some_residuals_are_linearised_as_all_are_and_the_others_left_as_they_were():
    rng = np.random.default_rng(0)
    problem = Problem()
    poses = problem.add_variables(SE3, SE3.random(rng, 12), name="poses")
    edges = RelativePose(SE3.random(rng, 11), sigma=0.1)
    whole, part = (problem.add_residuals(edges, poses[:-1], poses[1:], loss=losses.Cauchy(1.0)) for _ in range(2))
    values = [poses.values]
    whole.linearize(values, 1)
    chosen = np.zeros(11, dtype=np.bool_)
    chosen[[3, 6]] = True
    part.linearize_some(values, chosen)
    within = slice(3, 7)
    assert np.array_equal(part.r[within], whole.r[within])
    for own, other in zip(part.jacobians, whole.jacobians, strict=True):
        assert np.array_equal(own[within], other[within])
        assert not own[:3].any() and not own[7:].any()
    assert not part.r[:3].any() and not part.r[7:].any()
