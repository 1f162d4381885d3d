"""χ² by its series against SciPy's statistics, far into both tails."""

from __future__ import annotations

import pytest
from scipy.stats import chi2

from boxplus._chi_square import chi_square_cdf, chi_square_exceeded, chi_square_quantile, chi_square_sf


@pytest.mark.parametrize("dof", [1, 3, 6, 100, 100_000])
def test_it_is_the_distribution_of_scipy(dof: int) -> None:
    for probability in (1e-6, 0.05, 0.5, 0.99, 1.0 - 1e-9):
        x = float(chi2.ppf(probability, dof))
        assert chi_square_quantile(probability, dof) == pytest.approx(x, rel=1e-10)
        assert chi_square_cdf(x, dof) == pytest.approx(probability, rel=1e-9)
    for probability in (1e-200, 1e-20, 0.3):
        x = float(chi2.isf(probability, dof))
        assert chi_square_exceeded(probability, dof) == pytest.approx(x, rel=1e-9)
        assert chi_square_sf(x, dof) == pytest.approx(probability, rel=1e-6)
    assert chi_square_cdf(-1.0, dof) == 0.0 and chi_square_sf(-1.0, dof) == 1.0
