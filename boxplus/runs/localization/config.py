"""Everything that can be set for a run with localisation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from pydantic import Field

from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.runs.lidar_inertial.config import RunConfig
from boxplus.runs.settings_file import dump_settings, load_settings
from boxplus.systems.localization.config import LocalizationConfig


class LocalizationRunConfig(RunConfig):
    """Settings of `boxplus localize`: of the odometry, of the places cut from the map, of localisation. None has to be given."""

    local_maps: LocalMapConfig = Field(default_factory=lambda: LocalMapConfig(max_range=50.0))  # type: ignore[call-arg]
    localization: LocalizationConfig = Field(default_factory=lambda: LocalizationConfig())  # type: ignore[call-arg]


def load_localization_config(
    path: str | Path | None = None, settings: Iterable[str] = (), overrides: Mapping[str, Mapping[str, object]] | None = None
) -> LocalizationRunConfig:
    """Settings of `boxplus localize` from a YAML file, then single `key=value` texts, then overrides; see `load_settings`.

    Raises:
        InputError: the file cannot be read, a key is unknown, or a value is not valid.
    """
    return load_settings(LocalizationRunConfig, path, settings, overrides)


def dump_localization_config(config: LocalizationRunConfig) -> str:
    """The text of `config.yaml`."""
    head = "# Settings of this run: 'boxplus localize RECORDING --map MAP --config FILE' repeats it.\n"
    return dump_settings(head, config.model_dump())
