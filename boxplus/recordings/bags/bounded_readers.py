"""The readers of rosbags with a limit to what they inflate, which their own do not have. rosbags itself stays as it is."""

from __future__ import annotations

import functools
import importlib.util
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from boxplus.recordings.bags.inflation import Zstd, inflate

KNOWN_ROSBAGS = "0.10.9 to 0.11.9"


class UnknownRosbagsError(RuntimeError):
    """This version of rosbags inflates somewhere else than those that are known: nothing would limit it."""

    def __init__(self) -> None:
        super().__init__(f"rosbags {version('rosbags')} inflates in a way that boxplus does not know and could not limit")


def open_reader(file: Path) -> Any:
    """A reader of a ROS 1 bag, or of a ROS 2 file or folder.

    Raises:
        UnknownRosbagsError: see there; rosbags raises errors of its own.
    """
    if file.suffix != ".bag":
        reader = _ros2_reader()(file)
        reader.open()
        return reader
    from rosbags.rosbag1 import Reader

    reader = Reader(file)
    reader.open()
    try:
        _bound_ros1(reader)
    except BaseException:
        reader.close()
        raise
    return reader


def _bound_ros1(reader: Any) -> None:
    """Let an open reader inflate its chunks by ours, whatever its own functions are."""
    try:
        module = importlib.import_module("rosbags.rosbag1.reader")
        names = {decompress: name for name, decompress in module.decompressors.items()}
        for position, chunk in reader.chunks.items():
            reader.chunks[position] = chunk._replace(decompressor=partial(inflate, names[chunk.decompressor]))
    except (AttributeError, ImportError, LookupError, TypeError) as error:
        raise UnknownRosbagsError from error


@functools.cache
def _ros2_reader() -> Any:
    """The class, in modules of our own: what theirs inflate with is shared by all readers of a process."""
    try:
        mcap, reader = _copy("rosbags.rosbag2.storage_mcap"), _copy("rosbags.rosbag2.reader")
        mcap.DECOMPRESSORS = {name: partial(_inflate_chunk, name) for name in mcap.DECOMPRESSORS}
        _bound_zstd(mcap)
        _bound_zstd(reader)
        _exchange(reader, reader.McapReader, mcap.McapReader)
        return reader.Reader
    except (AttributeError, ImportError, LookupError, TypeError) as error:
        raise UnknownRosbagsError from error


def _copy(name: str) -> Any:
    """A second module of the same file, which nobody else can import."""
    spec = importlib.import_module(name).__spec__
    if spec is None or spec.loader is None:
        raise ImportError(name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _bound_zstd(module: Any) -> None:
    names = {"zstd", "zstandard"} & vars(module).keys()  # before version 0.11 zstandard
    if not names:
        raise AttributeError("zstd")
    for name in names:
        setattr(module, name, Zstd())


def _exchange(module: Any, theirs: type, ours: type) -> None:
    """Let the readers of a module read MCAP by our class."""
    tables = [kind for kind in vars(module).values() if isinstance(kind, type) and theirs in _plugins(kind).values()]
    if not tables:
        raise AttributeError("STORAGE_PLUGINS")
    for kind in tables:
        plugins = {key: ours if plugin is theirs else plugin for key, plugin in _plugins(kind).items()}
        kind.STORAGE_PLUGINS = plugins  # type: ignore[attr-defined]


def _plugins(kind: type) -> dict[str, type]:
    return dict(vars(kind).get("STORAGE_PLUGINS", {}))


def _inflate_chunk(compression: str, data: bytes, size: int) -> bytes:
    return inflate(compression, data)
