"""One cloud a scan: they are the scans, where the trajectory says, whatever interrupts the run."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_file import read_cloud
from boxplus.formats.trajectory import read_trajectory
from boxplus.recordings.recording import Recording
from boxplus.runs.lidar_inertial import odometry_run
from boxplus.runs.lidar_inertial.config import load_run_config
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.lidar_inertial.scan_clouds import ScanCloudWriter
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.live_recording import as_recording
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate

SETTINGS = ("scan_voxel=0.5", "map.save=false")


@pytest.fixture(scope="module")
def recording() -> Recording:
    return as_recording(simulate("walk", duration_s=3.0, lidar=SpinningLidar(azimuth_steps=100)))


class Kept:
    """Every estimate that was shown."""

    def __init__(self) -> None:
        self.estimates: list[Estimate] = []

    def show(self, estimate: Estimate) -> None:
        self.estimates.append(estimate)


def clouds(folder: Path) -> dict[int, bytes]:
    return {int(path.stem): path.read_bytes() for path in folder.iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["pcd", "laz"])
def test_they_are_the_scans_at_the_poses_of_the_trajectory(recording: Recording, tmp_path: Path, ending: str) -> None:
    if ending == "laz":
        pytest.importorskip("laspy")
    kept = Kept()
    for frame in ("body", "world"):
        config = load_run_config(settings=[*SETTINGS, f"scans.frame={frame}", f"scans.ending={ending}"])
        run_odometry(recording, tmp_path / frame, config, view=kept)
    trajectory = read_trajectory(tmp_path / "body" / "trajectory.csv")
    assert len(trajectory) > 15
    for frame in ("body", "world"):
        assert sorted(clouds(tmp_path / frame / "scans")) == trajectory.times.tolist()
    for k, estimate in enumerate(kept.estimates[: len(trajectory)]):
        body, world = (read_cloud(tmp_path / frame / "scans" / f"{estimate.time_ns}.{ending}") for frame in ("body", "world"))
        np.testing.assert_allclose(world.points, estimate.points_world(), atol=1e-4)
        np.testing.assert_allclose(body.points @ trajectory.R[k].T + trajectory.p[k], world.points, atol=2e-4)
        assert (body.intensity is None) == (estimate.intensity is None)


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on_as_if_nothing_had_happened(recording: Recording, tmp_path: Path) -> None:
    config = load_run_config(settings=[*SETTINGS, "scans.frame=world"])
    run_odometry(recording, tmp_path / "whole", config)
    kept, out = Kept(), tmp_path / "out"
    run_odometry(recording, out, config, view=kept, should_stop=lambda: len(kept.estimates) >= 9)
    assert 9 <= len(clouds(out / "scans")) < 15
    (out / "scans" / "17.pcd.boxplus-tmp").write_bytes(b"torn")  # as a kill leaves it
    run_odometry(recording, out, config, resume=True)
    assert {**clouds(tmp_path / "whole" / "scans"), 17: b"torn"} == {
        int(path.name.split(".")[0]): path.read_bytes() for path in (out / "scans").iterdir()
    }
    (out / "scans" / "mine.txt").write_text("mine")
    run_odometry(recording, out, load_run_config(settings=SETTINGS), overwrite=True)
    assert [path.name for path in (out / "scans").iterdir()] == ["mine.txt"]


def test_scans_that_are_lost_have_no_place_in_the_world(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep = odometry_run._Run.keep

    def lost(self: object, estimate: Estimate) -> None:
        keep(self, replace(estimate, status="lost"))  # type: ignore[arg-type]

    monkeypatch.setattr(odometry_run._Run, "keep", lost)
    for frame, count in (("body", True), ("world", False)):
        run_odometry(recording, tmp_path / frame, load_run_config(settings=[*SETTINGS, f"scans.frame={frame}"]))
        assert bool(clouds(tmp_path / frame / "scans")) == count


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["pcd", "ply", "las", "laz", "e57"])
def test_of_several_lidars_the_number_is_kept_or_the_ending_refused(recording: Recording, tmp_path: Path, ending: str) -> None:
    for library in {"las": ["laspy"], "laz": ["laspy"], "e57": ["pye57"]}.get(ending, []):
        pytest.importorskip(library)
    config = load_run_config(settings=[f"scans.ending={ending}", "scans.frame=body"]).scans
    kept = Kept()
    run_odometry(
        recording, tmp_path / "run", load_run_config(settings=SETTINGS), view=kept, should_stop=lambda: bool(kept.estimates)
    )
    several = replace(kept.estimates[0], lidar=(np.arange(len(kept.estimates[0].p_lidar)) % 2).astype(np.uint8))
    if ending == "e57":
        ScanCloudWriter(tmp_path / "one", config)
        with pytest.raises(
            InputError, match=r"expected files for the scans of 2 LiDARs .* – got scans.ending=e57 – choose another"
        ):
            ScanCloudWriter(tmp_path / "scans", config, 2)
        return
    ScanCloudWriter(tmp_path / "scans", config, 2).write(several)
    cloud = read_cloud(tmp_path / "scans" / f"{several.time_ns}.{ending}", everything=True)
    assert np.array_equal(cloud.columns["lidar"], several.lidar)


def test_a_format_without_its_library_is_refused_before_the_run(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(InputError, match=r"pip install .*pye57"):
        run_odometry(recording, tmp_path / "out", load_run_config(settings=[*SETTINGS, "scans.frame=body", "scans.ending=e57"]))
