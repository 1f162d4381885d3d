"""One run at a time in a folder: a lock of the operating system, which no process can leave behind."""

from __future__ import annotations

import errno
import json
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from boxplus.errors import InputError
from boxplus.formats.output import beside, earlier_folder, make_folder, output_error, put_back

LOCK = "run.lock"
BESIDE = ".boxplus-lock"
"""Ending of a lock that lies beside its folder."""
_log = logging.getLogger(__name__)
_LOCKED_BYTE = 1 << 20  # beyond the content, which stays readable on Windows


@dataclass(slots=True)
class FolderLock:
    """The lock while it is held.

    Attributes:
        began_before: whether an earlier run of the same program began in the folder and left its lock file.
        keep_file: whether to leave the lock file, as the sign that a run began there.
    """

    began_before: bool
    keep_file: bool


@contextmanager
def locked_folder(folder: Path, program: str) -> Iterator[FolderLock]:
    """Hold the lock of an existing `folder` for `program`.

    `run.lock` says which process holds it. The lock itself ends with the process, however that ends; the file is removed at the
    end of the block and stays when the process is killed.

    Raises:
        InputError: another process holds the lock; the message names it.
        OutputError: the folder cannot be written.
    """
    with _locked(folder / LOCK, folder, program) as lock:
        yield lock


@contextmanager
def locked_beside(folder: Path, program: str) -> Iterator[FolderLock]:
    """The same for a `folder` that another one takes the place of: the lock lies beside it, so that it stays where it is.

    Raises:
        InputError: another process holds the lock; the message names it.
        OutputError: the folder that holds both cannot be written.
    """
    path = beside(folder, BESIDE)
    make_folder(folder.parent)
    with _locked(path, folder, program) as lock:
        lock.keep_file = False  # what a killed process left beside the folder goes with the next one
        yield lock


def put_back_left(folder: Path, program: str) -> None:
    """Put back what a process left beside `folder` which was killed as it replaced it; nothing where there is none.

    Raises:
        InputError: another process holds the lock beside it, and may be replacing it just now.
        OutputError: it cannot be renamed.
    """
    if earlier_folder(folder).is_dir():
        with locked_beside(folder, program):
            put_back(folder)


@contextmanager
def _locked(path: Path, folder: Path, program: str) -> Iterator[FolderLock]:
    try:
        file = _lock(path, folder)
        began_before = _content(file).get("program") == program
        os.ftruncate(file, 0)
        os.lseek(file, 0, os.SEEK_SET)
        os.write(file, json.dumps({"program": program, "process": os.getpid()}).encode())
    except OSError as error:
        raise output_error(path, error) from error
    lock = FolderLock(began_before, keep_file=began_before)
    try:
        yield lock
    finally:
        # It goes while it is locked, so that nobody can lock a file that is about to go; Windows wants it closed first.
        if not lock.keep_file and os.name != "nt":
            with suppress(OSError):
                path.unlink()
        os.close(file)
        if not lock.keep_file and os.name == "nt":
            with suppress(OSError):
                path.unlink()


def _lock(path: Path, folder: Path) -> int:
    """A file descriptor that holds the lock of the file which is at `path`."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o644)
        try:
            if not _try_lock(file):
                raise InputError(
                    "an output folder that no other run is writing to",
                    f"process {_content(file).get('process', 'of an unknown number')} writing to {folder} at this moment",
                    "wait for it, stop it, or choose another folder with --output",
                )
            if os.name == "nt" or _is_at(file, path):
                return file
        except BaseException:
            os.close(file)
            raise
        os.close(file)  # the run that held it has just ended, and has taken its file away


def _is_at(file: int, path: Path) -> bool:
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(file), path.stat())
    return False


def _content(file: int) -> dict[str, object]:
    """What the lock file says; nothing where it is empty or something else."""
    os.lseek(file, 0, os.SEEK_SET)
    with suppress(ValueError):
        found = json.loads(os.read(file, 4096))
        return found if isinstance(found, dict) else {}
    return {}


if sys.platform == "win32":
    import msvcrt

    def _try_lock(file: int) -> bool:
        os.lseek(file, _LOCKED_BYTE, os.SEEK_SET)
        try:
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EDEADLOCK):
                return False
            raise
        return True

else:
    import fcntl

    def _try_lock(file: int) -> bool:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EACCES):
                return False
            if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
                raise
            _log.warning("this file system knows no locks: nothing keeps a second run out of the output folder")
        return True
