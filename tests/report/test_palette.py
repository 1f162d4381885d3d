"""Colours of the reports differ for every kind of colour vision, and show on the light as on the dark page."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.report.palette import DASHES, MARKS, REJECTED, SERIES, STATUS, XYZ

# Machado, Oliveira and Fernandes, "A physiologically-based model for simulation of color vision deficiency", TVCG 15(6), 2009,
# severity 1, on linear RGB.
VISIONS = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
XYZ_OF_RGB = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]])
CARDS = ("#ffffff", "#1d242b")


def linear(color: str) -> NDArray[np.float64]:
    """Linear RGB of #rrggbb."""
    value = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def lab(rgb: NDArray[np.float64]) -> tuple[float, float, float]:
    """CIELAB under D65."""
    t = XYZ_OF_RGB @ np.clip(rgb, 0.0, 1.0) / XYZ_OF_RGB.sum(axis=1)
    f = np.where(t > 216 / 24389, np.cbrt(t), (24389 / 27 * t + 16) / 116)
    return 116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])


def ciede2000(first: tuple[float, float, float], second: tuple[float, float, float]) -> float:
    """ΔE00 (Sharma, Wu and Dalal, "The CIEDE2000 color-difference formula", 2005)."""
    (L1, a1, b1), (L2, a2, b2) = first, second
    mean = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    stretch = 1.5 - 0.5 * np.sqrt(mean**7 / (mean**7 + 25.0**7))
    C1, C2 = np.hypot(stretch * a1, b1), np.hypot(stretch * a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, stretch * a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    dh = (h2 - h1 + 180) % 360 - 180 if C1 * C2 else 0.0
    L, C = (L1 + L2) / 2, (C1 + C2) / 2
    h = (h1 + h2 + (0 if abs(h1 - h2) <= 180 else 360 if h1 + h2 < 360 else -360)) / 2 if C1 * C2 else h1 + h2
    r = np.radians
    T = 1 - 0.17 * np.cos(r(h - 30)) + 0.24 * np.cos(r(2 * h)) + 0.32 * np.cos(r(3 * h + 6)) - 0.2 * np.cos(r(4 * h - 63))
    dL = (L2 - L1) / (1 + 0.015 * (L - 50) ** 2 / np.sqrt(20 + (L - 50) ** 2))
    dC, dH = (C2 - C1) / (1 + 0.045 * C), 2 * np.sqrt(C1 * C2) * np.sin(r(dh / 2)) / (1 + 0.015 * C * T)
    turn = -2 * np.sqrt(C**7 / (C**7 + 25.0**7)) * np.sin(r(60 * np.exp(-(((h - 275) / 25) ** 2))))
    return float(np.sqrt(dL**2 + dC**2 + dH**2 + turn * dC * dH))


def contrast(color: str, ground: str) -> float:
    """Ratio of luminances as WCAG has it."""
    light, dark = sorted((float(XYZ_OF_RGB[1] @ linear(c)) + 0.05 for c in (color, ground)), reverse=True)
    return light / dark


@pytest.mark.parametrize(
    ("first", "second", "difference"),  # from the test data of Sharma, Wu and Dalal
    [
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, 2.5, 0.0), (61.0, -5.0, 29.0), 22.8977),
        ((50.0, 2.49, -0.001), (50.0, -2.49, 0.0011), 7.2195),
        ((2.0776, 0.0795, -1.135), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_the_difference_is_that_of_the_paper(first: tuple, second: tuple, difference: float) -> None:
    assert ciede2000(first, second) == pytest.approx(difference, abs=1e-4)


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize(
    ("colors", "bar"), [(tuple(STATUS.values()), 25.0), (XYZ, 25.0), (SERIES, 10.0), ((SERIES[0], *REJECTED), 10.0)]
)
def test_colours_that_stand_side_by_side_differ(vision: str, colors: tuple[str, ...], bar: float) -> None:
    seen = [lab(np.asarray(VISIONS[vision]) @ linear(color)) for color in colors]
    for i, j in itertools.combinations(range(len(colors)), 2):
        assert ciede2000(seen[i], seen[j]) >= bar, f"{colors[i]} and {colors[j]} for {vision}: {ciede2000(seen[i], seen[j]):.1f}"


@pytest.mark.parametrize("color", sorted({*STATUS.values(), *XYZ, *SERIES}))
def test_colours_show_on_both_pages(color: str) -> None:
    assert min(contrast(color, card) for card in CARDS) >= 2.2


def test_lines_and_marks_differ_without_colours() -> None:
    assert len({DASHES.get(color, "solid") for color in XYZ}) == 3
    assert len({DASHES.get(color, "solid") for color in SERIES[:5]}) == 5
    assert len({mark for mark, _ in MARKS.values()}) == len({mark for _, mark in MARKS.values()}) == 3
