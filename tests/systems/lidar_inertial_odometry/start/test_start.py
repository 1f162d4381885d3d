"""The first state at rest and in motion, and what is said when there is none yet.

Derivation: docs/lidar_inertial_odometry.md, section 10.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import Frame
from boxplus.simulation import ImuModel, Scenario, Simulation, SpinningLidar, simulate
from boxplus.simulation.faults import flip_accel
from boxplus.simulation.motions import manoeuvres, trajectories
from boxplus.simulation.motions.spline import SplineTrajectory, Trajectory
from boxplus.simulation.motions.trajectories import START_NS, control_times, from_angles
from boxplus.simulation.worlds import sites, worlds
from boxplus.simulation.worlds.world import World, box
from boxplus.systems.lidar_inertial_agreement.rest import Rest
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.lidar_inertial_odometry.start import start as start_module
from boxplus.systems.lidar_inertial_odometry.start.start import Start, find_start
from tests.systems.lidar_inertial_odometry.small_drives import LIDAR, before_a_wall, config, frames, room_walk, run, turning_by


def _angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1.0, 1.0))))


@pytest.mark.parametrize("gravity_aligned", [True, False])
def test_at_rest(gravity_aligned: bool) -> None:
    simulation = simulate("at_rest", duration_s=1.6, lidar=LIDAR)
    found = find_start(frames(simulation.events()), config(simulation, gravity_aligned=gravity_aligned))
    assert isinstance(found, Start)
    assert found.kind == "static"
    assert found.text.startswith("at rest: gyro std ")
    state = found.state
    true_bias = simulation.scenario.imu.gyro_bias
    assert np.allclose(state.bias_gyro, true_bias, atol=5e-4)
    assert not state.v_world_imu.any()
    assert not state.p_world_imu.any()
    down_imu = state.R_world_imu.T @ state.gravity_world
    assert _angle_deg(down_imu, np.array([0.0, 0.0, -1.0])) < 0.5
    assert np.isclose(np.linalg.norm(state.gravity_world), 9.81)
    if gravity_aligned:
        assert np.allclose(state.gravity_world, [0.0, 0.0, -9.81], atol=1e-12)
    else:
        assert np.array_equal(state.R_world_imu, np.eye(3))
    assert np.linalg.eigvalsh(found.covariance).min() > 0
    # The reading at rest is explained: Rᵀ g + a_m − b_a = 0.
    reading = np.concatenate([f.imu.accel for f in frames(simulation.events())]).mean(axis=0)
    assert np.allclose(reading - state.bias_accel + down_imu, 0, atol=0.01)


@pytest.mark.slow
def test_moving() -> None:
    simulation = simulate("moving_start", duration_s=1.6)
    found = find_start(frames(simulation.events()), config(simulation))
    assert isinstance(found, Start)
    assert found.kind == "moving"
    assert "moving at 1" in found.text
    truth = simulation.ground_truth(np.array([found.time_ns]))
    # The heading is free: compare in the IMU's own frame.
    v_imu = found.state.R_world_imu.T @ found.state.v_world_imu
    assert np.linalg.norm(v_imu - truth.R_world_imu[0].T @ truth.v_world_imu[0]) < 0.3
    down_imu = found.state.R_world_imu.T @ found.state.gravity_world
    assert _angle_deg(down_imu, truth.R_world_imu[0].T @ np.array([0.0, 0.0, -9.81])) < 1.0
    assert np.isclose(np.linalg.norm(found.state.gravity_world), 9.81)


@pytest.mark.parametrize("voxel", [0.15, 0.5])
def test_a_speed_that_the_surroundings_do_not_show_is_no_start(voxel: float) -> None:
    # At 10 m/s through a smooth tube: rings that go along with the LiDAR look like rest, along the axis only.
    drive = trajectories.drive(((-100.0, 0.0), (60.0, 0.0)), speed=10.0, height=1.0).starting_at(8.0)
    lidar = SpinningLidar(channels=16, azimuth_steps=720)
    simulation = simulate(Scenario("tube", sites.tunnel(400.0), drive, lidar), duration_s=1.6)
    refusal = find_start(frames(simulation.events()), config(simulation, scan_voxel=voxel, map_cell=max(voxel, 0.25)))
    assert isinstance(refusal, str)
    assert "the surroundings do not show whether the platform moves along (" in refusal
    named = np.array([float(value) for value in refusal.split("along (")[1].split(")")[0].split(",")])
    axis = simulation.T_imu_lidar[:3, :3].T @ simulation.ground_truth([simulation.start_ns]).R_world_imu[0].T[:, 0]
    assert abs(named @ axis) > 0.99


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "kind"), [(20.0, "moving"), (0.0, "static")])
def test_a_street_that_looks_alike_at_rest_is_searched_for_a_speed(speed: float, kind: str) -> None:
    """At 20 m/s walls and rings look the same from scan to scan, and a registration from rest stays there."""
    lidar = SpinningLidar(channels=32, azimuth_steps=512, vertical_fov_deg=(-25.0, 15.0))
    drive = manoeuvres.constant_velocity(2.6, (-90.0, 0.3, 1.5), (speed, 0.0, 0.0), so3.exp(np.array([0.02, -0.01, 0.3])))
    simulation = simulate(Scenario("street", sites.street(seed=0), drive, lidar, T_imu_lidar=np.eye(4)), 0, duration_s=1.6)
    found = find_start(frames(simulation.events())[:11], config(simulation))
    assert isinstance(found, Start) and found.kind == kind
    assert np.linalg.norm(found.state.v_world_imu) == pytest.approx(speed, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "speed", "kind"),
    [(0, 22.0, "moving"), (2, 0.0, "static")],
)
def test_on_a_highway_what_stands_tells_rest_from_motion(seed: int, speed: float, kind: str) -> None:
    """At rest the second one's registrations leave the way open, and posts close it."""
    lidar = SpinningLidar(channels=32, azimuth_steps=512, vertical_fov_deg=(-25.0, 15.0))
    drive = manoeuvres.constant_velocity(2.6, (40.0 * seed, 0.3, 1.8), (speed, 0.0, 0.0), so3.exp(np.array([0.02, -0.01, 0.3])))
    scenario = Scenario("highway", sites.highway(500.0, seed=seed), drive, lidar, T_imu_lidar=np.eye(4))
    simulation = simulate(scenario, duration_s=1.4)
    found = find_start(frames(simulation.events()), config(simulation))
    assert isinstance(found, Start)
    assert found.kind == kind
    assert not found.warning and not len(found.unshown_axes)
    if kind == "moving":
        assert abs(np.linalg.norm(found.state.v_world_imu) - speed) < 0.5


