"""A real Ray cluster on this machine; two nodes, one of which is killed in the middle."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from boxplus.runs.fleet.executor import RayExecutor

ray = pytest.importorskip("ray", reason="needs Ray, the extra fleet")


def work(folder: str, number: int) -> int:
    """Leaves a file for every attempt, and takes long enough for its node to be killed."""
    node = ray.get_runtime_context().get_node_id() if ray.is_initialized() else "here"
    (Path(folder) / f"{number}_{node}_{time.time_ns()}").touch()
    time.sleep(1.5)
    if number == 3:
        raise ValueError("no such recording")
    return number * number


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


def test_a_cluster_of_its_own_is_started_and_stopped(tmp_path: Path) -> None:
    with RayExecutor(workers=2) as executor:
        ends = sorted(executor.run(work, [(str(tmp_path), 2), (str(tmp_path), 3)]), key=lambda end: end.number)
    assert [end.value for end in ends] == [4, None] and ends[1].error == "ValueError: no such recording"
    assert not ray.is_initialized()
