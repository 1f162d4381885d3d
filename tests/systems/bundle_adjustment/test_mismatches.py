"""Wrong matches: found by redescending losses at any share, and told where none was asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.optimization import losses
from boxplus.systems.bundle_adjustment.bundle_adjustment import adjust_bundle
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from tests.systems.bundle_adjustment.scenes import SIGMA, reconstruction

CONFIG = BundleAdjustmentConfig(sigma_px=SIGMA)


def with_mismatches(seed: int, share: float, format: str):
    """A scene in which a share of the pixels is anywhere, and which these are."""
    start = reconstruction(seed, format)
    rng = np.random.default_rng([seed, 4])
    wrong = rng.random(len(start.pixels)) < share
    pixels = start.pixels.copy()
    pixels[wrong] = rng.uniform(pixels.min(axis=0), pixels.max(axis=0), (int(wrong.sum()), 2))
    return replace(start, pixels=pixels), wrong


@pytest.mark.parametrize(
    ("seed", "share", "format", "loss"),
    [
        (40, 0.02, "bal", losses.Tukey(4.685)),
        (41, 0.05, "gbp", losses.Tukey(4.685)),
        (42, 0.05, "bal", losses.GemanMcClure(3.787)),
        (43, 0.1, "colmap", losses.Welsch(2.985)),
        (44, 0.2, "gbp", losses.Tukey(4.685)),
        (45, 0.2, "bal", losses.Cauchy(2.385)),
    ],
)
def test_a_redescending_loss_finds_them_from_afar(seed, share, format, loss):
    start, wrong = with_mismatches(seed, share, format)
    result = adjust_bundle(start, CONFIG, loss=loss)
    inlier = result.errors <= 4.0 * SIGMA
    assert np.median(result.errors_start) > 10.0 * SIGMA  # beyond every scale
    assert np.count_nonzero(inlier & ~wrong) >= 0.98 * np.count_nonzero(inlier)
    assert np.count_nonzero(inlier & ~wrong) >= 0.9 * np.count_nonzero(~wrong)
    assert result.doubt is None


def test_a_sigma_that_silences_most_observations_is_told():
    start, _ = with_mismatches(46, 0.05, "gbp")
    result = adjust_bundle(start, BundleAdjustmentConfig(sigma_px=0.02), loss=losses.Tukey(4.685))
    assert "of the observations hardly count under the robust loss: a wrong start, or a sigma too small" in result.doubt


def test_without_a_loss_they_are_told():
    start, wrong = with_mismatches(47, 0.005, "gbp")
    assert wrong.any()
    told = [note for note in adjust_bundle(start).notes if "of the cost" in note and "use a robust loss" in note]
    assert len(told) == 1
    assert not any("of the cost" in note for note in adjust_bundle(reconstruction(47)).notes)


@pytest.mark.parametrize("format", ["bal", "colmap", "gbp"])
@pytest.mark.parametrize("seed", range(60, 63))
def test_what_a_few_bend_without_a_loss_is_not_to_be_trusted(seed, format):
    start, wrong = with_mismatches(seed, 0.02, format)
    assert wrong.any()
    assert "few gross errors bend all the rest" in adjust_bundle(start, CONFIG.model_copy(update={"sigma_px": 1.0})).doubt


@pytest.mark.parametrize("seed", range(64, 68))
def test_few_errors_bend_no_more_than_noise_does(seed):
    start = reconstruction(seed, "bal")
    rng = np.random.default_rng([seed, 5])
    heavy = rng.random(len(start.pixels)) < 0.01
    angle = rng.uniform(0.0, 2.0 * np.pi, len(start.pixels))
    aside = np.where(heavy, 20.0 * SIGMA, 0.0)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    result = adjust_bundle(replace(start, pixels=start.pixels + aside))
    assert any("of the cost" in note and "use a robust loss" in note for note in result.notes)
    assert result.doubt is None
