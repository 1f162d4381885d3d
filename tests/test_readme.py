"""Every command and every line of Python in the README and in the pages for users runs; every link leads somewhere."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel

from boxplus.maps.descriptors.config import DescriptorConfig
from boxplus.maps.local_maps.config import LocalMapConfig, LocalMapRegistrationConfig
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.recordings.options import RecordingOptions
from boxplus.runs.lidar_inertial.config import MapConfig
from boxplus.runs.lidar_inertial.scan_clouds import ScanCloudConfig
from boxplus.simulation import simulate, write_recording
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.georeference.config import GeoreferenceConfig
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.localization.config import LocalizationConfig
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.visual_inertial_odometry.config import VioConfig
from tests.runs.sessions.runs import written_run
from tests.small_problems import write_small_files

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PYTHON_PAGES = [
    ROOT / "README.md",
    *(
        ROOT / "docs" / f"{name}.md"
        for name in (
            "library_use",
            "least_squares",
            "bundle_adjustment",
            "pose_graphs",
            "extending",
            "coming_from",
            "differentiation",
        )
    ),
]


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


COMMANDS = [line for block in blocks(ROOT / "README.md", "sh") for line in block.splitlines() if line.strip()]


@pytest.fixture(scope="session")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that the README speaks of: flight.bag, flight.gt.tum, scene.txt.bz2, loops.g2o and tuesday.bag."""
    folder = tmp_path_factory.mktemp("flight")
    write_small_files(folder)
    write_recording(simulate("walk", duration_s=6.0), folder / "flight", "ros1")
    shutil.copy(folder / "flight.bag", folder / "tuesday.bag")
    return folder


def run(arguments: list[str], folder: Path, code: int = 0) -> str:
    """Run a command that is to end with `code`; its output. A make that runs the tests must not lend its settings to another."""
    environment = {key: value for key, value in os.environ.items() if key not in ("MAKEFLAGS", "MAKELEVEL", "MFLAGS")}
    done = subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == code, f"{shlex.join(arguments)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def make(target: str, *settings: str) -> str:
    """Run a target of the Makefile in the environment of this test, which is set up already."""
    old = [argument for stamp in (".python", ".runtime", ".dev") for argument in ("-o", f"{sys.prefix}/{stamp}")]
    return run(["make", "--no-print-directory", *old, target, f"VENV={sys.prefix}", *settings], ROOT)


def test_the_readme_has_the_two_commands_and_the_main_job() -> None:
    assert COMMANDS[:2] == ["make demo", "make test"]
    assert any(" lio " in command for command in COMMANDS)


@pytest.mark.slow
def test_make_demo_ends_with_accuracy_speed_and_report(tmp_path: Path) -> None:
    output = make("demo", f"OUTPUT={tmp_path}", "DEMO_ARGS=--duration 8")
    accuracy, speed, report = output.strip().splitlines()[-3:]
    number = re.fullmatch(r"accuracy +([0-9.]+) cm position, .*", accuracy)
    assert number is not None and float(number[1]) < 10.0
    assert re.fullmatch(r"speed +[0-9.]+ ms per scan .*", speed)
    assert "report" in report and Path(report.split()[1]).stat().st_size > 10_000


@pytest.mark.slow
def test_make_test_runs_the_suite_on_two_processes() -> None:
    output = make("test", "PYTEST_ARGS=tests/test_package.py -k version")
    assert re.search(r"\d+ passed", output.splitlines()[-1])
    plan = make("test", "-n")
    assert "-m pytest -n 2" in plan


