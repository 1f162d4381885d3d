"""A real Ray cluster on this machine; two nodes, one of which is killed in the middle."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from boxplus.runs.fleet import fleet_run
from boxplus.runs.fleet.executor import InProcess, RayExecutor
from boxplus.runs.fleet.fleet_run import run_fleet
from boxplus.runs.fleet.status import RecordingStatus
from boxplus.runs.sessions.config import MergeConfig
from boxplus.runs.settings_file import load_settings
from boxplus.runs.slam.config import SlamRunConfig
from tests.runs.fleet.test_fleet_run import QUICK, drive

ray = pytest.importorskip("ray", reason="needs Ray, the extra fleet")
pytestmark = pytest.mark.slow


def work(folder: str, number: int) -> int:
    """Leaves a file for every attempt, and takes long enough for its node to be killed."""
    node = ray.get_runtime_context().get_node_id() if ray.is_initialized() else "here"
    (Path(folder) / f"{number}_{node}_{time.time_ns()}").touch()
    time.sleep(1.5)
    if number == 3:
        raise ValueError("no such recording")
    return number * number


def drive_on_a_node(store: str, name: str, recording: str, config: SlamRunConfig) -> RecordingStatus:
    """As `drive`, with a mark of the node, and long enough for this to be killed when half of it is written."""
    status = drive(store, name, recording, config)
    marks = Path(store).with_name("marks")
    marks.mkdir(exist_ok=True)
    if ray.is_initialized():
        node = ray.get_runtime_context().get_node_id()
        (Path(store) / "runs" / name / "run.json").unlink(missing_ok=True)  # not finished yet
        (marks / f"{name}_{node}_{time.time_ns()}").touch()
        time.sleep(2.0)
        status = drive(store, name, recording, config)
    return status


@pytest.fixture
def cluster() -> Iterator[Any]:
    from ray.cluster_utils import Cluster

    two = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    yield two
    two.shutdown()


def test_nothing_is_lost_when_a_node_dies(cluster: Any, tmp_path: Path) -> None:
    second = cluster.add_node(num_cpus=2)
    cluster.wait_for_nodes()
    arguments = [(str(tmp_path), number) for number in range(6)]

    def kill_when_busy() -> None:
        while not list(tmp_path.glob(f"*_{second.node_id}_*")):
            time.sleep(0.05)
        cluster.remove_node(second, allow_graceful=False)

    killer = threading.Thread(target=kill_when_busy, daemon=True)
    killer.start()
    with RayExecutor(cluster.address) as executor:
        ends = {end.number: end for end in executor.run(work, arguments)}
    killer.join(timeout=30)
    assert {number: end.value for number, end in ends.items()} == {k: None if k == 3 else k * k for k in range(6)}
    assert ends[3].error == "ValueError: no such recording"
    attempts = [int(path.name.split("_")[0]) for path in tmp_path.iterdir()]
    assert len(attempts) > len(set(attempts)) == 6  # what had begun on the node that died was begun again


def test_a_fleet_whose_node_dies_leaves_the_same_bits(cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recordings = {name: Path(name) for name in ("friday", "monday")}
    merging = load_settings(MergeConfig, None, QUICK)
    monkeypatch.setattr(fleet_run, "run_recording", drive_on_a_node)
    quiet = run_fleet(recordings, tmp_path / "quiet", InProcess(), None, merging)
    second = cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    marks = tmp_path / "marks"

    def kill_when_busy() -> None:
        while not list(marks.glob(f"*_{second.node_id}_*")):
            time.sleep(0.05)
        cluster.remove_node(second, allow_graceful=False)

    killer = threading.Thread(target=kill_when_busy, daemon=True)
    killer.start()
    with RayExecutor(cluster.address) as executor:
        status = run_fleet(recordings, tmp_path / "killed", executor, None, merging)
    killer.join(timeout=30)
    assert len(list(marks.iterdir())) == 3  # one recording was run twice
    assert status.joined == quiet.joined == ["friday", "monday"] and not status.doubts
    folders = [tmp_path / name for name in ("quiet", "killed")]
    files = [{path.relative_to(folder) for path in folder.rglob("*") if path.is_file()} for folder in folders]
    assert files[0] == files[1]
    dated = ("run.json", "fleet.json")
    differing = [
        name for name in files[0] if name.name not in dated and len({(folder / name).read_bytes() for folder in folders}) > 1
    ]
    assert [str(name) for name in differing if name.parts[0] != "pairs"] == []  # these have the keys of dated files


def test_a_cluster_of_its_own_is_started_and_stopped(tmp_path: Path) -> None:
    with RayExecutor(workers=2) as executor:
        ends = sorted(executor.run(work, [(str(tmp_path), 2), (str(tmp_path), 3)]), key=lambda end: end.number)
    assert [end.value for end in ends] == [4, None] and ends[1].error == "ValueError: no such recording"
    assert not ray.is_initialized()
