"""Corners followed through images whose motion is known, and what is refused."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus import InputError, Pinhole
from boxplus.manifolds import so3
from boxplus.systems.visual_inertial_odometry import Rig, VioConfig
from boxplus.systems.visual_inertial_odometry.corners import tracking
from boxplus.systems.visual_inertial_odometry.corners.partners import LEAST_SHARE, Partners
from boxplus.systems.visual_inertial_odometry.corners.tracking import FeatureTracker
from boxplus.systems.visual_inertial_odometry.corners.tracks import most_are_below

SIZE = (320, 240)
CAMERA = Pinhole(220.0, 220.0, 159.5, 119.5)
BASELINE, DEPTH = 0.12, 3.0


def mounting(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def stereo() -> Rig:
    return Rig.of([CAMERA] * 2, [mounting(0.0), mounting(BASELINE)], [SIZE] * 2)


def wall(seed: int = 0) -> np.ndarray:
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(seed)
    picture = sum(cv2.resize(rng.uniform(0, 1, (n, n)).astype(np.float32), (1800, 1800), interpolation=2) for n in (40, 120, 300))
    return cv2.normalize(picture, None, 10, 245, cv2.NORM_MINMAX)


def seen(picture: np.ndarray, R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The wall z = DEPTH, 300 pixels of the picture a metre, seen from (R, p) by the camera."""
    cv2 = pytest.importorskip("cv2")
    to_picture = np.array([[300.0, 0, 900.0], [0, 300.0, 900.0], [0, 0, 1.0]])
    # X = p + s R K⁻¹ u with X_z = DEPTH
    H = np.array([[DEPTH - p[2], 0, p[0]], [0, DEPTH - p[2], p[1]], [0, 0, 1.0]])
    G = to_picture @ H @ R @ np.linalg.inv(CAMERA.K)
    image = cv2.warpPerspective(picture, G, SIZE, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def pair(picture: np.ndarray, R: np.ndarray, p: np.ndarray) -> dict[int, np.ndarray]:
    return {0: seen(picture, R, p), 1: seen(picture, R, p + R @ [BASELINE, 0, 0])}


def where(pixels: np.ndarray, R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """(n, 3) points of the wall at pixels of the first camera."""
    rays = CAMERA.unproject(pixels)[0] @ R.T
    return p + rays * ((DEPTH - p[2]) / rays[:, 2])[:, None]


def test_corners_stay_on_their_points_through_turns_that_the_gyroscope_knows() -> None:
    picture, tracker = wall(), FeatureTracker(VioConfig(features=80, cell_size=30), stereo())
    R, p = np.eye(3), np.zeros(3)
    tracks = tracker.detect(tracker.track(0, pair(picture, R, p), np.eye(3)))
    assert 50 < len(tracks) <= 80 and tracks.is_new.all()
    assert np.isfinite(tracks.pixels[:, 1, 0]).mean() > 0.7
    points = dict(zip(tracks.ids.tolist(), where(tracks.pixels[:, 0], R, p), strict=True))
    for k in range(1, 6):
        turn, step = so3.exp(np.array([0.05, -0.12, 0.08]) * (-1) ** k), np.array([0.03, 0.01, 0.05])
        R_now, p_now = R @ turn, p + step
        tracks = tracker.track(k, pair(picture, R_now, p_now), turn, R.T @ step)
        R, p = R_now, p_now
    assert len(tracks) > 25 and not tracks.is_new.any()
    truth = np.array([points[k] for k in tracks.ids.tolist()])
    off = [
        np.linalg.norm(CAMERA.project((truth - p - R @ [x, 0, 0]) @ R)[0] - tracks.pixels[:, c], axis=1)
        for c, x in enumerate((0.0, BASELINE))
    ]
    assert np.median(off[0]) < 0.2 and np.nanmedian(off[1]) < 0.2
    assert np.allclose(CAMERA.unproject(tracks.pixels[:, 0])[0], tracks.rays[:, 0])
    again = tracker.detect(tracks)
    fresh = again.pixels[again.is_new, 0]
    assert len(fresh) > 5
    away = np.abs(fresh[:, None] - tracks.pixels[None, :, 0]).max(axis=2).min(axis=1)
    assert away.min() >= 15.0 - 1.0 - 8.0 and not np.isin(again.ids[again.is_new], tracks.ids).any()
    tracker.forget(again.ids[::2])
    assert tracker.track(9, pair(picture, R, p), np.eye(3)).ids.tolist() == again.ids[1::2].tolist()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_corners_creep_less_while_the_wall_comes_nearer_where_they_are_centred(seed, monkeypatch) -> None:
    picture = wall(seed)

    def creep() -> float:
        tracker = FeatureTracker(VioConfig(features=80, cell_size=30), stereo())
        tracks = tracker.detect(tracker.track(0, pair(picture, np.eye(3), np.zeros(3)), np.eye(3)))
        points = dict(zip(tracks.ids.tolist(), where(tracks.pixels[:, 0], np.eye(3), np.zeros(3)), strict=True))
        for k in range(1, 16):
            p = np.array([0.0, 0.0, 0.06 * k])
            tracks = tracker.track(k, pair(picture, np.eye(3), p), np.eye(3), np.array([0.0, 0.0, 0.06]))
        truth = CAMERA.project(np.array([points[k] for k in tracks.ids.tolist()]) - p)[0]
        return float(np.median(np.linalg.norm(truth - tracks.pixels[:, 0], axis=1)))

    centred = creep()
    monkeypatch.setattr(tracking, "centred", lambda cv2, grey, corners, cell: corners)
    assert centred < 0.75 * creep()


def test_a_second_image_that_does_not_belong_to_the_first_gives_no_partners() -> None:
    picture, tracker = wall(), FeatureTracker(VioConfig(features=80), stereo())
    R, p = np.eye(3), np.zeros(3)
    images = pair(picture, R, p)
    swapped = tracker.detect(tracker.track(0, {0: images[1], 1: images[0]}, np.eye(3)))
    assert np.isfinite(swapped.pixels[:, 1, 0]).mean() < 0.1
    lower = tracker.track(1, {0: images[0], 1: np.roll(images[1], 6, axis=0)}, np.eye(3))
    assert np.isfinite(lower.pixels[:, 1, 0]).mean() < 0.2 and lower.rejected["off its epipolar line"] > 5


def test_partners_are_asked_for_where_another_camera_should_see_them() -> None:
    picture, config = wall(), VioConfig(features=80, cell_size=30)
    images = pair(picture, np.eye(3), np.zeros(3))

    def partners(rig: Rig, images: dict[int, np.ndarray]) -> Partners | None:
        tracker = FeatureTracker(config, rig)
        return tracker.detect(tracker.track(0, images, np.eye(3))).partners

    sound = partners(stereo(), images)
    assert sound is not None and sound.share > 0.9 and sound.exchanged is None
    swapped = partners(stereo(), {0: images[1], 1: images[0]})
    assert swapped is not None and swapped.share < LEAST_SHARE
    assert swapped.exchanged is not None and swapped.exchanged > 0.9
    strangers = partners(stereo(), {0: images[0], 1: seen(wall(7), np.eye(3), np.zeros(3))})
    assert strangers is not None and strangers.share < LEAST_SHARE
    assert strangers.exchanged is not None and strangers.exchanged < LEAST_SHARE
    # Nothing is to be judged where views do not overlap, disparities are beyond what flow finds, or a camera shows nothing.
    turned = mounting(BASELINE)
    turned[:3, :3] = so3.exp(np.array([0.0, np.deg2rad(80.0), 0.0]))
    assert partners(Rig.of([CAMERA] * 2, [mounting(0.0), turned], [SIZE] * 2), images) is None
    wide = seen(picture, np.eye(3), np.array([1.2, 0.0, 0.0]))
    assert partners(Rig.of([CAMERA] * 2, [mounting(0.0), mounting(1.2)], [SIZE] * 2), {0: images[0], 1: wide}) is None
    assert partners(stereo(), {0: images[0], 1: np.full_like(images[1], 90)}) is None
    assert partners(Rig.of([CAMERA], [mounting(0.0)], [SIZE]), {0: images[0]}) is None


def test_without_an_image_or_in_the_dark_corners_are_lost_and_counted() -> None:
    picture, tracker = wall(), FeatureTracker(VioConfig(features=60), stereo())
    R, p = np.eye(3), np.zeros(3)
    count = len(tracker.detect(tracker.track(0, pair(picture, R, p), np.eye(3))))
    dark = tracker.track(1, {c: np.zeros((240, 320), np.uint8) for c in range(2)}, np.eye(3))
    assert len(dark) == 0 and sum(dark.rejected.values()) == count and dark.contrast[0] == 0.0
    assert len(tracker.detect(dark)) == 0
    tracker.detect(tracker.track(2, pair(picture, R, p), np.eye(3)))
    none = tracker.track(3, {}, np.eye(3))
    assert len(none) == 0 and none.rejected["no image of the first camera"] > 20 and np.isnan(none.brightness).all()


@pytest.mark.parametrize("bits", [12, 16])
def test_images_of_more_bits_are_followed_as_those_of_eight(bits: int) -> None:
    """The first ones are dark, so that the range is known later only."""
    picture, trackers = wall(), [FeatureTracker(VioConfig(features=80, cell_size=30), stereo()) for _ in range(2)]
    tracks = []
    for tracker, shift in zip(trackers, (0, bits - 8), strict=True):
        for k, light in enumerate((0.1, 0.2, 1.0, 1.0)):
            images = pair(picture, np.eye(3), np.array([0.01 * k, 0.0, 0.0]))
            dim = {c: (image * light).astype(np.uint16) << shift for c, image in images.items()}
            deep = dim if shift else {c: image.astype(np.uint8) for c, image in dim.items()}
            found = tracker.track(k, deep, np.eye(3))
            found = tracker.detect(found) if k == 2 else found
        tracks.append(found)
    assert len(tracks[1]) > 40 and abs(len(tracks[1]) - len(tracks[0])) <= 3
    assert tracks[1].brightness == pytest.approx(tracks[0].brightness, rel=0.02)
    assert tracks[1].contrast == pytest.approx(tracks[0].contrast, rel=0.02)


def test_the_range_that_grows_takes_the_image_before_along() -> None:
    picture, tracker = wall(), FeatureTracker(VioConfig(features=80, cell_size=30), stereo())
    first = {c: image.astype(np.uint16) * 4 for c, image in pair(picture, np.eye(3), np.zeros(3)).items()}
    tracks = tracker.detect(tracker.track(0, first, np.eye(3)))
    then = {c: image.copy() for c, image in first.items()}
    then[0][0, 0] = 4000  # one bright pixel: twelve bits, not ten
    assert len(tracker.track(1, then, np.eye(3))) > 0.9 * len(tracks) > 40


def test_opencv_is_asked_for_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(InputError, match=r"pip install .*opencv"):
        FeatureTracker(VioConfig(), stereo())


@given(seed=st.integers(0, 10**6), count=st.integers(1, 60), limit=st.sampled_from([0.2, 0.5, 0.8, 0.81]))
def test_whether_most_stand_still_is_what_the_quantile_says(seed: int, count: int, limit: float) -> None:
    rng = np.random.default_rng(seed)
    values = np.where(rng.random(count) < 0.3, limit, rng.random(count))  # some of them at the limit
    assert most_are_below(values, limit) == (np.quantile(values, 0.8) < limit)


def test_light_is_measured_as_numpy_does_and_cells_with_corners_are_closed() -> None:
    rng = np.random.default_rng(0)
    for grey in (rng.integers(0, 256, (60, 94), np.uint8), np.full((5, 7), 201, np.uint8)):
        np.testing.assert_allclose(tracking._mean_and_deviation(grey), (grey.mean(), grey.std()), rtol=1e-12, atol=1e-12)
    corners = rng.integers(-8, 70, (12, 2))
    mask, expected = np.full((2, 48, 64), 255, np.uint8)
    tracking._clear(corners, 5, mask)
    for u, v in corners:
        expected[max(v - 5, 0) : max(v + 6, 0), max(u - 5, 0) : max(u + 6, 0)] = 0
    np.testing.assert_array_equal(mask, expected)
