"""Rendered images against the truth: geometry, photometric consistency, tracked corners, shutters, exposure, noise."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.simulation.cameras import (
    CameraRig,
    CameraScenario,
    CameraSimulation,
    Exposure,
    Lens,
    Light,
    make_camera_scenario,
    make_rig,
    simulate_cameras,
)
from boxplus.simulation.cameras.sensor import ELECTRONS_PER_GREY, LensKind
from boxplus.simulation.simulation import simulate

needs_cv2 = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="OpenCV (extra `vision`) is not installed")


def sensors(rig: CameraRig, **changes: object) -> CameraRig:
    """The rig with other settings of every camera."""
    cameras = tuple(c.model_copy(update={"sensor": c.sensor.model_copy(update=changes)}) for c in rig.cameras)
    return rig.model_copy(update={"cameras": cameras})


def small(
    name: str = "room", seed: int = 0, lens: LensKind | None = None, duration_s: float = 6.0, **changes: object
) -> CameraSimulation:
    rig = sensors(make_rig("stereo", lens, 0.5), **changes)
    return simulate_cameras(name, seed, duration_s=duration_s, rig=rig)


def points_of(simulation: CameraSimulation, camera: int, index: int, pixels: np.ndarray) -> np.ndarray:
    """World points seen at integer pixels (N, 2), NaN where there is nothing."""
    depth = simulation.depth(camera, index)[pixels[:, 1], pixels[:, 0]]
    model = simulation.scenario.rig.cameras[camera].sensor.lens.model()
    rays, found = model.unproject(pixels.astype(np.float64))
    p = rays * np.where(np.isfinite(depth) & found, depth, np.nan)[:, None]
    T = simulation.T_world_camera(camera, [simulation.stamp_ns(index)])[0]
    return p @ T[:3, :3].T + T[:3, 3]


def projected(simulation: CameraSimulation, camera: int, index: int, p_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    T = np.linalg.inv(simulation.T_world_camera(camera, [simulation.stamp_ns(index)])[0])
    model = simulation.scenario.rig.cameras[camera].sensor.lens.model()
    p = p_world @ T[:3, :3].T + T[:3, 3]
    pixels, seen = model.project(np.nan_to_num(p))
    return pixels, seen & np.isfinite(p_world).all(axis=1)


def bilinear(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    u, v = pixels.T
    j, i = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = u - j, v - i
    top = (1 - a) * image[i, j] + a * image[i, j + 1]
    return (1 - b) * top + b * ((1 - a) * image[i + 1, j] + a * image[i + 1, j + 1])


def visible(
    simulation: CameraSimulation, source: tuple[int, int], target: tuple[int, int], step: int = 5
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of one image and where they are in another, by depth and pose, those that nothing hides."""
    height, width = simulation.depth(*source).shape
    v, u = (grid.ravel() for grid in np.mgrid[6 : height - 6 : step, 6 : width - 6 : step])
    here = np.stack([u, v], axis=1)
    p_world = points_of(simulation, *source, here)
    there, seen = projected(simulation, *target, p_world)
    seen &= (there > 2.0).all(axis=1) & (there[:, 0] < width - 3.0) & (there[:, 1] < height - 3.0)
    here, there, p_world = here[seen], there[seen], p_world[seen]
    T = np.linalg.inv(simulation.T_world_camera(target[0], [simulation.stamp_ns(target[1])])[0])
    z = (p_world @ T[:3, :3].T + T[:3, 3])[:, 2]
    depth = simulation.depth(*target)
    # Not hidden, and not beside an edge, where the mean of a pixel is that of two surfaces.
    near = np.stack(
        [
            depth[np.rint(there[:, 1]).astype(int) + i, np.rint(there[:, 0]).astype(int) + j]
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
        ]
    )
    flat = np.abs(near - z).max(axis=0) < 0.03 * z
    own = simulation.depth(*source)
    edges = np.stack([own[here[:, 1] + i, here[:, 0] + j] for i in (-2, 0, 2) for j in (-2, 0, 2)])
    flat &= (edges.max(axis=0) - edges.min(axis=0)) < 0.06 * edges[4]
    return here[flat], there[flat]


@pytest.mark.parametrize("name", ["room", "hall", "stairs", "drive", "warehouse", "walk"])
def test_depths_are_those_the_lidar_measures(name: str) -> None:
    """The same surfaces, met by the caster of the LiDAR's rays."""
    simulation = small(name, lens="equidistant")
    camera = simulation.scenario.rig.cameras[1]
    depth = simulation.depth(1, 30)
    v, u = (grid.ravel() for grid in np.mgrid[0 : camera.sensor.height : 7, 0 : camera.sensor.width : 7])
    bearings, found = camera.sensor.lens.model().bearings(np.stack([u, v], axis=1).astype(np.float64))
    T = simulation.T_world_camera(1, [simulation.stamp_ns(30)])
    ranges, _ = simulation.scenario.world.cast(bearings[found], T[:, :3, :3], T[:, :3, 3], 2000.0)
    seen = depth[v[found], u[found]]
    at_border = ~simulation._renderers[1].seen[v[found], u[found]]
    assert (np.isfinite(seen) == np.isfinite(ranges))[~at_border].all() and at_border.mean() < 0.05
    both = np.isfinite(seen) & np.isfinite(ranges)
    assert both.sum() > 500
    assert np.abs(seen[both] - (ranges * bearings[found][:, 2])[both]).max() < 1e-9


