"""Bundle adjustment problems in BAL's text: the published files, round trips, and every way a file can be wrong."""

from __future__ import annotations

import bz2
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boxplus.errors import InputError
from boxplus.formats.numbers import lines as number_lines
from boxplus.formats.reconstructions.bal import BalProblem, read_bal, write_bal
from boxplus.formats.reconstructions.gbp import read_gbp
from boxplus.formats.reconstructions.reconstruction import read_reconstruction

NAMES = ("cameras", "points", "camera_of", "point_of", "pixels")


def random_problem(seed: int, cameras: int = 3, points: int = 5, observations: int = 11) -> BalProblem:
    rng = np.random.default_rng(seed)
    return BalProblem(
        cameras=rng.normal(size=(cameras, 9)) * 10.0 ** rng.integers(-9, 4, 9),
        points=rng.normal(size=(points, 3)),
        camera_of=rng.integers(0, cameras, observations),
        point_of=rng.integers(0, points, observations),
        pixels=rng.normal(size=(observations, 2)) * 300.0,
    )


def text_of(tmp_path: Path) -> list[str]:
    write_bal(tmp_path / "problem.txt", random_problem(1))
    return (tmp_path / "problem.txt").read_text().splitlines()


@given(st.integers(0, 1000), st.sampled_from(["problem.txt", "problem.txt.bz2"]), st.sampled_from([64, 1 << 20]))
def test_round_trip_keeps_every_bit(tmp_path_factory: pytest.TempPathFactory, seed: int, name: str, chunk: int) -> None:
    path = tmp_path_factory.mktemp("bal") / name
    problem = random_problem(seed)
    write_bal(path, problem)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(number_lines, "CHUNK", chunk)
        again = read_bal(path)
    for name in NAMES:
        assert np.array_equal(getattr(problem, name), getattr(again, name)), name


def test_parameters_may_share_lines(tmp_path: Path) -> None:
    lines = text_of(tmp_path)
    problem = read_bal(tmp_path / "problem.txt")
    (tmp_path / "packed.txt").write_text("\n".join([*lines[:12], " ".join(lines[12:30]), "", " ".join(lines[30:])]))
    packed = read_bal(tmp_path / "packed.txt")
    assert np.array_equal(problem.cameras, packed.cameras) and np.array_equal(problem.points, packed.points)


@pytest.mark.parametrize(
    ("at", "line", "message"),
    [
        (0, "3 5", r"the numbers of cameras, points and observations – got '3 5' \(.*problem.txt, line 1\)"),
        (0, "3 5 0", r"at least one camera, point and observation – got '3 5 0'"),
        (4, "0 1 2.5", r"an observation: camera index, point index, x, y – got '0 1 2.5' \(.*line 5\)"),
        (4, "0.5 1 2 3", r"an observation: .*line 5\)"),
        (4, "0 1 2 x", r"an observation: .*line 5\)"),
        (4, "3 1 2 2", r"a camera index from 0 to 2 – got '3 1 2 2' \(.*line 5\) – check the counts in the first line"),
        (4, "0 -1 2 2", r"a point index from 0 to 4 – got '0 -1 2 2' \(.*line 5\)"),
        (4, "0 1 nan 2", r"finite numbers – got '0 1 nan 2' \(.*line 5\)"),
        (20, "inf", r"finite parameters of cameras and points – got 'inf' \(.*line 21\)"),
        (20, "1.5 abc", r"finite parameters of cameras and points – got '1.5 abc' \(.*line 21\)"),
        (20, "1.5 2.5", r"no more than 42 numbers after the observations – got .* \(.*line 54\)"),
        (4, "", r"an observation: .* got .*line 13\)"),
    ],
)
def test_wrong_lines_are_refused(tmp_path: Path, at: int, line: str, message: str) -> None:
    lines = text_of(tmp_path)
    lines[at] = line
    (tmp_path / "problem.txt").write_text("\n".join(lines))
    with pytest.raises(InputError, match=message):
        read_bal(tmp_path / "problem.txt")


