"""The report: its sections, that it needs nothing from elsewhere, and that it draws any run."""

from __future__ import annotations

import json
import shutil
import types
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.errors import InputError
from boxplus.report import palette, run_data, write_report
from boxplus.report.run_data import load_run
from boxplus.runs.lidar_inertial.config import load_run_config
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.lidar_inertial.summary import read_summary
from boxplus.runs.run_facts import Gap, WarningFacts
from boxplus.runs.run_folder import PLOTS
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.live_recording import as_recording
from boxplus.systems.lidar_inertial_odometry.estimate import WAITED
from tests.report.unpacked import figures_of

LIDAR = SpinningLidar(azimuth_steps=200)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "out"
    run_odometry(as_recording(simulate("walk", duration_s=3.0, lidar=LIDAR)), path)
    return path


class _Page(HTMLParser):
    """Collects headings, and every address a browser would load by itself."""

    def __init__(self) -> None:
        super().__init__()
        self.headings: list[str] = []
        self.loads: list[str] = []
        self.scripts = 0
        self._in_heading = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._in_heading = tag in ("h1", "h2")
        self.scripts += tag == "script"
        self.loads += [value or "" for name, value in attrs if name in ("src", "srcset", "data", "poster")]
        if tag == "link":
            self.loads += [value or "" for name, value in attrs if name == "href"]

    def handle_data(self, data: str) -> None:
        if self._in_heading:
            self.headings.append(data)
            self._in_heading = False


@pytest.mark.slow
def test_a_killed_run_is_counted_by_its_rows(folder: Path, tmp_path: Path) -> None:
    killed = tmp_path / "killed"
    shutil.copytree(folder, killed)
    finished = read_summary(killed / "run.json")
    # As written in the first second of the run; no process has this number.
    unknown = {"scans": 0, "status": {}, "duration_s": 0.0, "path_length_m": 0.0, "first_time_ns": None, "last_time_ns": None}
    finished.model_copy(update={"state": "running", "process": 2**30, **unknown}).write(killed / "run.json")
    rows = (killed / "scans.csv").read_bytes()
    (killed / "scans.csv").write_bytes(rows[:-20])  # the last one is cut
    summary = load_run(killed).summary
    assert summary.scans == sum(summary.status.values()) == finished.scans - 1
    assert 0.9 * finished.duration_s < summary.duration_s < finished.duration_s
    assert 0.0 < summary.path_length_m <= finished.path_length_m
    result = CliRunner().invoke(app, ["report", str(killed)])
    assert result.exit_code == 0
    expected = f"interrupted (the process ended without a word) after at least {finished.scans - 1} scans ("
    assert result.stdout.startswith(expected)
    text = (killed / "report.html").read_text(encoding="utf-8")
    assert f"after at least {finished.scans - 1} scans" in text


def test_a_contradiction_stands_in_the_headline(folder: Path, tmp_path: Path) -> None:
    doubted = tmp_path / "doubted"
    shutil.copytree(folder, doubted)
    summary = read_summary(doubted / "run.json").model_copy(update={"contradiction": "gyroscope and LiDAR turn about other axes"})
    summary.write(doubted / "run.json")
    assert summary.describe_state().endswith(" s); not to be trusted: gyroscope and LiDAR turn about other axes")
    text = write_report(doubted).read_text(encoding="utf-8")
    assert '<span class="state failed">finished</span>' in text
    assert "not to be trusted: gyroscope and LiDAR turn about other axes" in text


