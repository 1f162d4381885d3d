"""Losses: derivatives against differences, and Triggs' factors against the gradient and curvature they stand for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus import InputError, losses
from boxplus.optimization.losses import loss_at, triggs

ROBUST = [losses.Truncated, losses.Huber, losses.Cauchy, losses.Tukey, losses.GemanMcClure, losses.Welsch]


@pytest.mark.parametrize("make", ROBUST)
@given(s=st.floats(1e-3, 50.0), scale=st.floats(0.3, 4.0))
def test_derivatives(make, s, scale):
    loss = make(scale)
    if abs(s - scale**2) < 0.05 * s:  # Huber and Tukey have a kink or a jump of the second derivative there
        return
    h = 1e-4 * s
    value, first, second = loss_at(loss.code, scale, s)
    above, below = loss_at(loss.code, scale, s + h), loss_at(loss.code, scale, s - h)
    assert first == pytest.approx((above[0] - below[0]) / (2 * h), rel=1e-5, abs=1e-9)
    assert second == pytest.approx((above[1] - below[1]) / (2 * h), rel=1e-4, abs=1e-8)
    assert 0.0 <= value <= s * (1 + 1e-12)


@pytest.mark.parametrize("make", ROBUST)
def test_small_residuals_count_as_least_squares(make):
    value, first, _ = loss_at(make(1.0).code, 1.0, 1e-10)
    assert value == pytest.approx(1e-10, rel=1e-6) and first == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("make", ROBUST)
@given(length=st.floats(0.01, 6.0), scale=st.floats(0.5, 3.0))
def test_triggs_factors_give_the_exact_gradient_and_a_positive_curvature(make, length, scale):
    code = make(scale).code
    r = length * np.array([0.6, -0.8, 0.0])
    J = np.arange(12.0).reshape(3, 4) ** 0.5 - 1.3
    s = float(r @ r)
    _, first, second = loss_at(code, scale, s)
    _, root, alpha = triggs(code, scale, s)
    weighed = root / (1.0 - alpha) * r
    Jw = root * (J - alpha * np.outer(r, r @ J) / s)
    np.testing.assert_allclose(Jw.T @ weighed, first * J.T @ r, rtol=1e-10, atol=1e-12)
    exact = first * np.eye(3) + 2.0 * second * np.outer(r, r)
    used = exact if first + 2.0 * second * s >= 0.5 * first else first * np.eye(3)
    np.testing.assert_allclose(Jw.T @ Jw, J.T @ used @ J, rtol=1e-9, atol=1e-10)


def test_scales_are_checked_and_losses_print_as_they_are_written():
    with pytest.raises(InputError, match="Huber scale positive and finite – got 0"):
        losses.Huber(0.0)
    with pytest.raises(InputError, match="nan"):
        losses.Cauchy(float("nan"))
    assert repr(losses.Huber(1.5)) == "Huber(1.5)"
    assert repr(losses.Tukey(1.0).with_scale(2.0)) == "Tukey(2)"
