"""Positions by satellite in a run of `boxplus slam`: the map laid onto the Earth, and the files that say where."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.output import atomic_file
from boxplus.formats.trajectory import read_trajectory
from boxplus.recordings.recording import Recording
from boxplus.runs.slam.config import SlamRunConfig
from boxplus.runs.slam.folder import SlamFolder
from boxplus.runs.slam.summary import GnssFacts
from boxplus.sensors.satellites.geodesy import EnuFrame, to_utm, utm_epsg
from boxplus.systems.georeference.config import GeoreferenceConfig
from boxplus.systems.georeference.georeference import Georeference, georeference
from boxplus.systems.slam.correction import Correction
from boxplus.systems.slam.outcome import SlamOutcome

_ABOUT = (
    "# Trajectory and map of this run are east, north and up [m] of this origin. T_enu_map [qw, qx, qy, qz, x, y, z] is where\n"
    "# the map would lie without positions by satellite, in that frame.\n"
)


def lay_onto_earth(
    recording: Recording, folder: SlamFolder, outcome: SlamOutcome, config: SlamRunConfig
) -> tuple[SlamOutcome, Georeference | None]:
    """Compare the fixes of a recording with a finished odometry and move the local maps where both put them together.

    Returns:
        The outcome as it was, and None, where the recording has no fixes or they were left out. A refusal leaves the local maps
        where they are.
    """
    found = located(recording, folder, outcome, config)
    return (outcome if found is None or found.fit is None else outcome.laid(found.fit.T_map, found.fit.T_enu_map)), found


def located(recording: Recording, folder: SlamFolder, outcome: SlamOutcome, config: SlamRunConfig) -> Georeference | None:
    """What the fixes of a recording say of the local maps of a finished odometry; None where there are no fixes."""
    if not recording.info.gnss_topic:
        return None
    odometry = read_trajectory(folder.odometry.trajectory)
    known = np.ones(len(odometry), dtype=np.bool_)
    if odometry.status is not None:
        known = np.array([status != "lost" for status in odometry.status], dtype=np.bool_)
    T_odo_imu = np.hstack([odometry.q_wxyz, odometry.p])
    graph = outcome.graph(config.slam.gravity_sigma)
    times, antenna = odometry.times[known], recording.info.p_imu_antenna
    return georeference(graph, recording.fixes(), times, T_odo_imu[known], config.gnss, antenna)


def write_georeference(folder: SlamFolder, found: Georeference, config: GeoreferenceConfig) -> None:
    """`gnss.csv`, and where the map was laid onto the Earth `georeference.yaml` and, if wanted, `trajectory_utm.csv`.

    Raises:
        OutputError: they cannot be written.
    """
    with atomic_file(folder.gnss) as file:
        file.write(_fixes(found).encode())
    if found.frame is None or found.fit is None:
        return
    with atomic_file(folder.georeference) as file:
        file.write(_place(found.frame, found).encode())
    epsg = _epsg(found.frame)
    if config.utm and epsg is not None:
        trajectory = read_trajectory(folder.trajectory)
        rows = to_utm(found.frame.to_geodetic(trajectory.p), epsg)
        lines = [f"# EPSG:{epsg}, heights above the ellipsoid of WGS84", "time_s,easting_m,northing_m,height_m"]
        for time_ns, (east, north, up) in zip(trajectory.times.tolist(), rows.tolist(), strict=True):
            lines.append(f"{time_ns // 10**9}.{time_ns % 10**9:09d},{east:.4f},{north:.4f},{up:.4f}")
        with atomic_file(folder.trajectory_utm) as file:
            file.write(("\n".join(lines) + "\n").encode())


def read_origin(folder: Path) -> EnuFrame | None:
    """The origin in the `georeference.yaml` of a run; None where it has none.

    Raises:
        InputError: the file is not of that form.
    """
    path = SlamFolder(folder).georeference
    if not path.is_file():
        return None
    try:
        origin = yaml.safe_load(path.read_text(encoding="utf-8"))["origin"]
        return EnuFrame(float(origin["latitude_deg"]), float(origin["longitude_deg"]), float(origin["height_m"]))
    except (OSError, UnicodeDecodeError, yaml.YAMLError, LookupError, TypeError, ValueError) as error:
        raise InputError("an origin in georeference.yaml", f"{path}: {error}", "keep what 'boxplus slam' wrote") from error


def gnss_facts(topic: str, found: Georeference, correction: Correction) -> GnssFacts:
    """What `run.json` holds of it."""
    if found.fit is None or found.frame is None:
        return GnssFacts(topic=topic, refusal=found.refusal, left_out=found.left_out)
    fit, frame = found.fit, found.frame
    lever, lever_sigma = fit.lever.tolist(), fit.lever_sigma.tolist()
    return GnssFacts(
        topic=topic,
        used=found.used,
        left_out=found.left_out,
        stretches=found.stretches,
        origin=(frame.latitude, frame.longitude, frame.altitude),
        epsg=_epsg(frame),
        T_enu_map=fit.T_enu_map.tolist(),
        covariance=fit.covariance.tolist(),
        T_map_odo=correction.T_map_odo.tolist(),
        heading_sigma_deg=math.degrees(math.sqrt(float(fit.covariance[2, 2]))),
        position_sigma_m=_rms(fit.sigma),
        rms_m=_rms(np.linalg.norm(fit.errors[fit.is_used, :2], axis=1)),
        lever_arm_m=(lever[0], lever[1], lever[2]),
        lever_arm_sigma_m=(lever_sigma[0], lever_sigma[1], lever_sigma[2]),
        delay_s=fit.delay,
        delay_sigma_s=fit.delay_sigma,
        noise_scale=fit.noise_scale,
        height_scale=fit.height_scale,
        unshown_slide_m=None if found.unshown is None else _finite(found.unshown.slide_m),
        unshown_turn_deg=None if found.unshown is None else _finite(found.unshown.turn_deg),
    )


def _finite(value: float) -> float | None:
    """JSON knows no infinity."""
    return value if math.isfinite(value) else None


def gnss_warnings(found: Georeference, config: GeoreferenceConfig) -> list[str]:
    """What a user has to be told."""
    if config.utm and found.frame is not None and _epsg(found.frame) is None:
        other = gnss_warnings(found, config.model_copy(update={"utm": False}))
        return [*other, "there is no UTM where this is, beyond 84° N or 80° S"]
    if found.refusal is not None:
        return [f"the positions by satellite are not used: {found.refusal}"]
    return [f"positions by satellite: {text}" for text in found.warnings]


def _place(frame: EnuFrame, found: Georeference) -> str:
    content = {
        "origin": {"latitude_deg": frame.latitude, "longitude_deg": frame.longitude, "height_m": frame.altitude},
        "datum": "WGS84, heights above its ellipsoid",
        "utm_epsg": _epsg(frame),
        "T_enu_map": [] if found.fit is None else found.fit.T_enu_map.tolist(),
    }
    return _ABOUT + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=200)


def _fixes(found: Georeference) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("time_s", "latitude_deg", "longitude_deg", "height_m", "sigma_m", "used", "east_m", "north_m", "up_m"))
    attached, fit = found.attached, found.fit
    for k, time_ns in enumerate(attached.time_ns.tolist()):
        place = (f"{attached.lat_lon_alt[k, 0]:.9f}", f"{attached.lat_lon_alt[k, 1]:.9f}", f"{attached.lat_lon_alt[k, 2]:.3f}")
        off = ("", "", "") if fit is None else tuple(f"{value:.3f}" for value in -fit.errors[k])
        used = 0 if fit is None else int(fit.is_used[k])
        writer.writerow((f"{time_ns // 10**9}.{time_ns % 10**9:09d}", *place, f"{attached.sigma[k]:.3f}", used, *off))
    return text.getvalue()


def _epsg(frame: EnuFrame) -> int | None:
    return utm_epsg(frame.latitude, frame.longitude) if -80.0 <= frame.latitude <= 84.0 else None


def _rms(values: NDArray[np.float64]) -> float | None:
    return math.sqrt(float(np.mean(values**2))) if len(values) else None
