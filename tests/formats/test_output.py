"""A folder is replaced as a whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from boxplus.errors import OutputError
from boxplus.formats.output import advice_to_put_back, earlier_folder, replaced_folder


def content(folder: Path) -> dict[str, str]:
    return {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with replaced_folder(tmp_path / "map") as made:
        (made / "tiles").mkdir()
        (made / "tiles" / "one").write_text("old")
    return tmp_path / "map"


def test_the_new_folder_takes_the_place_of_the_old_one(folder: Path) -> None:
    with replaced_folder(folder) as made:
        (made / "two").write_text("new")
        assert content(folder) == {"tiles/one": "old"}
    assert content(folder) == {"two": "new"} and os.listdir(folder.parent) == ["map"]


def test_the_old_folder_stays_whole_where_the_disk_is_full(folder: Path) -> None:
    with pytest.raises(OutputError, match="got a full disk"), replaced_folder(folder) as made:
        (made / "two").write_text("ne")
        raise OSError(28, "No space left on device")
    assert content(folder) == {"tiles/one": "old"} and os.listdir(folder.parent) == ["map"]


def test_the_root_has_nothing_beside_it() -> None:
    assert advice_to_put_back(Path("/"), Path("/nowhere"), Path("nowhere")) == ""
    with pytest.raises(OutputError, match="expected a folder with something beside it – got / – choose one in it"):
        earlier_folder("/")


@pytest.mark.skipif(os.name == "nt", reason="modes are of POSIX")
def test_the_new_folder_is_readable_to_the_same(folder: Path) -> None:
    """A folder that nobody else might read was open to all after it had been replaced, and a shared one shut."""
    folder.chmod(0o2750)
    with replaced_folder(folder) as made:
        assert made.stat().st_mode & 0o7777 == 0o2750
    assert folder.stat().st_mode & 0o7777 == 0o2750


def test_a_folder_that_cannot_take_its_place_leaves_the_old_one_there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rename = os.rename

    def fails(source: Path, target: Path) -> None:
        if source.name.endswith("-tmp"):
            raise PermissionError(13, "somebody has a file of it open")
        rename(source, target)

    with monkeypatch.context() as patched, pytest.raises(OutputError, match="no permission"), replaced_folder(folder) as made:
        (made / "two").write_text("new")
        patched.setattr(os, "rename", fails)
    assert content(folder) == {"tiles/one": "old"}


class Killed(BaseException):
    pass


@pytest.mark.parametrize("renames", [0, 1])
def test_killed_between_the_renames_one_of_both_is_whole(folder: Path, renames: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rename, left = os.rename, iter(range(renames))

    def dies(source: Path, target: Path) -> None:
        if next(left, None) is None:
            raise Killed
        rename(source, target)

    with monkeypatch.context() as patched, pytest.raises(Killed), replaced_folder(folder) as made:
        (made / "two").write_text("new")
        patched.setattr(os, "rename", dies)
    whole = [content(path) for path in folder.parent.iterdir()]
    assert {"tiles/one": "old"} in whole
    with pytest.raises(ValueError, match="again"), replaced_folder(folder):
        assert content(folder) == {"tiles/one": "old"}
        raise ValueError("again")
    assert content(folder) == {"tiles/one": "old"} and os.listdir(folder.parent) == ["map"]


def test_a_folder_that_cannot_be_renamed_is_refused_before_anything_is_computed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os.path, "ismount", lambda path: path == folder)
    with pytest.raises(OutputError, match="which a file system is mounted at – choose a folder in it"), replaced_folder(folder):
        raise AssertionError("it was begun")
    assert content(folder) == {"tiles/one": "old"} and os.listdir(folder.parent) == ["map"]
