"""Corners drawn to where a window that grows does not shift."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.systems.visual_inertial_odometry.corners.centres import centred

cv2 = pytest.importorskip("cv2")


def picture(crossing: tuple[float, float], turn: float = 0.0) -> np.ndarray:
    """Four fields, light and dark, whose edges cross at one point and are some pixels soft."""
    v, u = np.mgrid[0:60, 0:80].astype(np.float64)
    x, y = u - crossing[0], v - crossing[1]
    a, b = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
    return np.rint(127.0 + 100.0 * np.tanh(a / 1.5) * np.tanh(b / 1.5)).astype(np.uint8)


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.0])
def test_a_corner_is_where_its_edges_cross(turn) -> None:
    crossing = np.array([40.3, 29.6])
    beside = crossing + np.array([[2.0, -1.0], [-1.5, 2.5], [0.0, 0.0]])
    off = np.linalg.norm(centred(cv2, picture((40.3, 29.6), turn), beside) - crossing, axis=1)
    assert (off < np.linalg.norm(beside - crossing, axis=1).max() / 5.0).all()


def test_along_an_edge_a_corner_stays() -> None:
    u = np.arange(80.0)
    edge = np.rint(127.0 + 100.0 * np.tanh((u - 40.0) / 2.0))[None].repeat(60, axis=0).astype(np.uint8)
    found = centred(cv2, edge, np.array([[42.0, 30.0]]))[0]
    assert found[1] == pytest.approx(30.0, abs=0.1)


def test_corners_of_a_small_cell_do_not_meet() -> None:
    """Two at the least distance on both sides of a crossing; in a large cell both are drawn onto it."""
    cell, crossing = 13.0, np.array([40.3, 29.6])
    beside = crossing + np.array([[-3.9, 0.5], [3.9, -0.5]])
    apart = np.linalg.norm(beside[0] - beside[1])
    found = centred(cv2, picture((40.3, 29.6)), beside, cell)
    assert np.linalg.norm(found[0] - found[1]) >= apart - 0.5 * cell > 1.0
    assert np.linalg.norm(np.diff(centred(cv2, picture((40.3, 29.6)), beside), axis=0)) < 1.0


def test_none_and_those_at_the_border_are_no_trouble() -> None:
    grey = picture((40.0, 30.0))
    assert centred(cv2, grey, np.zeros((0, 2))).shape == (0, 2)
    found = centred(cv2, grey, np.array([[0.0, 0.0], [79.0, 59.0]]))
    assert np.isfinite(found).all()
    blank = np.full((60, 80), 90, np.uint8)
    assert centred(cv2, blank, np.array([[30.0, 30.0]])).tolist() == [[30.0, 30.0]]
