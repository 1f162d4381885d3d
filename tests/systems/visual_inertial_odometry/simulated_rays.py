"""A rig that flies through a cloud of points: its IMU samples, and corners that need no images."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from boxplus import CameraImage, Pinhole, RadialTangential
from boxplus.manifolds import so3
from boxplus.residuals import ImuNoise
from boxplus.systems.visual_inertial_odometry import Rig, VioConfig, VioEstimate, VisualInertialOdometry
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.lines.tracking import LineFollower

NOISE = ImuNoise(gyro=1e-3, accel=1e-2, gyro_walk=1e-4, accel_walk=1e-3)
GRAVITY = np.array([0.0, 0.0, -9.81])
R_IMU_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along the IMU's x
REST_S = 1.3
RATE, IMAGE_EVERY = 200, 10
PIXEL_SIGMA = 0.5


def rig(cameras: int = 2, noise: ImuNoise = NOISE) -> Rig:
    """One or two cameras, 0.12 m apart, that look along the x of the IMU."""
    lens = RadialTangential(-0.28, 0.07, 2e-4, 1e-5)
    models = [Pinhole(458.0, 457.0, 376.0, 240.0, lens), Pinhole(457.0, 456.0, 380.0, 250.0, lens)]
    mountings = []
    for y in (0.06, -0.06):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R_IMU_CAMERA, [0.02, y, 0.01]
        mountings.append(T)
    return Rig.of(models[:cameras], mountings[:cameras], [(752, 480)] * cameras, noise)


@dataclass
class Flight:
    """True motion at the times of the IMU, and what the IMU measures.

    Attributes:
        time_ns, p, v, R: (N,), (N, 3), (N, 3), (N, 3, 3).
        gyro, accel: (N, 3) as measured; bias_gyro, bias_accel: (N, 3) what is wrong with them, beside noise.
    """

    seed: int
    seconds: float
    noise: ImuNoise = NOISE
    time_ns: NDArray[np.int64] = field(init=False)
    p: NDArray[np.float64] = field(init=False)
    v: NDArray[np.float64] = field(init=False)
    R: NDArray[np.float64] = field(init=False)
    gyro: NDArray[np.float64] = field(init=False)
    accel: NDArray[np.float64] = field(init=False)
    bias_gyro: NDArray[np.float64] = field(init=False)
    bias_accel: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, 1])
        count = int(self.seconds * RATE) + 1
        self.time_ns = 10**18 + np.arange(count) * (10**9 // RATE)
        fine = 10
        t = np.arange((count - 1) * fine + 1) / (RATE * fine)
        u = np.clip((t - REST_S) / 1.5, 0.0, 1.0)
        ramp = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)  # at rest first, then off smoothly
        waves = rng.uniform(0.4, 1.2, (2, 3)), rng.uniform(0.0, 2 * np.pi, (2, 3)), rng.uniform(0.4, 1.0, (2, 3))
        wave = [amplitude * (np.sin(w * t[:, None] + phase) - np.sin(phase)) for w, phase, amplitude in zip(*waves, strict=True)]
        p = ramp[:, None] * (wave[0] * [2.0, 2.0, 0.7])
        angle = ramp[:, None] * wave[1] * [0.25, 0.25, 1.2]
        R = so3.exp(angle * [0.0, 0.0, 1.0]) @ so3.exp(angle * [0.0, 1.0, 0.0]) @ so3.exp(angle * [1.0, 0.0, 0.0])
        h = t[1]
        v, a = np.gradient(p, h, axis=0), np.gradient(np.gradient(p, h, axis=0), h, axis=0)
        turn = so3.log(np.swapaxes(R[:-2], 1, 2) @ R[2:]) / (2.0 * h)
        omega = np.concatenate([turn[:1], turn, turn[-1:]])
        every = slice(None, None, fine)
        self.p, self.v, self.R = p[every], v[every], R[every]
        step = np.sqrt(1.0 / RATE)
        n = self.noise
        self.bias_gyro = rng.normal(size=3) * 0.02 + np.cumsum(rng.normal(size=(count, 3)) * n.gyro_walk * step, axis=0)
        self.bias_accel = rng.normal(size=3) * 0.05 + np.cumsum(rng.normal(size=(count, 3)) * n.accel_walk * step, axis=0)
        self.gyro = omega[every] + self.bias_gyro + rng.normal(size=(count, 3)) * n.gyro / step
        force = np.einsum("nji,nj->ni", self.R, a[every] - GRAVITY)
        self.accel = force + self.bias_accel + rng.normal(size=(count, 3)) * n.accel / step


class SimulatedTracker:
    """Sees points of a room around the origin: `FeatureTracker` without images.

    Args:
        dark: times [s] between which nothing is seen.
        moving: share of the points that move on their own, together, at 0.5 m/s, from 3 s on.
    """

    opencv_s = 0.0

    def __init__(
        self,
        flight: Flight,
        its: Rig,
        *,
        features: int = 120,
        sigma: float = PIXEL_SIGMA,
        dark: tuple[float, float] = (1e9, 1e9),
        moving: float = 0.0,
    ) -> None:
        self._flight, self._rig, self._sigma, self._features, self._dark = flight, its, sigma, features, dark
        self._rng = np.random.default_rng([flight.seed, 2])
        direction = self._rng.normal(size=(6000, 3)) * [1.0, 1.0, 0.4]
        self.points = direction / np.linalg.norm(direction, axis=1)[:, None] * self._rng.uniform(4.0, 9.0, (6000, 1))
        self._moves = self._rng.random(6000) < moving
        self._followed: dict[int, int] = {}  # point → id
        self._next_id = 0
        self._at = 0

    def _points(self) -> NDArray[np.float64]:
        late = max(0.0, self._at / RATE - 3.0)
        return self.points + np.where(self._moves[:, None], [0.0, 0.5 * late, 0.0], 0.0)

    def _project(self, camera: int, which: NDArray[np.intp]) -> NDArray[np.float64]:
        """(n, 2), NaN where not in the image."""
        mounted = self._rig.cameras[camera]
        R, p = self._flight.R[self._at], self._flight.p[self._at]
        body = (self._points()[which] - p) @ R
        pixels, seen = mounted.model.project((body - mounted.T_imu_camera[:3, 3]) @ mounted.T_imu_camera[:3, :3])
        inside = seen & ((pixels > 5.0) & (pixels < [mounted.width - 6.0, mounted.height - 6.0])).all(axis=1)
        return np.where(inside[:, None], pixels, np.nan)

    def _tracks(self, fresh: set[int]) -> Tracks:
        which = np.array(sorted(self._followed, key=self._followed.__getitem__), dtype=np.int64)
        ids = np.array([self._followed[int(k)] for k in which], dtype=np.int64)
        cameras = len(self._rig.cameras)
        pixels, rays = np.full((len(ids), cameras, 2), np.nan), np.full((len(ids), cameras, 3), np.nan)
        for camera in range(cameras):
            rng = np.random.default_rng([self._flight.seed, 3, self._at, camera])  # the same in `track` and `detect`
            noise = rng.normal(size=(len(self.points), 2)) * self._sigma
            pixels[:, camera] = self._project(camera, which) + noise[which]
            rays[:, camera], _ = self._rig.cameras[camera].model.unproject(pixels[:, camera])
        dark = not np.isfinite(pixels).any()
        motion = 0.0 if self._at / RATE < REST_S else 5.0
        time_ns = int(self._flight.time_ns[self._at])
        new = np.array([int(k) in fresh for k in ids], dtype=np.bool_)
        grey = np.full(cameras, 2.0 if dark else 100.0)
        return Tracks(time_ns, ids, pixels, rays, new, {}, motion, grey, 0.4 * grey)

    def track(self, time_ns: int, *_: object) -> Tracks:
        """See `FeatureTracker.track`."""
        self._at = int(np.searchsorted(self._flight.time_ns, time_ns))
        if self._is_dark():
            self._followed.clear()
        which = np.array(list(self._followed), dtype=np.int64)
        lost = ~np.isfinite(self._project(0, which)[:, 0]) | (self._rng.random(len(which)) < 0.01)
        for k in which[lost]:
            del self._followed[int(k)]
        return self._tracks(set())

    def detect(self, _: Tracks) -> Tracks:
        """See `FeatureTracker.detect`."""
        candidates = self._rng.permutation(len(self.points))
        visible = np.isfinite(self._project(0, candidates)[:, 0]) & ~np.isin(candidates, list(self._followed))
        fresh = set()
        room = 0 if self._is_dark() else self._features - len(self._followed)
        for k in candidates[visible][:room]:
            self._followed[int(k)] = self._next_id
            fresh.add(self._next_id)
            self._next_id += 1
        return self._tracks(fresh)

    def forget(self, ids: NDArray[np.int64]) -> None:
        """See `FeatureTracker.forget`."""
        for k in [k for k, n in self._followed.items() if n in set(ids.tolist())]:
            del self._followed[k]

    def _is_dark(self) -> bool:
        return self._dark[0] <= self._at / RATE < self._dark[1]


def run(
    flight: Flight,
    its: Rig,
    config: VioConfig,
    tracker: SimulatedTracker | None = None,
    silent: tuple[float, float] = (1e9, 1e9),
    line_tracker: LineFollower | None = None,
    late_ns: int = 0,
) -> tuple[VisualInertialOdometry, list[VioEstimate]]:
    """All of a flight through the odometry, but for the IMU samples between the two times `silent` [s].

    Stamps of each camera are `late_ns` later than those of the camera before.
    """
    vio = VisualInertialOdometry(config, its, tracker or SimulatedTracker(flight, its), line_tracker)
    blank = np.zeros((480, 752), np.uint8)
    estimates = []
    for k in range(0, len(flight.time_ns) - IMAGE_EVERY, IMAGE_EVERY):
        samples = np.array([n for n in range(k, k + IMAGE_EVERY) if not silent[0] <= n / RATE < silent[1]], dtype=np.int64)
        for camera in range(len(its.cameras)):
            stamp_ns = int(flight.time_ns[k]) + camera * late_ns
            estimates += vio.push_image(CameraImage(camera, f"cam{camera}", stamp_ns, blank))
        estimates += vio.push_imu(flight.time_ns[samples], flight.gyro[samples], flight.accel[samples])
    return vio, estimates + vio.flush()


def at(flight: Flight, estimate: VioEstimate) -> int:
    """Row of the flight at the time of an estimate."""
    return int(np.searchsorted(flight.time_ns, estimate.time_ns))


def yaw_of(R: NDArray[np.float64]) -> float:
    """Heading of the x axis [rad]."""
    return float(np.arctan2(R[1, 0], R[0, 0]))


def truth_relative_to_first(flight: Flight, first: VioEstimate, k: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """True attitude and position at row k, the world turned and moved so that yaw and position of the first estimate are true."""
    begin = at(flight, first)
    Z = so3.exp(np.array([0.0, 0.0, yaw_of(first.T_world_imu[:3, :3]) - yaw_of(flight.R[begin])]))
    return Z @ flight.R[k], Z @ (flight.p[k] - flight.p[begin]) + first.T_world_imu[:3, 3]
