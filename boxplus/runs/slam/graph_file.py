"""`local_maps/graph.npz`: where closed loops put the local maps, and every loop, for programs (docs/output_folder.md)."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any, cast

import numpy as np

from boxplus.errors import InputError
from boxplus.formats.output import atomic_file
from boxplus.systems.slam.correction import Correction
from boxplus.systems.slam.loop import Loop, Source
from boxplus.systems.slam.outcome import SlamOutcome

_FORMAT, _VERSION = "boxplus-slam-graph", 1
_POSES = tuple(field.name for field in fields(Correction))
_SHAPES: dict[str, tuple[int, ...]] = {"T_start": (7,), "T_place_query": (7,), "covariance": (6, 6), "information": (6, 6)}
_INTEGERS = ("query", "place", "inliers", "measured")
_TEXTS = ("refusal", "objection")  # the second is not in files of earlier versions
_NUMBERS = ("rms", "rms_odometry", "innovation", "innovation_limit", "weight")


def write_graph(path: Path, outcome: SlamOutcome) -> None:
    """Write the file in one step; the same bytes for the same outcome.

    Raises:
        OutputError: it cannot be written; the one before stays.
    """
    loops, n = outcome.loops, len(outcome.loops)
    content: dict[str, Any] = {name: getattr(outcome.correction, name) for name in _POSES}
    for name in _INTEGERS:
        content[f"loop_{name}"] = np.array([getattr(loop, name) for loop in loops], dtype=np.int64)
    for name in _NUMBERS:
        content[f"loop_{name}"] = np.array([getattr(loop, name) for loop in loops], dtype=np.float64)
    for name, shape in _SHAPES.items():
        content[f"loop_{name}"] = np.array([getattr(loop, name) for loop in loops], dtype=np.float64).reshape(n, *shape)
    content["loop_overlap"] = np.array([loop.overlap for loop in loops], dtype=np.float64).reshape(n, 2)
    content["loop_source"] = np.array([loop.source for loop in loops], dtype=np.str_)
    for name in _TEXTS:
        content[f"loop_{name}"] = np.array([getattr(loop, name) or "" for loop in loops], dtype=np.str_)
    content["drift_scale"], content["T_world_map"] = np.array(outcome.drift_scale), outcome.T_world_map
    content["doubt"] = np.array(outcome.doubt or "")
    with atomic_file(path) as file:
        np.savez(file, format=np.array(_FORMAT), version=np.array(_VERSION), **content)


def read_graph(path: Path) -> SlamOutcome:
    """What `write_graph` wrote.

    Raises:
        InputError: missing, damaged, or of another version.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            if str(stored["format"]) != _FORMAT or int(stored["version"]) != _VERSION:
                raise ValueError(f"format {stored['format']}, version {stored['version']}")
            content = {name: stored[name] for name in stored.files}
        correction = Correction(**{name: content[name] for name in _POSES})
        loops = [_loop(content, k) for k in range(len(content["loop_query"]))]
    except Exception as error:
        raise InputError(
            f"the graph of a run of 'boxplus slam' (version {_VERSION} of {_FORMAT})",
            f"{path}: {error or type(error).__name__}",
            "go on with the run (--resume), or run 'boxplus slam' again",
        ) from error
    return SlamOutcome(correction, loops, str(content["doubt"]) or None, float(content["drift_scale"]), content["T_world_map"])


def _loop(content: dict[str, Any], k: int) -> Loop:
    """Row k of the arrays of loops."""
    values: dict[str, Any] = {name: int(content[f"loop_{name}"][k]) for name in _INTEGERS}
    values |= {name: float(content[f"loop_{name}"][k]) for name in _NUMBERS}
    values |= {name: content[f"loop_{name}"][k] for name in _SHAPES}
    first, second = content["loop_overlap"][k].tolist()
    source = cast(Source, str(content["loop_source"][k]))
    values |= {name: str(content[f"loop_{name}"][k]) or None for name in _TEXTS if f"loop_{name}" in content}
    return Loop(**values, overlap=(first, second), source=source)