@pytest.mark.parametrize("lens", ["pinhole", "radtan", "equidistant"])
def test_what_is_seen_twice_looks_the_same(lens: LensKind) -> None:
    """Warped with true depth and pose, what is left is the noise, and an error of sampling far below it."""
    simulation = small(lens=lens, vignetting=0.0, seed=1)
    for target in ((1, 80), (0, 83)):
        here, there = visible(simulation, (0, 80), target)
        assert len(here) > 700
        gain = simulation.exposure(80)[0] / simulation.exposure(target[1])[0]
        one, other = simulation.exact_image(0, 80), simulation.exact_image(*target)
        sampling = gain * bilinear(other, there) - one[here[:, 1], here[:, 0]]
        assert abs(np.median(sampling)) < 0.2 and one.std() > 20.0
        assert 1.4826 * np.median(np.abs(sampling)) < 1.2
        one, other = simulation.image(0, 80).pixels, simulation.image(*target).pixels.astype(float)
        left = gain * bilinear(other, there) - one[here[:, 1], here[:, 0]]
        a, b = np.modf(there)[0].T
        # Of one pixel, and of the four that are interpolated, whose weights' squares add up to this.
        weight = 1.0 + float(np.mean((1 - 2 * a + 2 * a * a) * (1 - 2 * b + 2 * b * b)))
        variance = weight * (np.median(one) / ELECTRONS_PER_GREY + (12.0 / ELECTRONS_PER_GREY) ** 2 + 1 / 12)
        assert 1.4826 * np.median(np.abs(left)) < 1.1 * np.sqrt(variance + 1.2**2)


@pytest.mark.slow
@needs_cv2
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_tracked_corners_are_where_they_belong(seed: int) -> None:
    import cv2

    simulation = simulate_cameras("room", seed, duration_s=6.0, rig=make_rig("stereo"))
    first, depth = simulation.image(0, 70).pixels, simulation.depth(0, 70)
    corners = cv2.goodFeaturesToTrack(first, 400, 0.01, 10.0).reshape(-1, 2)
    pixels = corners.astype(int)
    inside = ((pixels > 12) & (pixels < np.array(first.shape[::-1]) - 12)).all(axis=1)
    corners, pixels = corners[inside], pixels[inside]
    # What a window sees at an edge moves in two ways.
    window = np.stack([depth[pixels[:, 1] + i, pixels[:, 0] + j] for i in (-11, 0, 11) for j in (-11, 0, 11)])
    flat = window.max(axis=0) - window.min(axis=0) < 0.2 * window[4]
    p_world = points_of(simulation, 0, 70, pixels)
    for target in ((1, 70), (0, 71)):
        second = simulation.image(*target).pixels
        found, status, _ = cv2.calcOpticalFlowPyrLK(first, second, corners[:, None], None, winSize=(21, 21), maxLevel=4)
        back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, found, None, winSize=(21, 21), maxLevel=4)
        truth, seen = projected(simulation, *target, p_world)
        there_and_back = np.linalg.norm(back[:, 0] - corners, axis=1) < 0.5
        kept = (status[:, 0] == 1) & (returned[:, 0] == 1) & seen & flat & there_and_back
        assert kept.sum() > 100
        assert np.median(np.linalg.norm((found[:, 0] - truth)[kept], axis=1)) < 0.1