def test_a_python_that_is_too_old_is_refused_with_a_sentence(tmp_path: Path) -> None:
    old = tmp_path / "python"
    old.write_text('#!/bin/sh\n[ "$1" = --version ] && echo "Python 3.8.10" && exit 0\nexit 1\n')
    old.chmod(0o755)
    done = subprocess.run(
        ["make", "demo", f"PYTHON={old}", f"VENV={tmp_path}/venv"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode != 0
    assert "boxplus needs Python 3.11 or later" in done.stderr and "Python 3.8.10" in done.stderr
    assert not (tmp_path / "venv").exists()


@pytest.mark.slow
@pytest.mark.parametrize("page", [pytest.param(page, id=page.name) for page in PYTHON_PAGES])
def test_python_of_the_pages_runs(page: Path, workspace: Path) -> None:
    code = blocks(page, "python")
    assert code
    run([sys.executable, "-W", "error", "-c", "\n".join(code)], workspace)


def longer_runs(monday: Path, tuesday: Path) -> None:
    """In place of what the commands before left: runs that are long enough to meet, which the odometry would take minutes for."""
    config, world = DriftConfig(channels=16, azimuth_steps=240, step_m=2.0), city(2, 2, seed=5)
    routes = [[0.0, 0.0], [60.0, 0.0], [60.0, 40.0]], [[60.0, 50.0], [60.0, 0.0], [10.0, 0.0]]
    for seed, (folder, route) in enumerate(zip((monday, tuesday), routes, strict=True), 5):
        assert (folder / "trajectory.tum").is_file()
        shutil.rmtree(folder)
        written_run(folder, world, route, config, seed)


def test_commands_of_the_readme_run(workspace: Path) -> None:
    commands = [shlex.split(command) for command in COMMANDS if not command.startswith("make ")]
    of_lidars = {"inspect", "lio", "refine", "localize", "slam", "map", "fleet"}
    assert {command[1] for command in commands} == {*of_lidars, "simulate", "vio", "eval", "ba", "pgo"}
    code = 0
    for program, *arguments in commands:
        assert program == ".venv/bin/boxplus"
        if arguments[0] == "simulate":
            arguments += ["--duration", "3.2"]
        if arguments[0] in ("refine", "localize", "slam"):
            arguments.append("--no-report")  # that of lio is drawn
        if arguments[:2] == ["map", "merge"]:
            longer_runs(workspace / "monday", workspace / "tuesday")
            arguments += ["--set", "sessions.slam={least_overlap: 0.6, rival_fit: 0.85, descriptor: {candidates: 2}}"]  # faster
        if arguments[0] == "fleet":
            code = 2  # there is no folder of recordings, which is said; or no Ray
        run([sys.executable, "-c", "from boxplus.cli import main; main()", *arguments], workspace, code)
        code = 0
    assert {"trajectory.tum", "run.json"} <= {path.name for path in (workspace / "flight_refined").iterdir()}
    assert len((workspace / "found" / "trajectory.tum").read_text().splitlines()) > 10
    assert (workspace / "both" / "sessions" / "tuesday.tum").is_file()
    assert {"report.html", "trajectory.tum", "map.ply", "config.yaml", "run.json"} <= {
        path.name for path in (workspace / "flight").iterdir()
    }
    assert {"report.html", "trajectory.tum", "landmarks.ply", "evaluation.json"} <= {
        p.name for p in (workspace / "room_run").iterdir()
    }
    for folder, result in (("scene_boxplus", "adjusted.txt.bz2"), ("loops_boxplus", "optimized.g2o")):
        assert {"report.html", "run.json", result} <= {path.name for path in (workspace / folder).iterdir()}


@pytest.mark.parametrize("page", [pytest.param(page, id=str(page.relative_to(ROOT))) for page in PAGES])
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        if not target.startswith("https://"):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_every_page_is_in_the_index() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    pages = [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs").glob("*.ipynb")]
    assert not [page.name for page in pages if page.name != "index.md" and f"({page.name})" not in index]


@pytest.mark.parametrize(
    ("name_of_page", "model"),
    [
        ("configuration", LioConfig),
        ("configuration", RecordingOptions),
        ("configuration", MapConfig),
        ("configuration", ScanCloudConfig),
        ("vio_configuration", VioConfig),
        ("vio_configuration", CameraRecordingOptions),
        ("slam", LocalMapConfig),
        ("slam", SlamConfig),
        ("slam", DescriptorConfig),
        ("slam", LocalMapRegistrationConfig),
        ("gnss", GeoreferenceConfig),
        ("localization", LocalizationConfig),
    ],
)
def test_configuration_page_names_every_setting_and_its_default(name_of_page: str, model: type[BaseModel]) -> None:
    page = (ROOT / "docs" / f"{name_of_page}.md").read_text(encoding="utf-8")
    rows = {cells[0].strip(" `"): cells[1].strip() for cells in re.findall(r"^\| (`\w+`) \| ([^|]+) \|", page, re.MULTILINE)}
    for name, field in model.model_fields.items():
        value = field.default
        if isinstance(value, BaseModel):
            continue  # settings within settings have a table of their own
        text = f"{value:g}" if type(value) in (int, float) else yaml.safe_dump(value).splitlines()[0].strip("'")
        assert rows.get(name, "").strip("`") == text, f"{name}: {rows.get(name)!r}, not {text!r}"


def test_command_line_page_names_the_defaults_of_its_settings() -> None:
    page = (ROOT / "docs" / "command_line.md").read_text(encoding="utf-8")
    sections = {"odometry": LioConfig, "recording": RecordingOptions, "map": MapConfig}
    rows = re.findall(r"^\| `([a-z]\w*)\.(\w+)` \| ([^|]+?) \|", page, re.MULTILINE)
    assert len(rows) >= 4
    for section, name, told in rows:
        value = sections[section].model_fields[name].default
        text = f"{value:g}" if isinstance(value, float) else str(value)
        assert told.split()[0].strip("`") == text, f"{section}.{name}: {told!r}, not {text!r}"
