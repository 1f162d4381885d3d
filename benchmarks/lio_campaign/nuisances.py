"""What every real recording has and a simulation leaves out: none of it is a fault, and a run over it has to be right or say so.

Each of them is drawn with a strength that sensors in use have; a recording gets one to three. They are laid upon the stream
of events before the fault is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Fault
from boxplus.simulation.faults import Event
from lio_campaign.judge import Truth

Random = np.random.Generator
_MOST = 3
_PERSON_RADIUS_M, _PERSON_HEIGHT_M = 0.3, 1.75
_PACKETS_PER_SCAN = 75
_NEIGHBOUR_COS = np.cos(np.deg2rad(2.0))


@dataclass(frozen=True)
class Scene:
    """What a nuisance may need to know of its recording.

    Attributes:
        truth: motion of the IMU.
        T_imu_lidar: (4, 4) the true mounting.
        channels: of a spinning LiDAR, whose points come one ring after the other, firing by firing; 1 of others.
        elevation_deg: of its lowest and highest ring.
    """

    truth: Truth
    T_imu_lidar: NDArray[np.float64]
    channels: int
    elevation_deg: tuple[float, float]


def draw_nuisances(scene: Scene, seed: int) -> tuple[Fault, str]:
    """One to three of them as one change of the events, and their names joined by "+"."""
    random = np.random.Generator(np.random.PCG64([seed, 4]))
    order = list(_MAKERS)
    names = sorted(map(str, random.choice(order, int(random.integers(1, _MOST + 1)), replace=False)), key=order.index)
    nuisance = _MAKERS[names[0]](scene, random)
    for name in names[1:]:
        nuisance = nuisance.then(_MAKERS[name](scene, random))
    return nuisance, "+".join(names)


def changes(
    name: str,
    text: str,
    scan: Callable[[Scan], Scan | None] | None = None,
    imu: Callable[[ImuSamples], ImuSamples] | None = None,
) -> Fault:
    """A change of every scan and every block of samples; None leaves one out."""

    def events(incoming: Iterable[Event]) -> Iterator[Event]:
        for event in incoming:
            if isinstance(event, Scan):
                changed: Event | None = event if scan is None else scan(event)
            else:
                changed = event if imu is None else imu(event)
            if changed is not None and (isinstance(changed, Scan) or len(changed)):
                yield changed

    return Fault(name, text, events)


def moved(scan: Scan, p_lidar: NDArray[np.floating], keep: NDArray[np.bool_] | None = None) -> Scan:
    """The scan with other points, and of these only some; the sweep's ends stay."""
    other = replace(scan, p_lidar=p_lidar.astype(np.float32))
    return other if keep is None else other.where(keep)


