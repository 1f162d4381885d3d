"""Options that several commands share: how a recording is read."""

from __future__ import annotations

from typing import Annotated

import typer

from boxplus.recordings.options import AccelUnit, GyroUnit, RecordingOptions, TimeReference, TimeUnit

_PANEL = "Reading the recording (found from the data unless given)"

LidarTopic = Annotated[str | None, typer.Option("--lidar-topic", help="Topic of the LiDAR.", rich_help_panel=_PANEL)]
ImuTopic = Annotated[str | None, typer.Option("--imu-topic", help="Topic of the IMU.", rich_help_panel=_PANEL)]
PointTimeField = Annotated[
    str | None,
    typer.Option(
        "--point-time-field",
        help="Field with the time of each point; 'none' takes every scan as one instant.",
        rich_help_panel=_PANEL,
    ),
]
PointTimeUnit = Annotated[
    TimeUnit | None, typer.Option("--point-time-unit", help="Unit of the point times.", rich_help_panel=_PANEL)
]
PointTimeReference = Annotated[
    TimeReference | None,
    typer.Option("--point-time-reference", help="Instant from which the point times count.", rich_help_panel=_PANEL),
]
GyroUnitOption = Annotated[
    GyroUnit | None, typer.Option("--gyro-unit", help="Unit of the angular velocity.", rich_help_panel=_PANEL)
]
AccelUnitOption = Annotated[
    AccelUnit | None, typer.Option("--accel-unit", help="Unit of the acceleration.", rich_help_panel=_PANEL)
]
MinRange = Annotated[
    float, typer.Option("--min-range", help="Drop points nearer than this [m].", min=0.0, rich_help_panel=_PANEL)
]
MaxRange = Annotated[
    float, typer.Option("--max-range", help="Drop points farther than this [m].", min=0.0, rich_help_panel=_PANEL)
]
StartS = Annotated[float, typer.Option("--start", help="Skip this much at the beginning [s].", min=0.0, rich_help_panel=_PANEL)]
DurationS = Annotated[float | None, typer.Option("--duration", help="Read at most this much [s].", rich_help_panel=_PANEL)]

DEFAULTS = RecordingOptions()


def recording_options(
    lidar_topic: str | None,
    imu_topic: str | None,
    point_time_field: str | None,
    point_time_unit: TimeUnit | None,
    point_time_reference: TimeReference | None,
    gyro_unit: GyroUnit | None,
    accel_unit: AccelUnit | None,
    min_range: float,
    max_range: float,
    start_s: float,
    duration_s: float | None,
) -> RecordingOptions:
    """The options above as one object.

    Raises:
        typer.BadParameter: a value outside its range.
    """
    from pydantic import ValidationError

    try:
        return RecordingOptions(
            lidar_topic=lidar_topic,
            imu_topic=imu_topic,
            point_time_field=point_time_field,
            point_time_unit=point_time_unit,
            point_time_reference=point_time_reference,
            gyro_unit=gyro_unit,
            accel_unit=accel_unit,
            min_range=min_range,
            max_range=max_range,
            start_s=start_s,
            duration_s=duration_s,
        )
    except ValidationError as error:
        first = error.errors()[0]
        raise typer.BadParameter(f"{first['msg']} (got {first['input']!r})", param_hint=str(first["loc"][0])) from error
