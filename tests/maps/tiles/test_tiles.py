"""Map tiles on disk: nothing is lost, nothing is doubled, and what is incomplete is said."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import textwrap
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.errors import InputError, OutputError
from boxplus.formats.clouds.pcd import read_pcd
from boxplus.formats.clouds.ply import PlyWriter, read_ply
from boxplus.maps.tiles.journal import read_journal
from boxplus.maps.tiles.layout import list_journals, read_manifest
from boxplus.maps.tiles.store import TileStore, merge
from boxplus.maps.tiles.voxel_thinning import RecentVoxels, first_per_voxel
from boxplus.maps.tiles.writer import TileWriter


def cloud(count: int, seed: int = 0, scale: float = 60.0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-scale, scale, (count, 3)).astype(np.float32)


def everything(store: TileStore) -> np.ndarray:
    tiles = [tile.points for tile in store.iter_tiles()]
    return np.concatenate([np.empty((0, 3), np.float32), *tiles])


def multiset(points: np.ndarray) -> Counter[bytes]:
    return Counter(row.tobytes() for row in np.ascontiguousarray(points, dtype=np.float32))


@settings(max_examples=25, deadline=None)
@given(
    sizes=st.lists(st.integers(0, 300), max_size=8),
    bound=st.integers(1, 700),
    tile_size=st.sampled_from([7.0, 50.0, 500.0]),
    reopen_after=st.integers(0, 8),
)
def test_every_point_comes_back_once(
    tmp_path_factory: pytest.TempPathFactory, sizes: list[int], bound: int, tile_size: float, reopen_after: int
) -> None:
    folder = tmp_path_factory.mktemp("map") / "map"
    blocks = [cloud(size, seed) for seed, size in enumerate(sizes)]
    for part in (blocks[:reopen_after], blocks[reopen_after:]):
        with TileWriter(folder, tile_size, bound) as writer:
            for block in part:
                writer.append(block.astype(np.float64), block[:, 0])
    store = TileStore.open(folder)
    assert store.report == ()
    assert store.manifest.closed
    expected = np.concatenate([np.empty((0, 3), np.float32), *blocks])
    assert multiset(everything(store)) == multiset(expected)
    assert store.point_count == len(expected)
    for tile in store.iter_tiles():
        np.testing.assert_array_equal(np.floor(tile.points.astype(float) / tile_size), np.tile(tile.index, (len(tile.points), 1)))
        np.testing.assert_array_equal(tile.intensity, tile.points[:, 0])


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), bound=st.integers(1, 2000), voxel=st.sampled_from([0.5, 1.0, 2.0]))
def test_thinning_leaves_one_point_in_every_occupied_voxel(
    tmp_path_factory: pytest.TempPathFactory, seed: int, bound: int, voxel: float
) -> None:
    folder = tmp_path_factory.mktemp("map") / "map"
    blocks = [cloud(400, seed + i, 4.0) for i in range(12)]
    with TileWriter(folder, 10.0, bound, voxel) as writer:
        for block in blocks:
            writer.append(block)
    points = everything(TileStore.open(folder))
    cells = Counter(map(tuple, np.floor(points.astype(float) / voxel).astype(int).tolist()))
    assert set(cells) == set(map(tuple, np.floor(np.concatenate(blocks).astype(float) / voxel).astype(int).tolist()))
    assert max(cells.values()) == 1
    assert multiset(points) <= multiset(np.concatenate(blocks))


def test_disk_space_does_not_grow_with_time(tmp_path: Path) -> None:
    with TileWriter(tmp_path / "map", 50.0, 200, voxel=1.0) as writer:
        writer._recent = RecentVoxels(1.0, capacity_bits=4)  # forgets nearly everything, as after a long way round
        for seed in range(100):
            writer.append(cloud(500, seed, 5.0))
    files = list((tmp_path / "map").rglob("*.ply"))
    stored = sum(len(read_ply(file)) for file in files)
    occupied = 1000
    assert writer.stored > 20 * occupied
    assert stored < 3 * occupied
    assert list_journals(tmp_path / "map") == {}


@given(seed=st.integers(0, 1000), voxel=st.floats(0.01, 5.0))
def test_first_per_voxel_against_a_dictionary(seed: int, voxel: float) -> None:
    points = cloud(200, seed, 6.0)
    first: dict[tuple[int, ...], int] = {}
    for row, point in enumerate(np.floor(points.astype(np.float64) * (1.0 / voxel)).astype(int).tolist()):
        first.setdefault(tuple(point), row)
    assert first_per_voxel(points, voxel).tolist() == sorted(first.values())


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), bits=st.integers(3, 12))
def test_recent_voxels_never_loses_a_voxel(seed: int, bits: int) -> None:
    recent = RecentVoxels(1.0, bits)
    blocks = [cloud(200, seed + i, 5.0) for i in range(5)]
    kept = np.concatenate([block[recent.new(block)] for block in blocks])
    occupied = {tuple(cell) for cell in np.floor(np.concatenate(blocks)).tolist()}
    assert {tuple(cell) for cell in np.floor(kept).tolist()} == occupied
    if bits == 12:  # 4096 places for at most 1000 voxels: hardly any is forgotten
        assert len(kept) < 1.1 * len(occupied)


def test_a_killed_run_loses_no_block_and_says_so(tmp_path: Path) -> None:
    folder = tmp_path / "map"
    script = textwrap.dedent(
        f"""
        import os, signal, numpy as np
        from boxplus.maps.tiles.writer import TileWriter
        writer = TileWriter({str(folder)!r}, max_buffered_points=1000)
        for seed in range(25):
            writer.append(np.random.default_rng(seed).uniform(-60, 60, (100, 3)).astype(np.float32))
        os.kill(os.getpid(), signal.SIGKILL)
        """
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == -signal.SIGKILL
    expected = multiset(np.concatenate([cloud(100, seed) for seed in range(25)]))
    store = TileStore.open(folder)
    assert not store.manifest.closed
    assert store.report[0].startswith("the run that wrote this map did not close it")
    assert any("points were read from journal-" in sentence for sentence in store.report)
    assert multiset(everything(store)) == expected
    with TileWriter(folder) as writer:  # continue it
        writer.append(cloud(10, 99))
    store = TileStore.open(folder)
    assert store.report == ()
    assert multiset(everything(store)) == expected + multiset(cloud(10, 99))


def test_a_kill_between_segments_doubles_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some segments of a generation exist and its journal is still there."""
    writer = TileWriter(tmp_path / "map", 20.0, 100)
    calls = 0
    store_segment = TileWriter._store_segment

    def dies(self: TileWriter, *arguments: object) -> None:
        nonlocal calls
        calls += 1
        if calls == 4:
            raise OSError(errno.EIO, "killed")
        store_segment(self, *arguments)

    monkeypatch.setattr(TileWriter, "_store_segment", dies)
    writer.append(cloud(100))
    with pytest.raises(OutputError):
        writer.close()
    monkeypatch.undo()
    assert len(list((tmp_path / "map").rglob("*.ply"))) == 3
    next((tmp_path / "map" / "tiles").iterdir()).joinpath("00000009.ply.boxplus-tmp").write_bytes(b"ply")
    store = TileStore.open(tmp_path / "map")
    assert multiset(everything(store)) == multiset(cloud(100))
    assert any("was being written when the run ended" in sentence for sentence in store.report)
    TileWriter(tmp_path / "map", 20.0).close()
    store = TileStore.open(tmp_path / "map")
    assert store.report == ()
    assert multiset(everything(store)) == multiset(cloud(100))