@pytest.mark.parametrize(
    ("kept", "message"),
    [
        (0, r"expected a bundle adjustment file – got an empty one"),
        (1, r"expected 11 observations – got 0, then the end \(.*line 1\)"),
        (9, r"expected 11 observations – got 8, then the end \(.*line 9\) – the file was cut"),
        (12, r"expected 9·3 \+ 3·5 = 42 numbers after the observations – got 0, then the end \(.*line 12\)"),
        (53, r"got 41, then the end \(.*line 53\)"),
    ],
)
def test_cut_files_are_refused(tmp_path: Path, kept: int, message: str) -> None:
    lines = text_of(tmp_path)
    (tmp_path / "problem.txt").write_text("\n".join(lines[:kept]))
    with pytest.raises(InputError, match=message):
        read_bal(tmp_path / "problem.txt")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": np.zeros((3, 8))}, r"cameras of shape \(3, 9\) – got \(3, 8\)"),
        ({"camera_of": np.zeros(4, int)}, r"camera_of of shape \(11,\) – got \(4,\)"),
        ({"point_of": np.full(11, 5)}, r"point indices from 0 to 4 – got 5 \(bundle adjustment problem, observation 0\)"),
        ({"points": np.full((5, 3), np.nan)}, r"finite points – got \[nan, nan, nan\]"),
    ],
)
def test_bad_arrays_are_refused(change: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(random_problem(0), **change)


@pytest.mark.parametrize(
    ("name", "shape", "cost"),
    [
        ("dubrovnik-16-22106-pre.txt.bz2", (16, 22106, 83718), 4.185660e6),
        ("ladybug-49-7776-pre.txt.bz2", (49, 7776, 31843), 8.509125e5),
        ("trafalgar-21-11315-pre.txt.bz2", (21, 11315, 36455), 4.413239e6),
    ],
)
def test_published_problems_have_the_published_cost(shared_data: Path, name: str, shape: tuple[int, ...], cost: float) -> None:
    problem = read_bal(shared_data / "bal" / name)
    assert (len(problem.cameras), len(problem.points), len(problem.pixels)) == shape
    camera = problem.cameras[problem.camera_of]
    P = Rotation.from_rotvec(camera[:, :3]).apply(problem.points[problem.point_of]) + camera[:, 3:6]
    p = -P[:, :2] / P[:, 2:]
    r2 = (p**2).sum(axis=1)
    predicted = (camera[:, 6] * (1.0 + camera[:, 7] * r2 + camera[:, 8] * r2**2))[:, None] * p
    assert 0.5 * ((problem.pixels - predicted) ** 2).sum() == pytest.approx(cost, rel=1e-6)


def test_gbp_problem_has_the_published_cost(shared_data: Path) -> None:
    problem = read_gbp(shared_data / "bal" / "gbp_fr1desk.txt")
    assert (len(problem.T_camera_world), len(problem.points), len(problem.pixels)) == (63, 2869, 13298)
    pose = problem.T_camera_world[problem.camera_of]
    P = Rotation.from_quat(pose[:, [1, 2, 3, 0]]).apply(problem.points[problem.point_of]) + pose[:, 4:]
    predicted = problem.intrinsics[:2] * P[:, :2] / P[:, 2:] + problem.intrinsics[2:]
    assert 0.5 * ((problem.pixels - predicted) ** 2).sum() == pytest.approx(3.858e8, rel=1e-3)


def test_gbp_needs_its_intrinsics(tmp_path: Path) -> None:
    path = tmp_path / "problem.txt"
    path.write_text("# a comment\n1 1 1\n500 500 320\n")
    with pytest.raises(InputError, match=r"the intrinsics fx fy cx cy – got '500 500 320' \(.*line 3\)"):
        read_gbp(path)


@pytest.mark.parametrize("share", [0.001, 0.5, 0.99])
def test_a_cut_bzip2_file_is_explained(tmp_path: Path, share: float) -> None:
    """Also where the format is to be found from the content; a command said 'Aborted!'."""
    whole = tmp_path / "whole.txt.bz2"
    write_bal(whole, random_problem(1, cameras=30, points=500, observations=3000))
    cut = tmp_path / "cut.txt.bz2"
    cut.write_bytes(whole.read_bytes()[: max(int(share * whole.stat().st_size), 10)])
    for read in (read_bal, read_reconstruction):
        with pytest.raises(InputError, match=r"expected a whole bzip2 file – got the end inside of the data .*cut.txt.bz2"):
            read(cut)


@pytest.mark.slow
@pytest.mark.parametrize("line", [b"0 " * 500_000, b"0 0 1.0 2.0\n" * 100_000])
def test_a_bzip2_file_that_would_fill_the_memory_is_refused(tmp_path: Path, line: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """20 MB from some kilobytes, where 6 are allowed: as one line, and as lines that are all in order."""
    monkeypatch.setattr("boxplus.formats.numbers.lines.INFLATED", 6 << 20)
    bomb = tmp_path / "bomb.txt.bz2"
    compressor = bz2.BZ2Compressor()
    with bomb.open("wb") as file:
        file.write(compressor.compress(b"1 1 20000000\n"))
        for _ in range(20_000_000 // len(line)):
            file.write(compressor.compress(line))
        file.write(compressor.flush())
    assert bomb.stat().st_size < 40_000
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"at most \d+ MB of text in a bzip2 file of [\d.]+ kB|a line of more than"):
            read_reconstruction(bomb)
        assert tracemalloc.get_traced_memory()[1] < 5e8
    finally:
        tracemalloc.stop()