def test_rows_of_a_rolling_shutter_are_those_of_their_own_instants() -> None:
    """Without blur a row is the same row of a global shutter's image at the time of the row."""
    rig = make_rig("mono", scale=0.25)
    rolling = sensors(rig, line_delay_s=2e-4, blur_samples=1, noise=0.0, sharpness_px=0.0)
    still = sensors(rig, blur_samples=1, noise=0.0, sharpness_px=0.0)
    scenario = make_camera_scenario("room_moving", 4, rolling)
    simulation = CameraSimulation(scenario, 4, 4.0)
    times = simulation.row_times_ns(0, 20)
    assert times[-1] - times[0] == pytest.approx(2e5 * (len(times) - 1), abs=2.0)
    assert abs(float((times - simulation.stamp_ns(20)).mean())) < 2.0
    image, depth = simulation.exact_image(0, 20), simulation.depth(0, 20)
    for row in (0, len(times) // 2, len(times) - 1):
        moved = CameraSimulation(replace(scenario, rig=still), 4, 4.0)
        moved.stamp_ns = lambda index, at=int(times[row]): at  # type: ignore[method-assign, misc]
        factor = simulation.exposure(20)[0] / moved.exposure(20)[0]
        assert np.abs(moved.depth(0, 20)[row] - depth[row]).max() < 1e-9
        # Where an edge passes, the neighbouring rows decide how it is smoothed, and they lie elsewhere.
        apart = np.abs(moved.exact_image(0, 20)[row] * factor - image[row])
        assert np.quantile(apart, 0.9) < 0.5


def test_blur_is_the_mean_over_the_exposure() -> None:
    exposure = Exposure(auto=False, shortest_s=0.03, fixed=1.0, longest_s=0.03)
    rig = sensors(make_rig("mono", scale=0.25), noise=0.0, vignetting=0.0).model_copy(update={"exposure": exposure})
    scenario = make_camera_scenario("room_moving", 2, rig)
    blurred = CameraSimulation(scenario, 2, 4.0)
    sharp = CameraSimulation(replace(scenario, rig=sensors(rig, blur_samples=1)), 2, 4.0)
    index = int(
        np.argmax([np.linalg.norm(blurred.ground_truth([blurred.stamp_ns(k)]).omega_imu) for k in range(blurred.image_count)])
    )
    gradient = [np.abs(np.diff(s.exact_image(0, index), axis=1)).mean() for s in (blurred, sharp)]
    assert gradient[0] < 0.9 * gradient[1]
    assert blurred.exact_image(0, index).mean() == pytest.approx(sharp.exact_image(0, index).mean(), rel=0.02)


def test_exposure_follows_the_light_and_noise_the_exposure() -> None:
    rig = make_rig("mono", scale=0.125)
    scenario = replace(make_camera_scenario("room", 1, rig), light=Light(swing=0.6, period_s=4.0))
    simulation = CameraSimulation(scenario, 1, 12.0)
    means = [simulation.exact_image(0, k).mean() for k in range(0, simulation.image_count, 10)]
    assert 70.0 < np.mean(means) < 130.0 and np.std(means) < 25.0
    assert len({simulation.exposure(k)[0] for k in range(0, simulation.image_count, 10)}) > 10
    index = 40
    noise = np.array([CameraSimulation(scenario, 1, 12.0).image(0, index).pixels - simulation.exact_image(0, index)])
    gain = simulation.exposure(index)[1]
    expected = np.sqrt(
        simulation.exact_image(0, index) * gain / ELECTRONS_PER_GREY + (12.0 * gain / ELECTRONS_PER_GREY) ** 2 + 1 / 12
    )
    assert np.sqrt((noise**2).mean()) == pytest.approx(np.sqrt((expected**2).mean()), rel=0.05)


def test_the_same_seed_gives_the_same_bits_in_any_order() -> None:
    one, two = small(seed=3), small(seed=3)
    two.image(1, 60)
    assert (one.image(0, 60).pixels == two.image(0, 60).pixels).all()
    assert (one.image(0, 60).pixels != small(seed=4).image(0, 60).pixels).mean() > 0.5
    lidar = simulate("spin", 3)
    filmed = simulate_cameras("spin", 3)
    assert (filmed.scenario.world.solids == lidar.world.solids).all()
    samples = [s.imu.samples(s.start_ns, s.start_ns + 10**9, 5) for s in (filmed,)]
    assert (samples[0].gyro == lidar.imu_samples(lidar.start_ns, lidar.start_ns + 10**9, 5).gyro).all()


def test_wrong_numbers_are_refused() -> None:
    with pytest.raises(InputError, match="expected 4 coefficients of radtan – got 1 – give all of them"):
        Lens(intrinsics=(1.0, 1.0, 1.0, 1.0), distortion=(0.1,))
    with pytest.raises(InputError, match="an image from 0 to"):
        small().image(0, 10_000)
    with pytest.raises(InputError, match=r"name of a scenario – got 'roam' – did you mean room\? .*walk"):
        simulate_cameras("roam")
    with pytest.raises(InputError, match=r"a duration of at most 30\.0 s"):
        simulate_cameras("room", duration_s=100.0)


def test_a_scenario_of_ones_own(tmp_path: object) -> None:
    made = make_camera_scenario("room", 0)
    own = CameraScenario("mine", made.world, made.trajectory, make_rig("rgbd", scale=0.125))
    simulation = simulate_cameras(own, 5, duration_s=2.0)
    assert simulation.names == ["cam0", "depth"]
    depth = simulation.depth_image(3)
    assert depth.is_depth and depth.pixels.dtype == np.float32 and np.nanmin(depth.depth()) > 0.3