def test_journal_cut_anywhere_keeps_whole_blocks(tmp_path: Path) -> None:
    writer = TileWriter(tmp_path / "map")
    for seed in range(3):
        writer.append(cloud(5, seed))
    (path,) = list_journals(tmp_path / "map").values()
    data = path.read_bytes()
    writer.close()
    for end in range(len(data)):
        path.write_bytes(data[:end])
        journal = read_journal(path)
        whole = max(0, end - 12) // (8 + 60)
        assert multiset(journal.records) == multiset(np.concatenate([np.empty((0, 3)), *[cloud(5, s) for s in range(whole)]]))
        assert journal.cut == (end < 12 or (end - 12) % 68 != 0)
    flipped = bytearray(data)
    flipped[30] ^= 1
    path.write_bytes(flipped)
    assert read_journal(path).cut
    assert "its last block was cut and is lost" in TileStore.open(tmp_path / "map").report[-1]


def test_full_disk_keeps_what_was_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = TileWriter(tmp_path / "map")
    for seed in range(3):
        writer.append(cloud(50, seed))
    real, budget = os.write, 300

    def full(file: int, data: bytes) -> int:
        nonlocal budget
        if budget == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        count = min(budget, len(data))
        budget -= count
        return real(file, data[:count])

    monkeypatch.setattr(os, "write", full)
    for _ in range(2):
        with pytest.raises(OutputError, match=r"a full disk – free some space .* everything written before is intact"):
            writer.append(cloud(50, 3))
    writer.close()
    monkeypatch.undo()
    store = TileStore.open(tmp_path / "map")
    assert not store.manifest.closed
    assert multiset(everything(store)) == multiset(np.concatenate([cloud(50, seed) for seed in range(3)]))


