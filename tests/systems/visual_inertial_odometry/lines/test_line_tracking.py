"""Lines followed through images whose motion is known."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import Pinhole, RadialTangential
from boxplus.manifolds import so3
from boxplus.systems.visual_inertial_odometry import Rig
from boxplus.systems.visual_inertial_odometry.lines import edges
from boxplus.systems.visual_inertial_odometry.lines.disparity import along_baseline, inverse_depths
from boxplus.systems.visual_inertial_odometry.lines.segments import new_segments
from boxplus.systems.visual_inertial_odometry.lines.tracking import LineTracker

cv2 = pytest.importorskip("cv2")
SIZE = (376, 240)
CAMERA = Pinhole(229.0, 228.5, 184.0, 124.0, RadialTangential(-0.28, 0.07, 2e-4, 1e-5))
BASELINE, DEPTH, SCALE = 0.11, 3.0, 400.0
FRAMES = ((300.0, 350.0, 280.0, 420.0), (900.0, 500.0, 350.0, 260.0), (520.0, 900.0, 600.0, 220.0))  # x, y, width, height


def rig() -> Rig:
    shifted = np.eye(4)
    shifted[0, 3] = BASELINE
    return Rig.of([CAMERA] * 2, [np.eye(4), shifted], [SIZE] * 2)


def wall() -> np.ndarray:
    picture = np.full((1400, 1600), 150, np.uint8)
    for grey, (x, y, w, h) in zip((40, 230, 70), FRAMES, strict=True):
        cv2.rectangle(picture, (int(x), int(y)), (int(x + w), int(y + h)), grey, -1)
    return cv2.GaussianBlur(picture, (0, 0), 2.0)


def sides() -> np.ndarray:
    """(12, 2, 3) both ends of the edges on the wall z = DEPTH [m]."""
    edges_px = []
    for x, y, w, h in FRAMES:
        left, top, right, bottom = x - 0.5, y - 0.5, x + w + 0.5, y + h + 0.5
        corners = [[left, top], [right, top], [right, bottom], [left, bottom]]
        edges_px += [[corners[k], corners[(k + 1) % 4]] for k in range(4)]
    on_wall = (np.array(edges_px) - [800.0, 700.0]) / SCALE
    return np.concatenate([on_wall, np.full((12, 2, 1), DEPTH)], axis=2)


def seen(picture: np.ndarray, R: np.ndarray, p: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The wall from the camera (R, p), through its lens, with noise."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    rays, _ = CAMERA.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    rays = rays @ R.T
    there = (p + rays * ((DEPTH - p[2]) / rays[:, 2])[:, None])[:, :2] * SCALE + [800.0, 700.0]
    maps = there.astype(np.float32).reshape(SIZE[1], SIZE[0], 2)
    image = cv2.remap(picture, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
    return np.clip(np.rint(image + rng.normal(size=image.shape) * 1.5), 0, 255).astype(np.uint8)


def pair(picture: np.ndarray, R: np.ndarray, p: np.ndarray, rng: np.random.Generator) -> dict[int, np.ndarray]:
    return {0: seen(picture, R, p, rng), 1: seen(picture, R, p + R @ [BASELINE, 0.0, 0.0], rng)}


def nearest_side(segments: np.ndarray, R: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) the edge of the wall that each segment (n, 4) of rays lies on, and (n,) how far its ends are off it [px]."""
    ends = (sides() - p) @ R
    flat = ends[..., :2] / ends[..., 2:]
    n = np.stack([flat[:, 1, 1] - flat[:, 0, 1], flat[:, 0, 0] - flat[:, 1, 0]], axis=1)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    away = segments.reshape(-1, 1, 2, 2) - flat[None, :, :1]
    off = np.abs(np.einsum("skij,kj->ski", away, n)).max(axis=2) * CAMERA.fx
    return off.argmin(axis=1), off.min(axis=1)


def test_lines_stay_on_their_edges_in_both_cameras() -> None:
    rng, picture, tracker = np.random.default_rng(1), wall(), LineTracker(cv2, rig(), 20)
    R, p = np.eye(3), np.zeros(3)
    first = tracker.track(pair(picture, R, p, rng), np.eye(3), np.zeros(3), wants_new=True)
    assert len(first) >= 8
    side, off = nearest_side(first.segments[:, 0], R, p)
    assert off.max() < 0.4 and len(set(side.tolist())) == len(side)
    own = dict(zip(first.ids.tolist(), side.tolist(), strict=True))
    errors: list[float] = []
    for k in range(1, 7):
        turn, step = so3.exp(np.array([0.04, -0.07, 0.05]) * (-1) ** k), np.array([0.03, -0.01, 0.05])
        R_now, p_now = R @ turn, p + step
        tracks = tracker.track(pair(picture, R_now, p_now, rng), turn, R.T @ step)
        R, p = R_now, p_now
        for c, x in enumerate((0.0, BASELINE)):
            there = np.isfinite(tracks.segments[:, c, 0])
            side, off = nearest_side(tracks.segments[there, c], R, p + R @ [x, 0.0, 0.0])
            assert [own[i] for i in tracks.ids[there].tolist()] == side.tolist()
            errors += off.tolist()
    assert len(tracks) >= 6 and np.isfinite(tracks.segments[:, 1, 0]).sum() >= 5
    assert np.median(errors) < 0.2 and np.max(errors) < 0.8