def among_traffic(seconds: float, vibration: float = 0.0) -> tuple[list[Frame], Simulation]:
    """At rest on a highway, vehicles of about one speed and direction on two lanes either side."""
    random = np.random.default_rng(22)
    lidar = SpinningLidar(channels=32, azimuth_steps=512, vertical_fov_deg=(-25.0, 15.0))
    rest, imu = (
        trajectories.at_rest(seconds + 1.0, (0.0, 0.0, 1.8)),
        ImuModel(accel_vibration=10.0 * vibration, gyro_vibration=vibration),
    )
    road = list(sites.highway(400.0, seed=22).solids)
    x, lane = random.uniform(-80.0, 60.0, 20), random.choice([-7.2, -3.6, 3.6, 7.2], 20)
    length, speed = random.uniform(4.0, 16.0, 20), 16.0 * random.uniform(0.97, 1.03, 20)
    height = np.where(length > 8.0, 4.0, 1.6)

    def scene(instant_s: float) -> Simulation:
        ahead = x + speed * instant_s
        vehicles = [box((ahead[i], lane[i], 0.5 * height[i] + 0.3), (length[i], 2.4, height[i])) for i in range(20)]
        return Simulation(Scenario("traffic", World([*road, *vehicles]), rest, lidar, imu, np.eye(4)), 22, seconds)

    first = scene(0.0)
    scans = [scene(0.1 * k).scan(k) for k in range(first.scan_count)]
    return frames([*(event for event in first.events() if isinstance(event, ImuSamples)), *scans]), first


