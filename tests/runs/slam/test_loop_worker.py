"""The process that looks for loops beside the odometry: what it says at its end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from boxplus.manifolds import se3
from boxplus.maps.local_maps.folder import LocalMapFolder
from boxplus.runs.slam.loop_search import LoopSearch
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.slam.config import SlamConfig
from tests.systems.slam.drives import mapped_drive


@pytest.mark.slow
def test_a_slip_of_the_odometry_is_the_doubt_of_the_run(tmp_path: Path) -> None:
    route = [[20.0, 0.0], [60.0, 0.0], [60.0, 60.0], [0.0, 60.0], [0.0, 0.0], [60.0, 0.0], [60.0, 25.0]]
    drive = mapped_drive(city(2, 2, seed=7003), route, DriftConfig(channels=24, azimuth_steps=240), seed=7003)
    jump, folder = np.array([1.0, 0.0, 0.0, 0.0, 9.0, -8.0, 0.0]), LocalMapFolder(tmp_path)
    with LoopSearch(SlamConfig(), [], [], tmp_path, tmp_path / "graph.npz") as search:
        for local_map in drive.maps:
            slipped = local_map.number >= 7
            T = se3.compose(jump, local_map.T_odo_map) if slipped else local_map.T_odo_map
            folder.write(replace(local_map, T_odo_map=T))
            search.give(local_map.number)
        outcome = search.finish(lambda: None)
    assert outcome.doubt is not None and outcome.doubt.startswith("the odometry slipped by 12.")