def test_what_is_given_up_or_not_seen_is_followed_no_longer() -> None:
    rng, picture, tracker = np.random.default_rng(2), wall(), LineTracker(cv2, rig(), 20)
    images = pair(picture, np.eye(3), np.zeros(3), rng)
    first = tracker.track(images, np.eye(3), np.zeros(3), wants_new=True)
    tracker.forget(first.ids[::2])
    again = tracker.track(images, np.eye(3), np.zeros(3))
    assert set(again.ids.tolist()) <= set(first.ids[1::2].tolist()) and len(again) >= 3
    more = tracker.track(images, np.eye(3), np.zeros(3), wants_new=True)
    assert more.ids.max() > first.ids.max() and (np.diff(more.ids) > 0).all()
    blank = {c: np.full(SIZE[::-1], 120, np.uint8) for c in range(2)}
    gone = tracker.track(blank, np.eye(3), np.zeros(3), wants_new=True)
    assert len(gone) == 0 and sum(gone.rejected.values()) == len(more)
    tracker.track(images, np.eye(3), np.zeros(3), wants_new=True)
    without = tracker.track({1: images[1]}, np.eye(3), np.zeros(3), wants_new=True)
    assert len(without) == 0 and "no image of the first camera" in without.rejected


def test_the_depth_of_upright_lines_is_found_and_that_of_level_ones_is_not() -> None:
    rng, picture, T = np.random.default_rng(3), wall(), np.eye(4)
    T[0, 3] = -BASELINE
    images = pair(picture, np.eye(3), np.zeros(3), rng)
    visible = np.abs(sides()[..., :2] / DEPTH).max(axis=(1, 2)) < 0.45
    segments = (sides()[visible, :, :2] / DEPTH).reshape(-1, 4)
    upright = np.abs(segments[:, 3] - segments[:, 1]) > np.abs(segments[:, 2] - segments[:, 0])
    assert np.array_equal(along_baseline(segments, np.array([1.0, 0.0, 0.0])), ~upright)
    rho, sure = inverse_depths(cv2, images[0], images[1], rig(), 1, T, segments, np.zeros((len(segments), 2)))
    assert not sure[~upright].any() and not rho[~sure].any()
    assert sure[upright].sum() >= 0.6 * upright.sum()
    assert np.abs(rho[sure] - 1.0 / DEPTH).max() < 0.06  # two steps of the search


def test_pieces_of_a_line_bent_by_the_lens_are_one_and_followed_ones_are_not_found_again() -> None:
    rng, picture = np.random.default_rng(4), np.full((1400, 1600), 150, np.uint8)
    picture[900:] = 60  # across the whole image, below its middle
    grey = seen(cv2.GaussianBlur(picture, (0, 0), 2.0), np.eye(3), np.zeros(3), rng)
    detector = cv2.createLineSegmentDetector()
    found = new_segments(cv2, detector, grey, CAMERA, np.zeros((0, 4)), 10)
    assert len(found) == 1 and np.hypot(*(found[0, 2:] - found[0, :2])) * CAMERA.fx > 0.8 * SIZE[0]
    assert not len(new_segments(cv2, detector, grey, CAMERA, found, 10))
    assert not len(new_segments(cv2, detector, grey, CAMERA, np.zeros((0, 4)), 0))


def test_edges_are_found_to_a_part_of_a_pixel() -> None:
    rng, width = np.random.default_rng(5), 200
    truth = rng.uniform(90.0, 110.0, 5)
    x = np.arange(width)
    for place in truth:
        row = 60.0 + 120.0 / (1.0 + np.exp(-(x - place) / 0.8))
        grey = cv2.GaussianBlur(np.tile(np.rint(row).astype(np.uint8), (120, 1)), (5, 5), 1.0)
        camera = Pinhole(200.0, 200.0, 100.0, 60.0)
        down = np.column_stack([np.full(edges.PLACES, place + 1.2), np.linspace(20.0, 100.0, edges.PLACES)])[None]
        for sign, exists in ((-1.0, True), (1.0, False)):  # across a line that goes down is to the left
            edge, there, _ = edges.snapped(cv2, grey, down, np.array([sign]), np.array([20.0]))
            assert there.all() == exists
            if exists:
                segment, fits, rms = edges.fitted(camera, edge, there, 8)
                assert fits.all() and rms[0] < 0.05
                assert np.abs(segment[0, ::2] * 200.0 + 100.0 - place).max() < 0.1
                assert segment[0, 3] > segment[0, 1]  # in the direction it was looked for