def rays(scene: Scene, scan: Scan) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Where the rays of a scan began (N, 3) and went (N, 3), in the world, and how far (N,) [m]."""
    truth, T = scene.truth, scene.T_imu_lidar
    motion = truth.ground_truth(np.clip(scan.time_ns, truth.start_ns, truth.end_ns))
    p = scan.p_lidar.astype(np.float64)
    ranges = np.linalg.norm(p, axis=1)
    direction = np.einsum("nij,nj->ni", motion.R_world_imu @ T[:3, :3], p / ranges[:, None])
    return motion.R_world_imu @ T[:3, 3] + motion.p_world_imu, direction, ranges


def _seeded(random: Random) -> Callable[[int], Random]:
    """A generator for every scan or block by its time: a stream that is read twice is the same twice."""
    seed = int(random.integers(1 << 62))
    return lambda time_ns: np.random.Generator(np.random.PCG64([seed, time_ns & ((1 << 62) - 1)]))


def _dropouts(scene: Scene, random: Random) -> Fault:
    """Dark or wet surfaces give nothing back, drops of rain do."""
    lost, drops, at = float(random.uniform(0.1, 0.5)), float(random.uniform(0.002, 0.02)), _seeded(random)

    def scan(scan: Scan) -> Scan:
        chance = at(scan.start_ns)
        keep = chance.uniform(size=len(scan)) > lost
        wet = chance.uniform(size=len(scan)) < drops
        shorter = np.where(wet, chance.uniform(0.1, 1.0, len(scan)), 1.0)
        return moved(scan, scan.p_lidar * shorter[:, None], keep)

    return changes("dropouts", f"{100 * lost:.0f} % of the returns lost, {100 * drops:.1f} % rain", scan)


def _mixed_pixels(scene: Scene, random: Random) -> Fault:
    """Beams that meet two surfaces give a range between both."""
    share, at = float(random.uniform(0.3, 0.8)), _seeded(random)

    def scan(scan: Scan) -> Scan:
        if len(scan) <= scene.channels:
            return scan
        p = scan.p_lidar.astype(np.float64)
        ranges = np.linalg.norm(p, axis=1)
        other = np.roll(p, -scene.channels, axis=0)
        other_range = np.roll(ranges, -scene.channels)
        near = np.sum(p * other, axis=1) > _NEIGHBOUR_COS * ranges * other_range
        chance = at(scan.start_ns)
        edge = near & (np.abs(other_range - ranges) > 0.3) & (chance.uniform(size=len(p)) < share)
        part = np.where(edge, chance.uniform(size=len(p)), 0.0)
        return moved(scan, p * ((ranges + part * (other_range - ranges)) / ranges)[:, None])

    return changes("mixed_pixels", f"{100 * share:.0f} % of the beams at edges mixed", scan)


def _beams(scene: Scene, random: Random) -> Fault:
    """Every laser has a range offset of its own, and looks a little elsewhere than it should."""
    count, (low, high) = scene.channels, np.deg2rad(scene.elevation_deg)
    offset_m = random.normal(0.0, random.uniform(0.005, 0.02), count)
    offset_rad = np.deg2rad(random.normal(0.0, random.uniform(0.01, 0.06), count))

    def scan(scan: Scan) -> Scan:
        p = scan.p_lidar.astype(np.float64)
        level, ranges = np.hypot(p[:, 0], p[:, 1]), np.linalg.norm(p, axis=1)
        elevation = np.arctan2(p[:, 2], level)
        laser = np.zeros(len(p), int)
        if count > 1:
            laser = np.clip(np.rint((elevation - low) / (high - low) * (count - 1)), 0, count - 1).astype(int)
        elevation, longer = elevation + offset_rad[laser], ranges + offset_m[laser]
        azimuth = np.arctan2(p[:, 1], p[:, 0])
        across = longer * np.cos(elevation)
        return moved(scan, np.stack([across * np.cos(azimuth), across * np.sin(azimuth), longer * np.sin(elevation)], axis=1))

    text = f"lasers off by {100 * offset_m.std():.1f} cm and {np.rad2deg(offset_rad.std()):.2f} deg"
    return changes("beams", text, scan)


def _people(scene: Scene, random: Random) -> Fault:
    """People walk about near the sensor."""
    count, speed = int(random.integers(1, 6)), float(random.uniform(0.4, 1.6))
    truth = scene.truth
    begin_ns = truth.start_ns
    span_s = (truth.end_ns - begin_ns) * 1e-9
    instants = begin_ns + np.linspace(0, truth.end_ns - begin_ns, 50).astype(np.int64)
    way = truth.ground_truth(instants).p_world_imu
    where = way[random.integers(0, len(way), count), :2] + random.uniform(-4.0, 4.0, (count, 2))
    course = random.uniform(0.0, 2.0 * np.pi, count)
    feet = float(way[:, 2].min() - 1.6)
    turns = random.uniform(-0.5, 0.5, count)

    def centres(time_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """(N, count, 2): circles of a few metres, so that they stay near."""
        s = (time_ns[:, None] - begin_ns) * 1e-9 - 0.5 * span_s
        angle, rate = course + turns * s, np.where(np.abs(turns) < 0.1, 0.1, turns)
        circle: NDArray[np.float64] = where + speed / np.abs(rate)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return circle

    def scan(scan: Scan) -> Scan:
        if not len(scan):
            return scan
        p = scan.p_lidar.astype(np.float64)
        origin, direction, ranges = rays(scene, scan)
        seen = ranges.copy()
        centre = centres(scan.time_ns)
        for person in range(count):
            away = origin[:, :2] - centre[:, person]
            a = np.sum(direction[:, :2] ** 2, axis=1)
            b = np.sum(away * direction[:, :2], axis=1)
            c = np.sum(away**2, axis=1) - _PERSON_RADIUS_M**2
            inside = b**2 - a * c
            with np.errstate(invalid="ignore", divide="ignore"):
                hit = (-b - np.sqrt(inside)) / a
            height = origin[:, 2] + hit * direction[:, 2] - feet
            meets = (inside > 0) & (hit > 0.3) & (hit < seen) & (height > 0) & (height < _PERSON_HEIGHT_M) & (c > 0)
            seen = np.where(meets, hit, seen)
        return moved(scan, p * (seen / ranges)[:, None])

    return changes("people", f"{count} people at {speed:.1f} m/s", scan)


def _carrier(scene: Scene, random: Random) -> Fault:
    """Something that moves along with the sensor, a mast or who carries it, stands in its view."""
    widest = 60.0 if scene.channels > 1 else 20.0  # of a narrow view not more than a quarter
    course, width = float(random.uniform(-np.pi, np.pi)), float(np.deg2rad(random.uniform(15.0, widest)))
    distance, at = float(random.uniform(0.55, 1.2)), _seeded(random)

    def scan(scan: Scan) -> Scan:
        p = scan.p_lidar.astype(np.float64)
        ranges = np.linalg.norm(p, axis=1)
        azimuth = np.arctan2(p[:, 1], p[:, 0])
        towards = course if scene.channels > 1 else 0.08 * course  # a narrow view looks along +x
        hit = np.abs(np.angle(np.exp(1j * (azimuth - towards)))) < 0.5 * width
        nearer = distance + at(scan.start_ns).normal(0.0, 0.03, len(p))
        return moved(scan, np.where(hit[:, None], p / ranges[:, None] * nearer[:, None], p))

    return changes("carrier", f"{np.rad2deg(width):.0f} deg of the view covered at {distance:.1f} m", scan)


def _tails(scene: Scene, random: Random) -> Fault:
    """Ranges with heavy tails, in steps."""
    share, step, at = float(random.uniform(0.01, 0.05)), float(random.choice((0.001, 0.004, 0.01))), _seeded(random)

    def scan(scan: Scan) -> Scan:
        p = scan.p_lidar.astype(np.float64)
        ranges, chance = np.linalg.norm(p, axis=1), at(scan.start_ns)
        off = np.where(chance.uniform(size=len(p)) < share, chance.normal(0.0, 0.15, len(p)), 0.0)
        measured = np.rint((ranges + off) / step) * step
        return moved(scan, p * (measured / ranges)[:, None], measured > 0.3)

    return changes("tails", f"{100 * share:.0f} % of the ranges off by 15 cm, steps of {1000 * step:.0f} mm", scan)


def _jitter(scene: Scene, random: Random) -> Fault:
    """A host stamps what arrives: scans and samples come a little late, each by another time."""
    scan_s, imu_s, at = float(random.uniform(0.0002, 0.001)), float(random.uniform(0.0001, 0.0005)), _seeded(random)

    def scan(scan: Scan) -> Scan:
        return scan.shifted(round(1e9 * scan_s * min(float(at(scan.start_ns).exponential()), 4.0)))

    def imu(samples: ImuSamples) -> ImuSamples:
        if len(samples) < 2:
            return samples
        late = at(int(samples.time_ns[0])).exponential(imu_s * 1e9, len(samples)).astype(np.int64)
        step = int(np.diff(samples.time_ns).min())
        return replace(samples, time_ns=np.sort(samples.time_ns + np.minimum(late, max(step - 1, 0))))

    return changes("jitter", f"scans {1000 * scan_s:.1f} ms late on average, samples {1000 * imu_s:.1f} ms", scan, imu)


def _losses(scene: Scene, random: Random) -> Fault:
    """A network loses single samples, packets of points and, seldom, a scan."""
    samples_lost, packets_lost = float(random.uniform(0.001, 0.01)), float(random.uniform(0.002, 0.03))
    scans_lost, at = float(random.uniform(0.0, 0.02)), _seeded(random)

    def scan(scan: Scan) -> Scan | None:
        chance = at(scan.start_ns)
        if chance.uniform() < scans_lost:
            return None
        gone = chance.uniform(size=_PACKETS_PER_SCAN) < packets_lost
        span = max(scan.end_ns - scan.start_ns, 1)
        packet = np.clip((scan.time_ns - scan.start_ns) * _PACKETS_PER_SCAN // span, 0, _PACKETS_PER_SCAN - 1)
        return moved(scan, scan.p_lidar, ~gone[packet])

    def imu(samples: ImuSamples) -> ImuSamples:
        keep = at(int(samples.time_ns[0])).uniform(size=len(samples)) > samples_lost
        return ImuSamples(samples.time_ns[keep], samples.gyro[keep], samples.accel[keep])

    percent = [f"{100.0 * share:.1f} %" for share in (samples_lost, packets_lost, scans_lost)]
    text = "of the samples {}, of the packets {}, of the scans {} lost".format(*percent)
    return changes("losses", text, scan, imu)


def _imu_errors(scene: Scene, random: Random) -> Fault:
    """An IMU as it comes from the factory: axes not square, scales not one, readings in steps, a filter that delays."""
    gyro_axes, accel_axes = _axes(random, 0.005), _axes(random, 0.005)
    gyro_step, accel_step = float(random.choice((1e-5, 1e-3))), float(random.choice((1e-4, 5e-3, 0.01)))
    delay_s = float(random.choice((0.0, 0.001, 0.003)))

    def imu(samples: ImuSamples) -> ImuSamples:
        gyro = np.rint(samples.gyro @ gyro_axes.T / gyro_step) * gyro_step
        accel = np.rint(samples.accel @ accel_axes.T / accel_step) * accel_step
        return ImuSamples(samples.time_ns + round(delay_s * 1e9), gyro, accel)

    return changes(
        "imu_errors",
        f"IMU not calibrated, steps of {gyro_step:g} rad/s and {accel_step:g} m/s², {1000 * delay_s:.0f} ms late",
        imu=imu,
    )


def _axes(random: Random, sigma: float) -> NDArray[np.float64]:
    """(3, 3) scales and axes off by `sigma`."""
    axes: NDArray[np.float64] = so3.exp(random.normal(0.0, sigma, 3)) @ (np.eye(3) + np.tril(random.normal(0.0, sigma, (3, 3))))
    return axes


_MAKERS: dict[str, Callable[[Scene, Random], Fault]] = {
    "people": _people,
    "carrier": _carrier,
    "mixed_pixels": _mixed_pixels,
    "beams": _beams,
    "tails": _tails,
    "dropouts": _dropouts,
    "losses": _losses,
    "jitter": _jitter,
    "imu_errors": _imu_errors,
}
"""From the scene to the computer: in this order they are laid upon each other."""
