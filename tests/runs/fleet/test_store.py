"""Where a fleet's results lie: whole or not there, in a folder as in an object store."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from boxplus.errors import InputError, OutputError
from boxplus.runs.fleet.store import ObjectStore, SharedFolder, Store, open_store


@pytest.fixture(params=["folder", "file", "memory", "local"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    if request.param == "local":  # objects, whose store is a disk
        return ObjectStore(f"file://{tmp_path}/objects")
    text = {"folder": str(tmp_path), "file": f"file://{tmp_path}", "memory": f"memory://{tmp_path}"}[request.param]
    return open_store(text)


def test_what_is_written_is_read_by_whoever_opens_the_store(store: Store) -> None:
    again = ObjectStore(store.text) if isinstance(store, ObjectStore) else open_store(store.text)
    assert type(again) is type(store) and store.read("runs/a/run.json") is None
    store.write("runs/a/run.json", b"one")
    store.write("runs/a/run.json", b"two")
    with store.writing("runs/b") as folder:
        (folder / "odometry").mkdir(parents=True, exist_ok=True)
        (folder / "odometry" / "run.json").write_bytes(b"inner")
        (folder / "map").mkdir(exist_ok=True)
        (folder / "map" / "tile.ply").write_bytes(b"points")
        (folder / "run.json").write_bytes(b"three")
    assert [again.read(f"runs/{name}/run.json") for name in "ab"] == [b"two", b"three"]
    with again.reading("runs/b", ("run.json", "odometry/run.json")) as folder:
        assert (folder / "run.json").read_bytes() == b"three" and (folder / "odometry" / "run.json").read_bytes() == b"inner"
        assert (folder / "map").exists() == isinstance(store, SharedFolder)  # nothing is fetched that nobody needs
    with again.reading("runs/b") as folder:
        assert (folder / "map" / "tile.ply").read_bytes() == b"points"
    store.remove("runs/b")
    store.remove("runs/b")
    assert again.read("runs/b/run.json") is None and again.read("runs/a/run.json") == b"two"


def test_a_run_that_could_not_be_brought_whole_does_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = ObjectStore(f"memory://{tmp_path}")
    put = store._files.put_file

    def full(source: str, target: str) -> None:
        if target.endswith("trajectory.csv"):
            raise OSError(28, "No space left on device")
        put(source, target)

    def bring(content: bytes, *more: str) -> None:
        with store.writing("runs/a") as folder:
            for name in ("config.yaml", "run.json", "trajectory.csv", *more):
                (folder / name).write_bytes(content)

    bring(b"1", "loops.csv")
    monkeypatch.setattr(store._files, "put_file", full)
    with pytest.raises(OutputError, match="runs/a – got a full disk"):
        bring(b"2")
    assert store.read("runs/a/run.json") is None  # and so the earlier run's does not stand beside the later one's settings
    monkeypatch.undo()
    bring(b"3")
    assert store.read("runs/a/run.json") == b"3" and store.read("runs/a/loops.csv") is None


def test_a_joint_map_takes_the_place_of_the_earlier_one(store: Store) -> None:
    for round in range(2):
        with store.joint_map() as into:
            store.write(f"{into}/config.yaml", b"%d" % round)
            store.write(f"{into}/map/tiles/x+00000_y+00000_z+00000/0000000{round}.ply", b"points")
            store.write(f"{into}/run.json", b'{"program": "boxplus map merge"}')
        assert store.read("merged/config.yaml") == b"%d" % round
    assert store.read("merged/map/tiles/x+00000_y+00000_z+00000/00000000.ply") is None
    with pytest.raises(KeyError), store.joint_map() as into:
        raise KeyError
    assert (store.read("merged/run.json") is None) == isinstance(store, ObjectStore)


def test_a_url_without_a_driver_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        InputError, match=r"a URL that fsspec has a driver for – got nothing://bucket/fleet: .* install its driver"
    ):
        open_store("nothing://bucket/fleet")
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(InputError, match=r"pip install .*ray"):
        open_store("memory://fleet")
