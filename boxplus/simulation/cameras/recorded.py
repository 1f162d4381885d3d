"""A simulation with its fault: what is recorded, and what is declared of it; in memory, in the place of an opened recording."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.recordings.cameras.events import IMU, CameraEvent, CameraRecording, Pending, assembled, in_order
from boxplus.recordings.cameras.info import CameraRecordingInfo, CameraStream, ImuStream
from boxplus.recordings.info import Evidence, Topic
from boxplus.recordings.recording import Tally
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation.cameras.faults import CameraFault
from boxplus.simulation.cameras.sensor import CameraRig
from boxplus.simulation.cameras.simulation import DEPTH, CameraSimulation
from boxplus.simulation.imu import ImuModel

_SOURCE = "the simulation"
_LEAST_DENSITY = 1e-12


class Recorded:
    """A simulation as it would be recorded.

    Args:
        simulation: the world, the motion and the sensors.
        fault: what goes wrong.

    Attributes:
        simulation: with the scenario of the fault.
        declared: the rig as the recording declares it.
    """

    def __init__(self, simulation: CameraSimulation, fault: CameraFault | None = None) -> None:
        self.fault = fault
        self.simulation = simulation
        if fault is not None:
            changed = fault.scenario(simulation.scenario)
            if changed is not simulation.scenario:
                config = simulation.config
                self.simulation = CameraSimulation(changed, config.seed, config.duration_s)
        rig = self.simulation.scenario.rig
        self.declared: CameraRig = rig if fault is None else fault.declared(rig)

    def events(self) -> Iterator[CameraImage | ImuSamples]:
        """Images and blocks of IMU samples in the order in which they arrive."""
        events: Iterable[CameraImage | ImuSamples] = self.simulation.events()
        return iter(events) if self.fault is None else self.fault.events(events)


def imu_noise(imu: ImuModel) -> ImuNoise:
    """The densities of an IMU; those of an ideal one are next to nothing."""
    densities = (imu.gyro_noise_density, imu.accel_noise_density, imu.gyro_bias_walk, imu.accel_bias_walk)
    return ImuNoise(*(max(density, _LEAST_DENSITY) for density in densities))


def as_camera_recording(simulation: CameraSimulation, fault: CameraFault | None = None) -> CameraRecording:
    """The simulation as a `CameraRecording`; what a fault spoils arrives spoilt, in the order that a reader would give it."""
    recorded = Recorded(simulation, fault)
    simulation = recorded.simulation
    config, names = simulation.config, simulation.names
    imu_count = round(config.duration_s * config.imu.rate_hz) + 1
    imu = ImuStream("simulated IMU", "imu", imu_count, config.imu.rate_hz, "rad/s", "m/s2", imu_noise(config.imu), _SOURCE)
    text = f"seed {config.seed}" if fault is None else f"seed {config.seed}, {fault.description}"
    topics = [Topic(name, "simulated camera", simulation.image_count) for name in names] + [
        Topic("imu", "simulated IMU", imu_count)
    ]
    info = CameraRecordingInfo(
        path=Path(f"{config.scenario} (simulated)"),
        format="simulation",
        topics=topics,
        duration_s=(simulation.end_ns - simulation.start_ns) * 1e-9,
        message_count=sum(topic.count for topic in topics),
        cameras=[_stream(recorded, index) for index in range(len(names))],
        imu=imu,
        evidence=[Evidence("scenario", config.scenario, "ok", text)],
    )

    def read(tally: Tally) -> Iterator[CameraEvent]:
        streams = [*range(len(names)), IMU]
        known = dict(enumerate(names)) | {IMU: "imu"}
        pending = in_order(_pending(recorded.events(), tally), streams, tally, known)
        yield from assembled(pending, info.cameras, imu, tally)

    return CameraRecording(info, read, lambda: None)


def _pending(events: Iterator[CameraImage | ImuSamples], tally: Tally) -> Iterator[Pending]:
    for event in events:
        if isinstance(event, CameraImage):
            tally.done += 1
            yield Pending(event.time_ns, event.camera, functools.partial(_pixels, event), (), event.exposure_s)
            continue
        tally.done += len(event)
        for time_ns, gyro, accel in zip(event.time_ns.tolist(), event.gyro.tolist(), event.accel.tolist(), strict=True):
            yield Pending(time_ns, IMU, None, (*gyro, *accel))


def _pixels(image: CameraImage) -> NDArray[np.uint8] | NDArray[np.float32]:
    return image.pixels


def _stream(recorded: Recorded, index: int) -> CameraStream:
    simulation = recorded.simulation
    name = simulation.names[index]
    camera = recorded.declared.cameras[0 if name == DEPTH else index]
    stream = CameraStream(
        index=index,
        name=name,
        kind="depth" if name == DEPTH else "intensity",
        source=name,
        frame=name,
        width=camera.sensor.width,
        height=camera.sensor.height,
        count=simulation.image_count,
        rate_hz=recorded.declared.rate_hz,
        model=camera.sensor.lens.model(),
        T_body_camera=camera.mounting,
        time_offset_s=0.0,
        line_delay_s=camera.sensor.line_delay_s,
        sources=dict.fromkeys(("model", "T_body_camera", "time_offset_s", "line_delay_s"), _SOURCE),
    )
    return replace(stream, depth_unit_m=1.0) if name == DEPTH else stream
