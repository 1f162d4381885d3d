"""Files of numbers in columns read as a whole, against the same read line by line."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.formats import trajectory as trajectories
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.formats.trajectory_rows import seconds_to_ns
from boxplus.formats.trajectory_table import read_table

numbers = st.one_of(
    st.floats(-1e4, 1e4, allow_nan=False).map(repr),
    st.floats(-1e4, 1e4, allow_nan=False).map("{:.9e}".format),
    st.decimals(-1000, 1000, allow_nan=False, places=25).map(str),
    st.integers(-50, 50).map(str),
)
stamps = st.one_of(
    st.integers(0, 4_000_000_000).map(str),
    st.decimals(0, 4_000_000_000, places=6).map(str),
    st.decimals(0, 4_000_000_000, places=9).map(str),
    st.decimals(-1000, 4_000_000_000, places=12).map(str),
    st.floats(0, 4e9).map("{:.18e}".format),
)


def by_lines(path: Path, format: str = "auto") -> Trajectory:
    """The same file, read line by line."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trajectories, "read_table", lambda *_: None)
        return read_trajectory(path, format)


@given(
    rows=st.lists(st.tuples(stamps, st.lists(numbers, min_size=3, max_size=3)), min_size=1, max_size=12),
    gap=st.sampled_from([" ", "\t", "   "]),
    end=st.sampled_from(["\n", "\r\n", " \n", "\n\n", "\n# a comment\n"]),
)
@settings(max_examples=80, deadline=None)
def test_both_ways_of_reading_give_the_same_bits(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[str, list[str]]], gap: str, end: str
) -> None:
    rows = sorted(rows, key=lambda row: seconds_to_ns(row[0]))
    lines = [gap.join([stamp, *p, "0.1", "-0.7", ".1", "0.7e0"]) for stamp, p in rows]
    path = tmp_path_factory.getbasetemp() / "table.tum"
    path.write_bytes("".join(line + end for line in lines).encode())
    table = read_table(path, "auto")
    assert table is not None and table.layout == "tum"
    assert table.time_ns.tolist() == [seconds_to_ns(stamp) for stamp, _ in rows]
    found, expected = read_trajectory(path), by_lines(path)
    for name in ("time_ns", "p", "q_wxyz"):
        assert getattr(found, name).tobytes() == getattr(expected, name).tobytes(), name
    assert found.warnings == expected.warnings


def test_matrices_are_kept_as_they_stand(tmp_path: Path, shared_data: Path) -> None:
    path = tmp_path / "some.txt"
    lines = (shared_data / "trajectories" / "KITTI_00_gt.txt").read_text().splitlines(keepends=True)[:300]
    path.write_text("# poses\n" + "".join(lines))
    table = read_table(path, "kitti")
    assert table is not None and table.time_ns is None
    assert table.lines.tolist() == list(range(2, 302))
    found, expected = read_trajectory(path), by_lines(path)
    for name in ("p", "q_wxyz", "matrices"):
        assert getattr(found, name).tobytes() == getattr(expected, name).tobytes(), name


@pytest.mark.parametrize(
    ("text", "format"),
    [
        ("1 2 3 4 0 0 0 1", "auto"),  # no newline at the end: perhaps cut
        ("1 2 3 4 0 0 0 1\n2 2 3 4 0 0 0\n", "auto"),
        ("1 2 3 4 0 0 0 x\n", "auto"),
        ("1e30 2 3 4 0 0 0 1\n", "auto"),
        ("nan 2 3 4 0 0 0 1\n", "auto"),
        ("1 2 3 4 0 0 0 1\n", "kitti"),
        ("1 2 3 4 0 0 0 1\n", "csv"),
        ("1 2 3\n", "auto"),
        ("1,2,3,4,1,0,0,0\n", "auto"),
        ("# nothing\n", "auto"),
        ("\n\0\0\n", "auto"),
        ("BZh91AY\n", "auto"),
        ("", "auto"),
    ],
)
def test_what_is_not_a_whole_table_is_left_to_the_lines(tmp_path: Path, text: str, format: str) -> None:
    (tmp_path / "file").write_text(text)
    assert read_table(tmp_path / "file", format) is None
    assert read_table(tmp_path, format) is None


def test_errors_name_the_line_of_a_table(tmp_path: Path) -> None:
    rows = [f"{i}.5 {i} 0 0 0 0 0 1" for i in range(5)]
    (tmp_path / "a.tum").write_text("\n".join(["# header", "", *rows[:3], rows[1]]) + "\n")
    assert read_table(tmp_path / "a.tum", "auto") is not None
    with pytest.raises(InputError, match=r"a step of -1\.0{9} s \(.*a\.tum, line 6; 1 such steps\)"):
        read_trajectory(tmp_path / "a.tum")


def test_stamps_at_the_ends_of_the_range(tmp_path: Path) -> None:
    words = ["-9223372036.854775807", "-0.5", "0", "9223372035.999999999", "9223372036.854775807"]
    (tmp_path / "a.tum").write_text("".join(f"{word} 0 0 0 0 0 0 1\n" for word in words))
    assert read_trajectory(tmp_path / "a.tum").times.tolist() == [seconds_to_ns(word) for word in words]
    for beyond in ("9223372036.854775808", "9999999999.5"):
        (tmp_path / "a.tum").write_text(f"{beyond} 0 0 0 0 0 0 1\n")
        with pytest.raises(InputError, match="is not a time in seconds"):
            read_trajectory(tmp_path / "a.tum")