def test_page_is_self_contained_and_has_its_sections(folder: Path) -> None:
    report = write_report(folder)
    text = report.read_text(encoding="utf-8")
    page = _Page()
    page.feed(text)
    assert page.loads == []
    assert "@import" not in text.split("</style>")[0]
    assert page.headings == [
        "walk (simulated)",
        "Warnings",
        "Map and trajectory",
        "Status and information",
        "Timing",
        "Velocity",
        "Uncertainty",
        "Biases",
        "Gravity",
        "What the motion has shown",
        "Extrinsic",
        "Points",
        "Gaps and rejections",
        "Run",
        "How the recording was read",
    ]
    figures = [json.loads(figure) for figure in figures_of(text)]
    assert len(figures) == text.count('class="plot"') == 8
    assert all(figure["data"] and figure["layout"]["height"] and figure["config"]["responsive"] for figure in figures)
    for name in PLOTS:
        assert (folder / "plots" / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_troubles_are_on_the_page_and_markup_is_escaped(folder: Path, tmp_path: Path) -> None:
    summary = read_summary(folder / "run.json")
    troubled = summary.model_copy(
        update={
            "state": "failed",
            "error": "expected to write <b> – got a full disk – free some space",
            "warnings": [WarningFacts(text="IMU gap of 0.50 s & more", count=7, first_s=1.25)],
            "imu_gaps": [Gap(begin_s=1.0, duration_s=0.5)],
        }
    )
    copy = tmp_path / "out"
    copy.mkdir()
    for name in ("scans.csv", "trajectory.csv"):
        (copy / name).write_bytes((folder / name).read_bytes())
    troubled.write(copy / "run.json")
    text = write_report(copy).read_text(encoding="utf-8").split("<body>")[1]
    assert "stopped by an error after 29 scans" in text
    assert "got a full disk" in text
    assert "expected to write &lt;b&gt;" in text
    assert "IMU gap of 0.50 s &amp; more <small>(7 times, first at 1.2 s)</small>" in text
    assert "1 (longest 0.50 s) of the IMU, none of the scans" in text
    assert "The run kept no map" in text


def test_refined_extrinsic_is_drawn(tmp_path: Path) -> None:
    config = load_run_config(settings=["extrinsic_estimation=on", "map.save=false"])
    run_odometry(as_recording(simulate("walk", duration_s=2.0, lidar=LIDAR)), tmp_path / "out", config)
    text = write_report(tmp_path / "out").read_text(encoding="utf-8").split("<body>")[1]
    assert "refined throughout" in text
    assert any("rotation, from the first" in figure for figure in figures_of(text))


def test_map_is_thinned_evenly(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = load_run(folder).map_points
    monkeypatch.setattr(run_data, "_MOST_POINTS", 2000)
    few = load_run(folder).map_points
    assert 500 < len(few) <= 2000 < len(whole)
    np.testing.assert_allclose(few.min(axis=0), whole.min(axis=0), atol=3.0)
    np.testing.assert_allclose(few.max(axis=0), whole.max(axis=0), atol=3.0)


def test_seconds_of_waiting_leave_the_rest_to_be_seen(folder: Path) -> None:
    data = load_run(folder)
    highest = palette.highest_ms(data)
    stages = {name: values.copy() for name, values in data.log.pairs("timing_ms").items()}
    waiting, total = np.zeros(len(data.seconds)), data.log.column("total_ms").copy()
    waiting[::5] = 3000.0
    stages[WAITED] = stages[WAITED] + waiting

    class Log:
        def pairs(self, name: str) -> dict[str, NDArray[np.float64]]:
            return stages

        def column(self, name: str) -> NDArray[np.float64]:
            return total + waiting

    waited: Any = types.SimpleNamespace(seconds=data.seconds, log=Log())
    assert palette.highest_ms(waited) == pytest.approx(highest)
    write_report(folder)
    assert f"a scan waits for the verdict ({WAITED})" in (folder / "report.html").read_text(encoding="utf-8")


def test_long_runs_show_their_worst_scans(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(palette, "_MOST_ROWS", 5)
    data = load_run(folder)
    status = np.full(len(data.log), "ok", dtype="<U4")
    status[7] = "lost"
    total = np.zeros(len(data.log))
    total[11] = 99.0
    scans = types.SimpleNamespace(column=lambda name: total)
    fake = types.SimpleNamespace(seconds=data.seconds, status=status, log=scans)
    rows = palette.shown_rows(fake)  # type: ignore[arg-type]
    assert {0, 7, 11, len(status) - 1} <= set(rows.tolist())
    assert (np.diff(rows) > 0).all()


def test_folder_of_something_else(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected the output folder of a run, with run.json – got .* – check the path"):
        write_report(tmp_path)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(
        InputError, match=r"expected run.json as this version of boxplus writes it – got versions: Field required"
    ):
        write_report(tmp_path)
    (tmp_path / "run.json").write_text('{"program": "boxplus map merge"}')
    expected = r"expected the output folder of 'boxplus lio', 'slam', 'vio' or 'vo' – got one of 'boxplus map merge' \(.*\) – "
    with pytest.raises(InputError, match=expected + "it has no report; run.json has the facts"):
        write_report(tmp_path)
    (tmp_path / "report.html").touch()
    with pytest.raises(InputError, match=expected + "open .*report.html, which that command has drawn"):
        write_report(tmp_path)


def test_a_config_in_another_encoding_is_shown_all_the_same(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "out"
    shutil.copytree(folder, copy)
    (copy / "config.yaml").write_bytes("# aus Zürich\n".encode("latin-1"))
    assert "# aus Z\ufffdrich" in write_report(copy).read_text(encoding="utf-8")


def test_an_unknown_status_is_refused(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "out"
    shutil.copytree(folder, copy)
    text = (copy / "scans.csv").read_text(encoding="utf-8")
    (copy / "scans.csv").write_text(text.replace(",ok,", ",fine,", 1), encoding="utf-8")
    with pytest.raises(InputError, match=r"expected a status of ok, weak, lost in scans.csv – got 'fine' \(.*scans.csv\)"):
        load_run(copy)
