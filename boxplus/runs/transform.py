"""A rigid transform as people write it: numbers on the command line, or a file."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.filtering.nav_state import check_transform
from boxplus.manifolds import quaternion

_FORMS = (
    "16 numbers row by row, or with a tag 'xyz_qwxyz: x y z qw qx qy qz', 'xyz_qxyzw: x y z qx qy qz qw', "
    "'xyz_rpy_deg: x y z roll pitch yaw' or 'xyz: x y z'"
)
_TAGS = {"matrix": (12, 16), "xyz_qwxyz": (7,), "xyz_qxyzw": (7,), "xyz_rpy_deg": (6,), "xyz": (3,)}
_KEYS = ("x", "y", "z", "qx", "qy", "qz", "qw")
"""Of the JSON files in which evo keeps a transform."""


def parse_transform(text: str, name: str = "T_imu_lidar", *, key: str | None = "T_imu_lidar") -> NDArray[np.float64]:
    """Read a rigid transform; for `T_imu_lidar` it maps LiDAR coordinates to IMU coordinates (p_imu = T p_lidar).

    Args:
        text: 16 numbers (row-major), or the first 12; tagged numbers (`xyz_qwxyz: …`, `xyz_qxyzw: …`, `xyz_rpy_deg: …` with
            R = Rz(yaw) Ry(pitch) Rx(roll), `xyz: …` without a turn), or a file with one of these, or a YAML or JSON file with x,
            y, z, qx, qy, qz and qw, or with `key`, or, where that is `T_imu_lidar`, with `R_imu_lidar` and `p_imu_lidar` (or
            `t_imu_lidar`).
        name: of the transform, for the messages.
        key: its name in files; None where it has none.

    Returns:
        (4, 4) float64.

    Raises:
        InputError: not one of these forms, or not a rotation.

    Example:
        >>> parse_transform("xyz_rpy_deg: 0 0 1.5 0 0 90")[:3, 3].tolist()
        [0.0, 0.0, 1.5]
    """
    stripped = text.strip()
    tag, body = _split_tag(stripped)
    if stripped.startswith("{"):
        mapping = _mapping(stripped)
        if mapping is not None:
            return _from_mapping(mapping, name, key)
    elif tag is None and re.search(r"[^\s,;\[\]()0-9eE+.-]", body):
        stripped = _read_file(stripped, name)
        mapping = _mapping(stripped)
        if mapping is not None:
            return _from_mapping(mapping, name, key)
        tag, body = _split_tag(stripped)
    try:
        numbers = np.array([float(word) for word in re.split(r"[\s,;\[\]()]+", body) if word])
    except ValueError:
        raise InputError(f"{name} as {_FORMS}, or a file with these", f"{text[:80]!r}", "correct the numbers") from None
    return _from_numbers(tag, numbers, name)


def transform_text(T: NDArray[np.float64]) -> str:
    """A rigid transform (4, 4) as `parse_transform` reads it.

    Example:
        >>> transform_text(parse_transform("xyz_rpy_deg: 0.1 0 1.5 0 0 90"))
        'xyz_qwxyz: 0.10000 0.00000 1.50000 0.7071068 0.0000000 0.0000000 0.7071068'
    """
    p = " ".join(f"{value:.5f}" for value in T[:3, 3])
    q = " ".join(f"{value:.7f}" for value in quaternion.from_matrix(T[None, :3, :3])[0])
    return f"xyz_qwxyz: {p} {q}"


def _split_tag(text: str) -> tuple[str | None, str]:
    tag, colon, body = text.partition(":")
    return (tag.strip(), body) if colon and tag.strip() in _TAGS else (None, text)


def _read_file(path: str, name: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise InputError(
            f"{name} as {_FORMS}, or a file with these", f"{path[:80]!r} ({reason})", "check the numbers or the path"
        ) from error


def _mapping(text: str) -> dict[str, object] | None:
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError:
        return None
    return content if isinstance(content, dict) and not set(content) <= set(_TAGS) else None


def _from_mapping(content: dict[str, object], name: str, key: str | None) -> NDArray[np.float64]:
    try:
        if key is not None and key in content:
            return _from_numbers(None, np.array(content[key], dtype=np.float64).ravel(), name)
        if set(_KEYS) <= set(content):
            if content.get("scale", 1.0) != 1.0:
                raise InputError(f"{name} as a rigid transform", f"one with the scale {content['scale']}", "leave the scale out")
            return _from_numbers("xyz_qxyzw", np.array([content[part] for part in _KEYS], dtype=np.float64), name)
        suffix = "" if key is None else key.removeprefix("T_")
        position = content.get(f"p_{suffix}", content.get(f"t_{suffix}"))
        if suffix and f"R_{suffix}" in content and position is not None:
            T = np.eye(4)
            T[:3, :3] = np.array(content[f"R_{suffix}"], dtype=np.float64).reshape(3, 3)
            T[:3, 3] = np.array(position, dtype=np.float64).reshape(3)
            return check_transform(name, T)
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"numbers for {name}", str(error), "correct the file") from error
    named = "the keys" if key is None else f"the key {key}, or R_{suffix} and p_{suffix}, or"
    raise InputError(
        f"{named} {', '.join(_KEYS)} in the file for {name}",
        f"the keys {', '.join(map(str, content))}",
        "rename the keys" if key is None else "rename the keys; the name says the direction",
    )


def _from_numbers(tag: str | None, numbers: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    if tag is None:
        if numbers.size == 7:
            raise InputError(
                f"{name} as {_FORMS}", "7 numbers without a tag", "say in which order the quaternion is: xyz_qwxyz: or xyz_qxyzw:"
            )
        if numbers.size == 3:
            raise InputError(
                f"{name} as {_FORMS}", "3 numbers without a tag", "check that all were copied; without a turn: 'xyz: x y z'"
            )
        tag = "matrix"
    if numbers.size not in _TAGS[tag]:
        raise InputError(f"{name} as {_FORMS}", f"{numbers.size} numbers", "check that all were copied")
    if tag == "matrix":
        return check_transform(name, np.vstack([numbers.reshape(-1, 4), np.eye(4)[numbers.size // 4 :]]))
    T = np.eye(4)
    T[:3, 3] = numbers[:3]
    if tag == "xyz":
        return check_transform(name, T)
    if tag == "xyz_rpy_deg":
        roll, pitch, yaw = np.radians(numbers[3:])
        cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
        T[:3, :3] = [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
        return check_transform(name, T)
    q_wxyz = numbers[3:] if tag == "xyz_qwxyz" else numbers[[6, 3, 4, 5]]
    norm = float(np.linalg.norm(q_wxyz))
    if not abs(norm - 1.0) < 1e-2:
        raise InputError(
            f"a unit quaternion in {name}", f"one of norm {norm:.4g}", "check the order of the numbers and that all were copied"
        )
    T[:3, :3] = quaternion.to_matrix((q_wxyz / norm)[None])[0]
    return check_transform(name, T)
