"""What is known of one camera, put together from all that was stated about it, each with its source."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from boxplus.errors import RecordingError
from boxplus.recordings.bags.transforms import apart
from boxplus.recordings.cameras.calibration import THIS_IS_THE_BODY, StatedCamera
from boxplus.recordings.cameras.info import CameraStream, ImageKind
from boxplus.recordings.info import Evidence

_SAME_INTRINSICS = 1e-3  # relative
_SAME_ANGLE = 5e-3  # rad
_SAME_PLACE = 5e-3  # m


@dataclass(frozen=True, slots=True, eq=False)
class FoundCamera:
    """One stream of images as a format's reader found it.

    Attributes:
        name, kind, source, frame, depth_unit_m: as in `CameraStream`.
        depth_unit_source: where the unit comes from.
        time_ns: (N,) stamps seen, of the whole stream or of its beginning.
        count: images in all.
        size: (width, height) of the first image [px].
        stated: what is said of its calibration; of two that say the same thing the first holds.
    """

    name: str
    kind: ImageKind
    source: str
    time_ns: Sequence[int]
    count: int
    size: tuple[int, int]
    stated: Sequence[StatedCamera]
    frame: str = ""
    depth_unit_m: float | None = None
    depth_unit_source: str = ""


def rate_hz(time_ns: Sequence[int]) -> float:
    """Rate by the median step forward [Hz]; NaN where there is none."""
    steps = np.diff(np.array(time_ns, np.int64))
    steps = steps[steps > 0]
    return 1e9 / float(np.median(steps)) if len(steps) else float("nan")


def camera_streams(found: Sequence[FoundCamera], has_imu: bool) -> tuple[list[CameraStream], list[Evidence]]:
    """The streams with their calibration, and one finding for each thing that is known, contradicted or not known."""
    streams: list[CameraStream] = []
    evidence: list[Evidence] = []
    for index, camera in enumerate(found):
        if index == 0 and not has_imu and all(stated.T_body_camera is None for stated in camera.stated):
            body = StatedCamera(THIS_IS_THE_BODY, T_body_camera=np.eye(4))
            camera = replace(camera, stated=[*camera.stated, body])
        stream, findings = _resolved(index, camera)
        streams.append(stream)
        evidence += findings
    for stream in streams:
        evidence += _calibration_evidence(stream)
    return streams, evidence


def _resolved(index: int, camera: FoundCamera) -> tuple[CameraStream, list[Evidence]]:
    sources: dict[str, str] = {}
    missing: dict[str, str] = {}
    evidence: list[Evidence] = []
    model = T_body_camera = time_offset_s = line_delay_s = None
    for stated in camera.stated:
        for what, why in stated.missing.items():
            missing.setdefault(what, why)
        if stated.model is not None and stated.size is not None and stated.size != camera.size:
            text = f"{stated.size[0]}x{stated.size[1]} px in {stated.source}, the images have {camera.size[0]}x{camera.size[1]}"
            missing["model"] = f"calibrated for {text}"
            evidence.append(Evidence(f"{camera.name}_size", "differs", "error", f"calibrated for {text}: it is not used"))
        elif stated.model is not None and model is None:
            model, sources["model"] = stated.model, stated.source
        elif stated.model is not None and not _same_model(model, stated.model):
            text = f"{sources['model']} and {stated.source} differ: the first is used; find out which belongs to these images"
            evidence.append(Evidence(f"{camera.name}_model", "contradicted", "warning", text))
        if stated.T_body_camera is not None and T_body_camera is None:
            T_body_camera = stated.T_body_camera
            sources["T_body_camera"] = stated.mounting_source or stated.source
            if stated.mounting_doubt:
                text = f"{sources['T_body_camera']}: {stated.mounting_doubt}; find out which belongs to this rig"
                evidence.append(Evidence(f"{camera.name}_mounting", "contradicted", "warning", text))
        elif T_body_camera is not None and stated.T_body_camera is not None:
            turned, moved = apart(T_body_camera, stated.T_body_camera)
            if turned > _SAME_ANGLE or moved > _SAME_PLACE:
                text = (
                    f"{sources['T_body_camera']} and {stated.mounting_source or stated.source} differ by "
                    f"{np.degrees(turned):.2f} deg and "
                    f"{moved * 1e3:.0f} mm: the first is used; find out which belongs to this rig"
                )
                evidence.append(Evidence(f"{camera.name}_mounting", "contradicted", "warning", text))
        if stated.time_offset_s is not None and time_offset_s is None:
            time_offset_s, sources["time_offset_s"] = stated.time_offset_s, stated.source
        if stated.line_delay_s is not None and line_delay_s is None:
            line_delay_s, sources["line_delay_s"] = stated.line_delay_s, stated.source
    if camera.depth_unit_m is not None:
        sources["depth_unit_m"] = camera.depth_unit_source
    for what, value in (("model", model), ("T_body_camera", T_body_camera), ("time_offset_s", time_offset_s)):
        if value is not None:
            missing.pop(what, None)
        else:
            missing.setdefault(what, "the recording does not say")
    stream = CameraStream(
        index=index,
        name=camera.name,
        kind=camera.kind,
        source=camera.source,
        frame=camera.frame,
        width=camera.size[0],
        height=camera.size[1],
        count=camera.count,
        rate_hz=rate_hz(camera.time_ns),
        depth_unit_m=camera.depth_unit_m,
        model=model,
        T_body_camera=T_body_camera,
        time_offset_s=time_offset_s,
        line_delay_s=line_delay_s,
        sources=sources,
        missing=missing,
    )
    return stream, evidence


def _same_model(one: object, other: object) -> bool:
    a, b = getattr(one, "parameters", np.empty(0)), getattr(other, "parameters", np.empty(0))
    longest = max(len(a), len(b))
    a, b = (np.pad(v, (0, longest - len(v))) for v in (a, b))
    return type(one) is type(other) and bool(np.all(np.abs(a - b) <= _SAME_INTRINSICS * np.maximum(np.abs(a), 1.0)))


def _calibration_evidence(stream: CameraStream) -> list[Evidence]:
    evidence: list[Evidence] = []
    for what, key in (("model", "model"), ("T_body_camera", "mounting"), ("time_offset_s", "time_offset")):
        name = f"{stream.name}_{key}"
        if what in stream.missing:
            if what == "time_offset_s":
                text = f"{stream.missing[what]}: images are taken at their stamps, nothing is added"
                evidence.append(Evidence(name, "unknown", "ok", text))
            else:
                text = f"{stream.missing[what]}: give a Kalibr camchain; an estimator that needs it refuses this camera"
                evidence.append(Evidence(name, "unknown", "warning", text))
            continue
        value = "known"
        if stream.model is not None and what == "model":
            value = type(stream.model).__name__
        if stream.time_offset_s is not None and what == "time_offset_s":
            value = f"{stream.time_offset_s * 1e3:+.3f} ms"
        evidence.append(Evidence(name, value, "ok", f"from {stream.sources[what]}"))
    if stream.readout_s:
        value = f"{stream.readout_s * 1e3:+.1f} ms"
        text = (
            f"a rolling shutter, first row to last, from {stream.sources['line_delay_s']}; 'boxplus vio' knows what to do with it"
        )
        evidence.append(Evidence(f"{stream.name}_line_delay", value, "ok", text))
    if stream.depth_unit_m is not None:
        text = f"metres of one count, from {stream.sources['depth_unit_m']}"
        evidence.append(Evidence(f"{stream.name}_depth_unit", f"{stream.depth_unit_m:g} m", "ok", text))
    return evidence


def stated_for(stated: dict[str, StatedCamera], name: str, count: int, file: str) -> list[StatedCamera]:
    """What a given calibration says of the camera `name`; the only camera of both needs no name.

    Raises:
        RecordingError: the calibration names other cameras.
    """
    if not stated:
        return []
    if name in stated:
        return [stated[name]]
    if len(stated) == 1 and count == 1:
        return list(stated.values())
    raise RecordingError(
        f"a calibration of {name} in {file}", f"one of {', '.join(stated)}", "name the cameras in it as the recording does"
    )