@pytest.mark.slow
def test_rest_among_much_that_changes_waits_and_is_then_said_to_be_in_doubt() -> None:
    seen, simulation = among_traffic(3.4)
    refusal = find_start(seen[:12], config(simulation))
    assert isinstance(refusal, str) and "the surroundings do not show" in refusal
    found = find_start(seen, config(simulation))
    assert isinstance(found, Start) and found.kind == "static"
    assert found.doubted and len(found.unshown_axes) == 1
    assert "changes from scan to scan" in found.warning and "taken as at rest" in found.warning


@pytest.mark.slow
def test_a_shaken_platform_among_much_that_changes_is_no_start() -> None:
    """Neither at rest, for its IMU is not quiet, nor moving at next to nothing."""
    seen, simulation = among_traffic(3.4, vibration=0.3)
    assert isinstance(find_start(seen, config(simulation)), str)


@pytest.mark.slow
def test_a_shaken_drive_whose_way_is_open_is_no_start_at_no_speed() -> None:
    """What vibration leaves of the means is none of motion: at rest, as far as anything shows, and that is said."""
    lidar = SpinningLidar(rate_hz=20.0, channels=64, azimuth_steps=512, vertical_fov_deg=(-22.5, 22.5))
    drive = manoeuvres.constant_velocity(4.0, (-60.0, 0.5, 1.8), (7.3, 0.0, 0.0), manoeuvres.level(0.4))
    found = {}
    for vibration in (1.0, 6.0):
        imu = ImuModel(accel_vibration=vibration, gyro_vibration=0.05 * vibration)
        scenario = Scenario("highway", sites.highway(900.0, seed=439), drive, lidar, imu, np.eye(4))
        simulation = Simulation(scenario, 439, 2.0)
        found[vibration] = find_start(frames(simulation.events()), config(simulation))
    said, refused = found[1.0], found[6.0]
    assert isinstance(said, Start) and len(said.unshown_axes) == 1 and "taken as at rest" in said.warning
    assert isinstance(refused, str) and "whether the platform moves along (" in refused


@pytest.mark.slow
@pytest.mark.parametrize("seen", [8, 17])
@pytest.mark.parametrize("seed", [1, 3, 4])
def test_a_slow_hand_in_an_open_field_starts_though_nothing_faces_it(seed: int, seen: int) -> None:
    """As soon as it did without asking what does."""
    motion = manoeuvres.handheld(4.5, (-3.0, -1.0, 1.0), (3.0, 1.0, 2.0), 0.4, 1.5, standstill_s=0.0, seed=seed)
    lidar = SpinningLidar(channels=16, azimuth_steps=250)
    simulation = Simulation(Scenario("field", sites.open_field(seed=seed), motion, lidar), seed, 3.2)
    found = find_start(frames(simulation.events())[:seen], config(simulation))
    refused_for_it = isinstance(found, str) and "whether the platform moves along (" in found
    assert not refused_for_it and (isinstance(found, Start) or seen == 8)


