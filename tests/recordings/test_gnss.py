"""Positions by satellite in bags and in KITTI's folders: which topic, what is read, what is left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import RecordingError
from boxplus.recordings import RecordingOptions, open_recording
from boxplus.recordings.kitti_oxts import oxts_fixes
from tests.bags import CONTAINERS, START_NS, Container, Content, write_bag

PLACES = [(k * 100_000_000, (49.0 + 1e-5 * k, 8.4, 115.0 + k), 0) for k in range(5)]
MOUNTED = [("imu", "antenna", np.array([0.1, -0.2, 0.9, 0.0, 0.0, 0.0, 1.0]))]


@pytest.mark.parametrize("container", CONTAINERS)
def test_fixes_come_back_as_they_were_written(tmp_path: Path, container: Container) -> None:
    content = Content(fixes=[*PLACES, (50_000_000, (0.0, 0.0, 0.0), -1)], transforms=MOUNTED)
    with open_recording(write_bag(tmp_path, container, content)) as recording:
        info, fixes = recording.info, recording.fixes()
        assert len(list(recording)) > 5  # scans and samples are what they are without
    assert info.gnss_topic == "/fix"
    assert info.p_imu_antenna is not None and info.p_imu_antenna.tolist() == [0.1, -0.2, 0.9]
    assert fixes.time_ns.tolist() == [START_NS + offset for offset, _, _ in PLACES]
    assert fixes.lat_lon_alt.tolist() == [list(place) for _, place, _ in PLACES]
    assert fixes.covariance[0].tolist() == [[1.0, 0.1, 0.0], [0.1, 2.0, 0.0], [0.0, 0.0, 9.0]]
    assert dict(fixes.rejected) == {"no fix": 1}


def test_a_covariance_of_unknown_type_is_unknown(tmp_path: Path) -> None:
    with open_recording(write_bag(tmp_path, "ros1", Content(fixes=PLACES, fix_covariance_type=0))) as recording:
        assert not recording.fixes().has_covariance.any()
        assert recording.info.p_imu_antenna is None
        assert any(e.key == "p_imu_antenna" and "--gnss-lever-arm" in e.text for e in recording.info.evidence)


def test_several_receivers_are_not_chosen_between(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", Content(fixes=PLACES, fix_topics=("/fix", "/rtk")))
    with open_recording(path) as recording:
        assert recording.info.gnss_topic == "" and len(recording.fixes()) == 0
        assert any(e.key == "gnss_topic" and e.verdict == "warning" and "/rtk (5)" in e.text for e in recording.info.evidence)
    with open_recording(path, RecordingOptions(gnss_topic="/rtk")) as recording:
        assert recording.info.gnss_topic == "/rtk" and len(recording.fixes()) == 5
    with open_recording(path, RecordingOptions(gnss_topic="none")) as recording:
        assert recording.info.gnss_topic == "" and not any(e.key == "gnss_topic" for e in recording.info.evidence)
    with pytest.raises(RecordingError, match="another --gnss-topic"):
        open_recording(path, RecordingOptions(gnss_topic="/imu"))


def test_only_the_stretch_that_is_read_has_fixes(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", Content(fixes=PLACES))
    with open_recording(path, RecordingOptions(start_s=0.15)) as recording:
        assert len(recording.fixes()) == 3


def test_rows_of_the_oxts(tmp_path: Path) -> None:
    files = []
    for k, (accuracy, mode) in enumerate([(0.05, 6), (2.5, 3), (0.0, -1), (9.0, 0)]):
        row = np.zeros(30)
        row[:3], row[23], row[27] = (49.0, 8.4, 115.0 + k), accuracy, mode
        files.append(tmp_path / f"{k}.txt")
        files[-1].write_text(" ".join(map(str, row)))
    files.append(tmp_path / "missing.txt")
    fixes = oxts_fixes(files, np.arange(5))
    assert fixes.lat_lon_alt[:, 2].tolist() == [115.0, 116.0, 117.0]
    assert fixes.status.tolist() == [2, 0, 0]
    np.testing.assert_allclose(np.diagonal(fixes.covariance[0]), [0.0025, 0.0025, 0.01])
    assert fixes.has_covariance.tolist() == [True, True, False]
    assert dict(fixes.rejected) == {"no fix": 1, "not finite": 1}


def test_modes_without_a_position_of_their_own_are_no_fixes(tmp_path: Path) -> None:
    """Blanked, without data, velocities only; and a mode that is no number tells nothing, which once ended the run at its end."""
    files = []
    for k, mode in enumerate([10, 11, 12, 20, 25, 16, np.nan, 3]):
        row = np.zeros(30)
        row[:3], row[23], row[27] = (49.0, 8.4, 115.0 + k), 0.05, mode
        files.append(tmp_path / f"{k}.txt")
        files[-1].write_text(" ".join(map(str, row)))
    fixes = oxts_fixes(files, np.arange(len(files)))
    assert fixes.lat_lon_alt[:, 2].tolist() == [120.0, 121.0, 122.0] and fixes.status.tolist() == [2, 0, 0]
    assert dict(fixes.rejected) == {"no fix": 5}
