"""Everything that can be set for a run with loop closure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from pydantic import Field

from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.runs.lidar_inertial.config import RunConfig
from boxplus.runs.settings_file import dump_settings, load_settings
from boxplus.systems.georeference.config import GeoreferenceConfig
from boxplus.systems.slam.config import SlamConfig


class SlamRunConfig(RunConfig):
    """Settings of `boxplus slam`: of the odometry, local maps, loop closure and positions by satellite. None has to be given."""

    local_maps: LocalMapConfig = Field(default_factory=lambda: LocalMapConfig())  # type: ignore[call-arg]
    slam: SlamConfig = Field(default_factory=lambda: SlamConfig())  # type: ignore[call-arg]
    gnss: GeoreferenceConfig = Field(default_factory=lambda: GeoreferenceConfig())  # type: ignore[call-arg]


def load_slam_config(
    path: str | Path | None = None, settings: Iterable[str] = (), overrides: Mapping[str, Mapping[str, object]] | None = None
) -> SlamRunConfig:
    """Settings of `boxplus slam` from a YAML file, then single `key=value` texts, then overrides; see `load_settings`.

    Raises:
        InputError: the file cannot be read, a key is unknown, or a value is not valid.
    """
    return load_settings(SlamRunConfig, path, settings, overrides)


def dump_slam_config(config: SlamRunConfig) -> str:
    """The text of `slam/config.yaml`."""
    head = "# Settings of this run: 'boxplus slam RECORDING --config FILE' repeats it.\n"
    return dump_settings(head, config.model_dump())
