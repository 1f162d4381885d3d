"""Everything that can be set for refining a run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from pydantic import Field

from boxplus._settings import Settings
from boxplus.runs.lidar_inertial.config import MapConfig
from boxplus.runs.settings_file import dump_settings, load_settings
from boxplus.systems.refinement.config import RefinementConfig


class RefineRunConfig(Settings):
    """Settings of `boxplus refine`; this is what its `config.yaml` holds. None has to be given."""

    refinement: RefinementConfig = Field(default_factory=lambda: RefinementConfig())  # type: ignore[call-arg]
    map: MapConfig = Field(default_factory=lambda: MapConfig())  # type: ignore[call-arg]


def load_refine_config(
    path: str | Path | None = None, settings: Iterable[str] = (), overrides: Mapping[str, Mapping[str, object]] | None = None
) -> RefineRunConfig:
    """Settings of `boxplus refine` from a YAML file, then single `key=value` texts, then overrides; see `load_settings`.

    Raises:
        InputError: the file cannot be read, a key is unknown, or a value is not valid.
    """
    return load_settings(RefineRunConfig, path, settings, overrides)


def dump_refine_config(config: RefineRunConfig) -> str:
    """The text of `config.yaml`."""
    head = "# Settings of this run: 'boxplus refine RUN --config FILE' repeats it.\n"
    return dump_settings(head, config.model_dump())