def test_full_disk_in_the_background_reaches_the_caller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    writer = TileWriter(tmp_path / "map", max_buffered_points=100)
    writer.append(cloud(50, 0))
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="a full disk"):
        for seed in range(1, 50):
            writer.append(cloud(50, seed))
    stored = writer.stored
    writer.close()
    monkeypatch.undo()
    assert len(everything(TileStore.open(tmp_path / "map"))) == stored
    with TileWriter(tmp_path / "map") as again:
        assert not list_journals(again.folder)
    assert len(everything(TileStore.open(tmp_path / "map"))) == stored


def test_foreign_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(InputError, match=r"an empty folder or one with a boxplus map – got other files .* choose another folder"):
        TileWriter(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(InputError, match=r"a map folder with a manifest\.json – got"):
        TileStore.open(tmp_path)
    with pytest.raises(OutputError, match="something else of that name in the way"):
        TileWriter(tmp_path / "thesis.tex")


def test_a_map_is_continued_only_with_its_own_settings(tmp_path: Path) -> None:
    with TileWriter(tmp_path / "map", 20.0, voxel=0.1) as writer:
        writer.append(cloud(10), np.zeros(10))
    with pytest.raises(InputError, match=r"tile_size 20\.0 m and voxel 0\.1, as the map in .* has – got tile_size 50\.0 m"):
        TileWriter(tmp_path / "map")
    with TileWriter(tmp_path / "map", 20.0, voxel=0.1) as writer, pytest.raises(InputError, match="points with intensities"):
        writer.append(cloud(10))
    for settings_ in (
        {"tile_size": 0.0},
        {"max_buffered_points": 0},
        {"voxel": -0.1},
        {"voxel": 60.0},
        {"tile_size": float("nan")},
    ):
        with pytest.raises(InputError, match="tile_size > 0 m"):
            TileWriter(tmp_path / "other", **settings_)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"format": "other"}', '{"format": "boxplus-map-tiles", "version": 2}', "\0", "segments"]
)
def test_damaged_manifest(tmp_path: Path, text: str) -> None:
    if text == "segments":
        whole = {"format": "boxplus-map-tiles", "version": 1, "tile_size_m": 50.0, "voxel_m": None}
        text = json.dumps({**whole, "segments": "3"})
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(InputError, match=r"a manifest\.json of a version 1 map – got something else"):
        TileStore.open(tmp_path)


def test_points_that_are_none_are_counted(tmp_path: Path) -> None:
    with TileWriter(tmp_path / "map") as writer:
        writer.append([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, 2e6], [1, 2, 3]])
        writer.append(np.empty((0, 3)))
        with pytest.raises(InputError, match=r"shape \(N, 3\)"):
            writer.append(np.zeros((4, 2)))
    assert (writer.rejected, writer.stored) == (3, 1)
    np.testing.assert_array_equal(everything(TileStore.open(tmp_path / "map")), [[1, 2, 3]])
    with pytest.raises(OutputError, match="append before close"):
        writer.append(np.zeros((1, 3)))


def test_a_damaged_segment_is_left_out_and_named(tmp_path: Path) -> None:
    with TileWriter(tmp_path / "map", 1000.0) as writer:
        writer.append(np.ones((5, 3)))
    with TileWriter(tmp_path / "map", 1000.0) as writer:
        writer.append(np.ones((7, 3)))
    first = sorted((tmp_path / "map").rglob("*.ply"))[0]
    first.write_bytes(first.read_bytes()[:-1])
    store = TileStore.open(tmp_path / "map")
    assert store.point_count == 7
    assert len(store.report) == 1
    assert store.report[0].startswith("a segment is damaged and left out: expected 5 points, as the header says – got 4")


