"""Writing files and folders so that they are either whole or not there, and saying in a sentence why a write failed."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from boxplus._arguments import as_path
from boxplus.errors import OutputError

TEMPORARY_SUFFIX = ".boxplus-tmp"
"""Ending of files and folders that are being written; such a one is never complete."""
EARLIER_SUFFIX = ".boxplus-earlier"
"""Ending of a folder that another one is about to replace; it is whole."""


def output_error(path: str | Path, error: OSError) -> OutputError:
    """The error to raise when writing `path` failed with `error`: what was expected, what came, what to do."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        got, advice = "a full disk", "free some space or choose another output folder; everything written before is intact"
    elif error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        got, advice = "no permission to write there", "choose another output folder or change its permissions"
    elif error.errno in (errno.ENOTDIR, errno.EISDIR, errno.EEXIST):
        got, advice = f"something else of that name in the way ({error.strerror})", "choose another output path"
    else:
        got, advice = str(error), "check the output folder"
    return OutputError(f"expected to write {path} – got {got} – {advice}")


def make_folder(folder: str | Path) -> Path:
    """Create `folder` (and its parents) where it does not exist.

    Raises:
        OutputError: it cannot be created.
    """
    path = as_path(folder, "a folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise output_error(path, error) from error
    return path


@contextmanager
def atomic_file(path: str | Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`; when the block ends well, flush it to the disk and rename it to `path`.

    When the block raises, the temporary file is removed and whatever was at `path` before stays as it was.

    Raises:
        OutputError: the file cannot be created, written or renamed (full disk, no permission).
    """
    target = as_path(path, "a file")
    temporary = target.with_name(target.name + TEMPORARY_SUFFIX)
    try:
        with temporary.open("w+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and not isinstance(error, OutputError):
            raise output_error(target, error) from error
        raise


def beside(path: str | Path, ending: str) -> Path:
    """The path with an ending after its name.

    Raises:
        OutputError: it has no name, as the root of a file system has none.
    """
    target = as_path(path, "a folder")
    if not target.name:
        raise OutputError(f"expected a folder with something beside it – got {target} – choose one in it")
    return target.with_name(target.name + ending)


def earlier_folder(path: str | Path) -> Path:
    """Where a folder is while another one takes its place, and stays when the process is killed just then.

    Raises:
        OutputError: nothing can take the place of the root of a file system.
    """
    return beside(path, EARLIER_SUFFIX)


def advice_to_put_back(*folders: Path) -> str:
    """What to do about the first of these folders that is missing where an earlier one was left beside it; empty: none is."""
    for folder in folders:
        if not folder.exists() and (earlier := earlier_folder(folder)).is_dir():
            return f"rename {earlier}, in which the one that was there is whole, to {folder.name}"
    return ""


def put_back(path: str | Path) -> None:
    """Put back the folder that a process left beside `path` which was killed between the two renames of `replaced_folder`.

    Raises:
        OutputError: it cannot be renamed.
    """
    target = as_path(path, "a folder")
    earlier = earlier_folder(target)
    try:
        if earlier.exists() and not target.exists():
            os.rename(earlier, target)
    except OSError as error:
        raise output_error(target, error) from error


@contextmanager
def replaced_folder(path: str | Path) -> Iterator[Path]:
    """Yield a folder beside `path` to write into; when the block ends well, it takes the place of the folder at `path`.

    When the block raises, what was at `path` before stays as it was. A process that is killed leaves the one or the other whole:
    between two renames the folder may be missing, and the next call puts the earlier one back first.

    Raises:
        OutputError: a folder cannot be created, removed or renamed.
    """
    target = as_path(path, "a file")
    made, earlier = beside(target, TEMPORARY_SUFFIX), earlier_folder(target)
    if os.path.ismount(target):  # it could not be renamed, and that would show at the end
        raise OutputError(
            f"expected a folder that another one can take the place of – got {target}, which a file system is mounted at – "
            "choose a folder in it"
        )
    put_back(target)
    try:
        for leftover in (made, earlier):
            if leftover.exists():
                shutil.rmtree(leftover)
        try:
            make_folder(made)
            if target.is_dir():
                shutil.copystat(target, made)  # who may read and write there
            yield made
        except BaseException:
            shutil.rmtree(made, ignore_errors=True)
            raise
        if target.exists():
            os.rename(target, earlier)
        try:
            os.rename(made, target)
        except OSError:
            put_back(target)
            raise
        if earlier.exists():
            shutil.rmtree(earlier)
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise output_error(target, error) from error
