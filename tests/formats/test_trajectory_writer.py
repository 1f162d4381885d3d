"""Writing a trajectory while a run goes on."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import InputError, OutputError
from boxplus.formats.trajectory import read_trajectory
from boxplus.formats.trajectory_writer import TrajectoryWriter

POSE = (np.eye(3), np.array([1.0, 2.0, 3.0]), np.diag(np.arange(1.0, 7.0)), "ok")


def test_three_files_hold_the_poses_before_close(tmp_path: Path) -> None:
    with TrajectoryWriter(tmp_path / "new" / "folder") as writer:
        for i in range(3):
            writer.append(10**18 + i, *POSE[:3], ("ok", "weak(x, yaw)", "lost")[i])
        tum, kitti, csv = (read_trajectory(writer.paths[name]) for name in ("tum", "kitti", "csv"))
        assert writer.count == 3
    assert tum.times.tolist() == csv.times.tolist() == [10**18, 10**18 + 1, 10**18 + 2]
    assert len(kitti) == 3
    assert csv.status == ("ok", "weak(x, yaw)", "lost")
    np.testing.assert_array_equal(csv.covariance[1], POSE[2])
    np.testing.assert_array_equal(kitti.p[0], POSE[1])


def test_a_killed_process_leaves_all_its_rows(tmp_path: Path) -> None:
    script = textwrap.dedent(
        f"""
        import os, signal, numpy as np
        from boxplus.formats.trajectory_writer import TrajectoryWriter
        writer = TrajectoryWriter({str(tmp_path)!r})
        for i in range(50):
            writer.append(i, np.eye(3), np.zeros(3), np.eye(6), "ok")
        os.kill(os.getpid(), signal.SIGKILL)
        """
    )
    result = subprocess.run([sys.executable, "-c", script], check=False)
    assert result.returncode == -signal.SIGKILL
    for name in ("trajectory.tum", "trajectory.kitti.txt", "trajectory.csv"):
        assert len(read_trajectory(tmp_path / name)) == 50


def test_full_disk_takes_the_row_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = TrajectoryWriter(tmp_path)
    writer.append(0, *POSE)
    real = os.write
    budget = 500

    def full(file: int, data: bytes) -> int:
        nonlocal budget
        if budget == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        count = min(budget, len(data))
        budget -= count
        return real(file, data[:count])

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OutputError, match=r"expected to write .* – got a full disk – free some space .* is intact"):
        for i in range(1, 5):
            writer.append(i, *POSE)
    monkeypatch.undo()
    kept = writer.count
    writer.append(100, *POSE)  # the disk has space again
    writer.close()
    for path in writer.paths.values():
        poses = read_trajectory(path)
        assert len(poses) == kept + 1
        assert poses.warnings == ()


def test_bad_poses_are_refused(tmp_path: Path) -> None:
    with TrajectoryWriter(tmp_path) as writer:
        writer.append(5, *POSE)
        with pytest.raises(InputError, match="a time after 5 ns – got 5 ns"):
            writer.append(5, *POSE)
        with pytest.raises(InputError, match=r"p_world_imu as finite numbers of shape \(3,\) – got NaN"):
            writer.append(6, POSE[0], [0.0, np.nan, 0.0], POSE[2], "ok")
        with pytest.raises(InputError, match=r"covariance_6x6 as .* – got shape \(3, 3\)"):
            writer.append(6, POSE[0], POSE[1], np.eye(3), "ok")
    with pytest.raises(OutputError, match="append before close"):
        writer.append(7, *POSE)


def test_unwritable_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="expected to write"):
        TrajectoryWriter(tmp_path / "file")
    (tmp_path / "trajectory.csv").mkdir()
    with pytest.raises(OutputError, match=r"trajectory\.csv – got something else of that name"):
        TrajectoryWriter(tmp_path)