def test_missing_segments_are_counted_and_a_map_that_is_continued_counts_anew(tmp_path: Path) -> None:
    points = cloud(4000, seed=9)
    for part in (points[:2000], points[2000:]):
        with TileWriter(tmp_path, tile_size=50.0) as writer:
            writer.append(part)
            assert read_manifest(tmp_path).segments is None
    files = sorted((tmp_path / "tiles").glob("*/*.ply"))
    assert read_manifest(tmp_path).segments == len(files) and TileStore.open(tmp_path).damage == ()
    for gone, file in enumerate(files[:3], start=1):
        file.unlink()
        (damage,) = TileStore.open(tmp_path).damage
        assert damage.startswith(f"{gone} of the {len(files)} segments that were written are not there")


def test_merge(tmp_path: Path) -> None:
    with TileWriter(tmp_path / "map", 20.0, 300) as writer:
        for seed in range(5):
            writer.append(cloud(200, seed), np.arange(200))
    count = merge(tmp_path / "map", [tmp_path / "a.ply", tmp_path / "a.pcd"])
    assert count == 1000
    ply, pcd = read_ply(tmp_path / "a.ply"), read_pcd(tmp_path / "a.pcd")
    expected = np.concatenate([np.column_stack([cloud(200, seed), np.arange(200, dtype=np.float32)]) for seed in range(5)])
    for back in (ply, pcd):
        assert multiset(np.column_stack([back.points, back.intensity])) == multiset(expected)
    thinned = merge(tmp_path / "map", [tmp_path / "b.ply"], voxel=10.0)
    assert thinned == len({tuple(cell) for cell in np.floor(expected[:, :3] / 10.0).tolist()})
    assert len(read_ply(tmp_path / "b.ply")) == thinned
    with pytest.raises(InputError, match="an output file – got none"):
        merge(tmp_path / "map", [])
    with pytest.raises(InputError, match="voxel above"):
        merge(tmp_path / "map", [tmp_path / "c.ply"], voxel=0.0)


def test_empty_map_merges_to_an_empty_cloud(tmp_path: Path) -> None:
    TileWriter(tmp_path / "map").close()
    assert merge(tmp_path / "map", [tmp_path / "a.ply"]) == 0
    assert len(read_ply(tmp_path / "a.ply")) == 0


def test_manifest_says_open_while_running(tmp_path: Path) -> None:
    writer = TileWriter(tmp_path / "map")
    assert json.loads((tmp_path / "map" / "manifest.json").read_text())["closed"] is False
    writer.close()
    writer.close()
    assert json.loads((tmp_path / "map" / "manifest.json").read_text())["closed"] is True


@pytest.mark.parametrize("with_intensity", [False, True])
def test_a_tile_of_another_map_is_named(tmp_path: Path, with_intensity: bool) -> None:
    """Points with and without intensities do not fit into one array; reading stopped with NumPy's error."""
    points = cloud(50, scale=5.0)
    intensity = np.ones(50, np.float32) if with_intensity else None
    with TileWriter(tmp_path / "map") as writer:
        writer.append(points, intensity)
    (segment, *_) = sorted((tmp_path / "map").rglob("*.ply"))
    with PlyWriter(segment) as other:
        other.append(points, None if with_intensity else np.ones(50, np.float32))
    with pytest.raises(
        InputError, match=rf"expected points with(out)? intensities, as manifest.json says – got .* in .*{segment.name}"
    ):
        list(TileStore.open(tmp_path / "map").iter_tiles())


def test_a_foreign_tile_does_not_stop_a_run(tmp_path: Path) -> None:
    """Where segments are due to be joined; every point of the run stays."""
    points = cloud(50, scale=5.0)
    for generation in range(7):
        with TileWriter(tmp_path / "map", voxel=0.01) as writer:
            writer.append(points + generation)
        if generation == 1:
            segment = max((tmp_path / "map").rglob("*.ply"))
            with PlyWriter(segment) as other:
                other.append(points, np.ones(50, np.float32))
    assert segment.exists()