@pytest.mark.slow
@pytest.mark.parametrize("range_sigma_m", [0.01, 0.03])
def test_a_path_that_creeps_along_a_smooth_tunnel_is_no_start_in_motion(
    range_sigma_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it does where others overtake: nothing faces the way, so that it stays where it is at any speed."""
    lidar = SpinningLidar(channels=32, azimuth_steps=512, range_sigma_m=range_sigma_m)
    drive = manoeuvres.constant_velocity(3.0, (0.0, 0.2, 1.8), (20.0, 0.0, 0.0), np.eye(3))
    imu = ImuModel(accel_vibration=0.9, gyro_vibration=0.02, vibration_hz=60.0)
    simulation = Simulation(Scenario("tunnel", sites.tunnel(600.0), drive, lidar, imu, np.eye(4)), 5, 1.2)
    creeping = Rest(False, np.zeros((0, 3)), np.zeros((0, 3)), 0.033, 0.0)
    monkeypatch.setattr(start_module, "judge_rest", lambda *_: creeping)
    refused = find_start(frames(simulation.events()), config(simulation))
    assert isinstance(refused, str) and "the surroundings do not show whether the platform moves along (" in refused


@pytest.mark.slow
@pytest.mark.parametrize(("width", "speed"), [(8.0, 10.0), (11.0, 8.0)])
def test_a_drive_in_a_narrow_street_is_no_traffic(width: float, speed: float) -> None:
    drive = manoeuvres.constant_velocity(3.0, (-40.0, 0.3, 1.5), (speed, 0.0, 0.0), np.eye(3))
    street = Scenario("street", sites.street(width=width, seed=0), drive, SpinningLidar(azimuth_steps=900), T_imu_lidar=np.eye(4))
    simulation = Simulation(street, 0, 1.4)
    found = find_start(frames(simulation.events()), config(simulation))
    assert isinstance(found, Start) and found.kind == "moving"
    assert abs(np.linalg.norm(found.state.v_world_imu) - speed) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "speed"), [(302, 26.0), (310, 26.0), (328, 20.0)])
def test_drives_on_highways_start_as_drives(seed: int, speed: float) -> None:
    lidar = SpinningLidar(azimuth_steps=900)
    drive = manoeuvres.constant_velocity(5.0, (-20.0, 0.5, 1.8), (speed, 0.0, 0.0), manoeuvres.level(0.4))
    simulation = Simulation(Scenario("highway", sites.highway(500.0, seed=seed), drive, lidar, T_imu_lidar=np.eye(4)), seed, 2.0)
    odometry = LidarInertialOdometry(config(simulation))
    run(odometry, simulation.events())
    assert odometry.start is not None and odometry.start.kind == "moving"
    assert abs(np.linalg.norm(odometry.start.state.v_world_imu) - speed) < 0.5


@pytest.mark.parametrize(("reach_m", "bias"), [(0.6, 0.0), (0.9, 0.0), (0.6, 0.015)])
def test_a_wall_at_arms_length_shows_rest(reach_m: float, bias: float) -> None:
    first, settings = before_a_wall(reach_m)
    found = find_start(turning_by(first, np.full(3, bias)), settings)
    assert isinstance(found, Start) and found.kind == "static"


@pytest.mark.parametrize("rate", [0.07, 0.7])
def test_a_turn_that_a_wall_does_not_show_is_no_rest(rate: float) -> None:
    """About the normal of the wall nothing but the gyroscope tells: at 4 deg/s it turns, at 40 nothing is wrong with it."""
    first, settings = before_a_wall(0.6)
    refusal = find_start(turning_by(first, np.array([rate, 0.0, 0.0])), settings)
    assert isinstance(refusal, str)
    assert "the surroundings do not show" in refusal


def _shaken(frame: Frame, seed: int) -> Frame:
    noise = np.random.default_rng(seed).normal(size=frame.imu.accel.shape)
    return replace(frame, imu=ImuSamples(frame.imu.time_ns, frame.imu.gyro + 0.3 * noise, frame.imu.accel + 3.0 * noise))


@pytest.mark.slow
@pytest.mark.parametrize("swing", [0.4, 0.3, 0.2])
def test_a_swing_that_ends_as_it_began_is_no_rest(swing: float) -> None:
    """To and fro about the vertical, once while the start is watched."""
    time = control_times(3.0, 0.04)
    yaw = swing * np.sin(2.0 * np.pi * 0.9 * time + 0.3)
    R = from_angles(0.0 * yaw, 0.0 * yaw, yaw)
    motion = SplineTrajectory(START_NS, 0.04, R, np.array([-3.0, -2.0, 1.5]) + R @ np.array([-0.3, 0.0, 0.0]))
    simulation = Simulation(Scenario("swing", worlds.room((24.0, 20.0, 5.0)), motion, LIDAR, ImuModel(), np.eye(4)), 0, 1.6)
    found = find_start(frames(simulation.events()), config(simulation))
    assert isinstance(found, Start) and found.kind == "moving"


def test_too_few_scans_in_motion_are_refused_with_the_evidence() -> None:
    simulation = room_walk(6.0)
    refusal = find_start(frames(simulation.events())[40:44], config(simulation))
    assert isinstance(refusal, str)
    assert refusal.startswith("not at rest (gyro std ")
    assert refusal.endswith("and 4 scans are not enough for a moving start; waiting for more data")


def _steady(motion: Trajectory, imu: ImuModel | None = None) -> Simulation:
    return Simulation(Scenario("steady", worlds.room((24.0, 20.0, 5.0)), motion, LIDAR, imu or ImuModel()), 0, 1.4)


def test_an_accelerometer_that_does_not_show_how_the_lidar_swings_is_refused() -> None:
    """The LiDAR swings by half a metre, and the IMU is that of a platform at rest; with its own, the same scans are a start."""
    centre = np.array([-3.0, -2.0, 1.5])
    swinging = _steady(manoeuvres.handheld(2.0, centre - 0.25, centre + 0.25, 2.0, 0.05, standstill_s=0.0))
    other = _steady(trajectories.at_rest(2.0, tuple(centre)))
    scans = [event for event in swinging.events() if isinstance(event, Scan)]
    refusal = find_start(frames([*(e for e in other.events() if isinstance(e, ImuSamples)), *scans]), config(swinging))
    assert isinstance(refusal, str)
    named = re.search(r", and LiDAR and IMU do not fit better than (\d+\.\d) cm; waiting for more data$", refusal)
    assert named is not None and 5.0 < float(named[1]) < 50.0
    sound = find_start(frames(swinging.events()), config(swinging))
    assert isinstance(sound, Start) and sound.kind == "moving"


@pytest.mark.parametrize(("bias", "starts"), [(0.2, True), (1.0, False)])
def test_a_moving_start_that_asks_for_a_bias_that_no_accelerometer_in_order_has_is_refused(bias: float, starts: bool) -> None:
    motion = manoeuvres.constant_velocity(2.0, (-5.0, -2.0, 1.5), (1.2, 0.0, 0.0), np.eye(3))
    simulation = _steady(motion, ImuModel(accel_bias=(0.0, 0.0, bias)))
    found = find_start(frames(simulation.events()), config(simulation))
    assert isinstance(found, Start) == starts
    if isinstance(found, str):
        named = re.search(r"the path of the LiDAR asks for a bias of the accelerometer of (\d\.\d\d) m/s²", found)
        assert named is not None and 0.4 < float(named[1]) < 1.1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_an_accelerometer_with_the_opposite_sign_is_named_in_motion(seed: int) -> None:
    """The path of a lively hand fits it to millimetres one way, to centimetres the other; of a sound one nothing is said."""
    motion = manoeuvres.handheld(3.0, (-4.0, -3.0, 0.5), (-2.0, -1.0, 2.5), 2.0, 0.3, standstill_s=0.0, seed=seed)
    simulation = _steady(motion)
    sound = find_start(frames(simulation.events()), config(simulation))
    flipped = find_start(frames(flip_accel().events(simulation.events())), config(simulation))
    assert isinstance(sound, Start) and sound.kind == "moving"
    assert isinstance(flipped, str) and "with the accelerometer's sign flipped" in flipped


def test_scans_that_do_not_overlap_are_refused() -> None:
    simulation = room_walk(1.5)
    apart = []
    for index, frame in enumerate(frames(simulation.events())):
        scan = Scan.from_arrays(frame.scan.p_lidar + np.float32(100.0 * index), frame.scan.time_ns)
        apart.append(replace(_shaken(frame, index), scan=scan))
    refusal = find_start(apart, config(simulation))
    assert isinstance(refusal, str)
    assert refusal.startswith("the first scans do not overlap enough to see whether they move (gyro std ")


def test_what_went_astray_at_first_does_not_forbid_a_start_from_the_newest_scans() -> None:
    simulation = simulate("at_rest", duration_s=2.6, lidar=LIDAR)
    seen = frames(simulation.events())
    astray = [Scan.from_arrays(f.scan.p_lidar + np.float32(100.0 * k), f.scan.time_ns) for k, f in enumerate(seen[:10], 1)]
    events = [replace(f, scan=scan) for f, scan in zip(seen[:10], astray, strict=True)] + seen[10:]
    found = find_start(events, config(simulation))
    assert isinstance(found, Start) and found.kind == "static"
    begins = [f.scan.end_ns for f in events].index(found.time_ns)
    assert 10 <= begins <= len(events) - 8
    odometry = LidarInertialOdometry(config(simulation))
    scans = [*astray, *(f.scan for f in seen[10:])]
    estimates = odometry.push_imu(ImuSamples.joined(f.imu for f in seen))
    for scan in scans:
        estimates += odometry.push_scan(scan)
    estimates += odometry.flush()
    # Every scan has an estimate or is counted.
    assert odometry.start is not None and estimates[0].time_ns == odometry.start.time_ns
    assert odometry.counters["scan before a start could be found"] + len(estimates) == len(scans)


def test_a_shaken_platform_is_at_rest_when_the_lidar_rests() -> None:
    simulation = room_walk(1.5)
    shaken = [_shaken(frame, seed) for seed, frame in enumerate(frames(simulation.events()))]
    found = find_start(shaken, config(simulation))
    assert isinstance(found, Start) and found.kind == "static"
    still = find_start(frames(simulation.events()), config(simulation))
    assert isinstance(still, Start)
    # The mean of shaken samples is less well known, and the state says so.
    assert found.covariance[15, 15] > 1.5 * still.covariance[15, 15]


@pytest.mark.parametrize("scale", [0.0, 0.02])
def test_an_accelerometer_without_gravity_is_refused(scale: float) -> None:
    """All zero, or with gravity taken out by a driver: nothing says where up is."""
    simulation = simulate("walk", duration_s=1.6, lidar=LIDAR)
    odometry = LidarInertialOdometry(config(simulation))
    with pytest.raises(InputError, match=r"expected accelerations with gravity, about 9.8 m/s² .* – got 0\.\d+ m/s² – "):
        for event in simulation.events():
            if isinstance(event, Scan):
                odometry.push_scan(event)
            else:
                odometry.push_imu(ImuSamples.from_arrays(event.time_ns, event.gyro, scale * event.accel))


def test_a_gyroscope_that_turns_the_other_way_is_told_from_one_in_other_units() -> None:
    """On the spot at 90 deg/s: reversed, both turns cancel; three times as fast, they do not."""
    simulation = simulate("spin", duration_s=3.0, lidar=LIDAR)
    turning = frames(simulation.events())[-9:]
    refusals = []
    for factor in (-1.0, 3.0):
        seen = [replace(f, imu=ImuSamples(f.imu.time_ns, factor * f.imu.gyro, f.imu.accel)) for f in turning]
        refusals.append(find_start(seen, config(simulation)))
    assert all(isinstance(refusal, str) for refusal in refusals)
    assert "in opposite senses" in str(refusals[0])
    assert "opposite" not in str(refusals[1])


def test_a_mounting_that_is_tilted_is_told_from_a_unit() -> None:
    """On the spot at 90 deg/s, with a mounting that is 25 degrees off: both turn as fast, about other axes."""
    simulation = simulate("spin", duration_s=3.0, lidar=LIDAR)
    tilt = np.eye(4)
    tilt[:3, :3] = so3.exp(np.array([np.deg2rad(25.0), 0.0, 0.0]))
    wrong = config(simulation, T_imu_lidar=tuple(map(tuple, (simulation.T_imu_lidar @ tilt).tolist())))
    refusal = find_start(frames(simulation.events())[-9:], wrong)
    named = re.search(r"they turn as fast, but about axes (\d+) deg apart, so T_imu_lidar is wrong", str(refusal))
    assert named is not None and 20 <= int(named[1]) <= 30
