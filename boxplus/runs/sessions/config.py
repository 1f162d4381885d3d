"""Everything that can be set for `boxplus map merge`."""

from __future__ import annotations

from pydantic import Field

from boxplus._settings import Settings
from boxplus.maps.seen_through import SeenThroughConfig
from boxplus.runs.settings_file import dump_settings
from boxplus.systems.sessions.config import SessionsConfig


class JointMapConfig(Settings):
    """What is kept of the joint map."""

    voxel: float | None = Field(0.1, ge=0.001, description="keep one point per voxel of this edge [m]; null keeps every point")
    tile_size: float = Field(50.0, gt=0, description="edge of the cubic map tiles [m]")
    ply: bool = Field(True, description="merge the tiles to map.ply at the end")
    change_voxels: int = Field(8, ge=1, description="voxels of a change between sessions that is reported, at least")


class MergeConfig(Settings):
    """Settings of `boxplus map merge`. None has to be given."""

    sessions: SessionsConfig = Field(default_factory=lambda: SessionsConfig())  # type: ignore[call-arg]
    seen_through: SeenThroughConfig = Field(default_factory=lambda: SeenThroughConfig())  # type: ignore[call-arg]
    map: JointMapConfig = Field(default_factory=lambda: JointMapConfig())  # type: ignore[call-arg]


def dump_merge_config(config: MergeConfig) -> str:
    """The text of `config.yaml`."""
    head = "# Settings of this map: 'boxplus map merge RUN… --config FILE' repeats it.\n"
    return dump_settings(head, config.model_dump())
