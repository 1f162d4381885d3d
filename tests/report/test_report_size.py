"""A page of a long run can be sent by mail: at most 3 MB for 10,000 scans, with everything that it needs in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from boxplus.report import page, run_data
from boxplus.report.run_data import RunData, load_run
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.run_folder import RunFolder
from boxplus.runs.storage.row_log import RowLog
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.live_recording import as_recording

SCANS = 10_000


def prolonged(short: RunData, folder: Path) -> RunData:
    """The run as one of 10,000 scans: no two rows alike, as many points as a page may show, far apart."""
    rng = np.random.default_rng(0)
    rows = np.arange(SCANS) % len(short.log)
    numbers = short.log._numbers[rows] * rng.normal(1.0, 0.1, (SCANS, short.log._numbers.shape[1]))
    pairs = {
        name: [
            "; ".join(f"{pair.rpartition('=')[0]}={rng.uniform(1, 90):.3f}" for pair in text.split("; ")) if "=" in text else text
            for text in (entries[row] for row in rows)
        ]
        for name, entries in short.log.texts.items()
    }
    time_ns = short.log.time_ns[0] + 100_000_000 * np.arange(SCANS)
    status = np.where(rng.random(SCANS) < 0.05, "weak", "ok")
    return replace(
        short,
        folder=RunFolder(folder),
        seconds=0.1 * np.arange(SCANS),
        position=np.cumsum(rng.normal(0.0, 0.1, (SCANS, 3)), axis=0),
        sigma=rng.uniform(0.001, 0.1, (SCANS, 6)),
        log=RowLog(time_ns, status, numbers, pairs, short.log.columns),
        map_points=rng.uniform(-200.0, 200.0, (run_data._MOST_POINTS, 3)).astype(np.float32) * np.float32([1.0, 1.0, 0.05]),
    )


def test_a_run_of_10000_scans_fits_into_3_megabytes(tmp_path: Path) -> None:
    run_odometry(as_recording(simulate("walk", duration_s=1.5, lidar=SpinningLidar(azimuth_steps=200))), tmp_path / "out")
    (tmp_path / "long").mkdir()
    written = page.write_page(prolonged(load_run(tmp_path / "out"), tmp_path / "long"))
    assert written.stat().st_size <= 3_000_000


@pytest.mark.parametrize("word", ["http://", "https://"])
def test_the_code_of_the_page_loads_nothing(word: str) -> None:
    assert word not in (Path(page.__file__).parent / "page.js").read_text(encoding="utf-8")
