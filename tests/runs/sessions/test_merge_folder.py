"""The folder of a joint map: one process at a time, wherever it lies, and whole however the one before ended."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from boxplus.errors import InputError, OutputError
from boxplus.runs.sessions.folder import claim_joint_map, claim_merge_folder

SUMMARY = '{"program": "boxplus map merge"}'


@pytest.fixture
def street(tmp_path: Path) -> Path:
    """An earlier merge."""
    with claim_merge_folder(tmp_path / "street") as claimed, claimed.replaced() as made:
        made.summary.write_text(SUMMARY)
        made.encounters.write_text("old")
    return tmp_path / "street"


def go_on(folder: str | Path) -> None:
    with claim_merge_folder(folder, overwrite=True) as claimed, claimed.replaced() as made:
        made.summary.write_text(SUMMARY)
        made.encounters.write_text("new")


def test_nothing_is_left_beside_it(street: Path) -> None:
    go_on(street)
    assert (street / "encounters.csv").read_text() == "new" and os.listdir(street.parent) == ["street"]


def test_the_lock_that_a_killed_process_left_goes_with_the_next_one(street: Path) -> None:
    (street.parent / "street.boxplus-lock").write_text('{"program": "boxplus map merge", "process": 1}')
    go_on(street)
    assert os.listdir(street.parent) == ["street"]


def test_a_second_process_is_kept_out_from_the_first_look_on(street: Path) -> None:
    """Once it removed what the first one was writing, or took the place of its map: one of two updates was lost."""
    expected = f"expected an output folder that no other run is writing to – got process {os.getpid()} writing to {street}"
    with claim_merge_folder(street, overwrite=True) as claimed:
        with pytest.raises(InputError, match=expected):
            go_on(street)
        with claimed.replaced() as made:
            made.summary.write_text(SUMMARY)
            with pytest.raises(InputError, match=expected):
                go_on(street)
    go_on(street)


def test_what_is_there_is_not_replaced_unasked(street: Path) -> None:
    with pytest.raises(InputError, match="add --overwrite"), claim_merge_folder(street):
        pass
    (street / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="other files in"):
        go_on(street)
    assert (street / "encounters.csv").read_text() == "old"


def test_the_root_of_a_file_system_is_refused() -> None:
    with pytest.raises(OutputError, match="got / – choose one in it"):
        go_on("/")


def test_a_link_stays_a_link(street: Path) -> None:
    """Once it was taken for the map itself: an error after all the work, and a map in the place of the link."""
    link = street.with_name("link")
    link.symlink_to(street)
    go_on(link)
    assert link.is_symlink() and (street / "encounters.csv").read_text() == "new"
    assert sorted(os.listdir(street.parent)) == ["link", "street"]


def test_the_folder_one_is_in_has_no_name_of_its_own(street: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(street)
    go_on(".")
    assert (street / "encounters.csv").read_text() == "new" and os.listdir(street.parent) == ["street"]


def test_a_map_that_was_left_between_two_renames_is_put_back_before_anybody_looks(street: Path) -> None:
    street.rename(street.with_name("street.boxplus-earlier"))
    with claim_merge_folder(street, overwrite=True) as claimed:
        assert (claimed.path / "encounters.csv").read_text() == "old"


def test_an_update_of_what_is_no_map_makes_no_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="street"), claim_joint_map(tmp_path / "mistyped" / "street"):
        pass
    assert not os.listdir(tmp_path)


def test_an_update_replaces_no_file_that_is_not_of_the_map(street: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("boxplus.runs.sessions.folder.read_merge_summary", lambda _: None)  # this one is too short to be read
    (street / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"notes\.txt – move it away"), claim_joint_map(street):
        pass
    assert (street / "notes.txt").read_text() == "mine" and os.listdir(street.parent) == ["street"]
