"""Where the results of a fleet lie: a folder that all workers share, or an object store by its URL (fsspec).

A store is opened anew by every task, from its text. In a shared folder a run is written where it stays, so that one that was
killed goes on from its checkpoint. To an object store a run is brought when it has come to its end, `run.json` last: what is
there with it is whole.
"""

from __future__ import annotations

import shutil
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from boxplus._extras import require
from boxplus.errors import InputError, OutputError
from boxplus.formats.output import atomic_file, make_folder, output_error
from boxplus.runs.sessions.folder import claim_merge_folder
from boxplus.runs.storage.folder_lock import locked_folder, put_back_left
from boxplus.runs.storage.output_folder import SUMMARY

MERGED = "merged"
_PROGRAM = "boxplus fleet run"
_HERE = ("file://", "local://")


class Store(ABC):
    """Files by name, a path with slashes below the place that `text` says; a task that is given the text opens it again."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __truediv__(self, name: str) -> str:
        """Where something is, for messages."""
        return f"{self.text.rstrip('/')}/{name}"

    @abstractmethod
    def read(self, name: str) -> bytes | None:
        """What is in a file; None where there is none."""

    @abstractmethod
    def write(self, name: str, data: bytes) -> None:
        """Replace a file in one step.

        Raises:
            OutputError: it cannot be written.
        """

    @abstractmethod
    def writing(self, name: str) -> AbstractContextManager[Path]:
        """A folder on this machine to write the results `name` into; they are in the store when the block ends well."""

    @abstractmethod
    def reading(self, name: str, parts: Sequence[str] = ()) -> AbstractContextManager[Path]:
        """A folder on this machine with the results `name`; of these `parts` are needed, files and folders, or all."""

    @abstractmethod
    def remove(self, name: str) -> None:
        """Remove a folder and all in it, if it is there."""

    @abstractmethod
    def locked(self) -> AbstractContextManager[None]:
        """Nobody else runs a fleet there while the block runs."""

    @abstractmethod
    def joint_map(self) -> AbstractContextManager[str]:
        """A name to write the joint map under, which takes the place of an earlier one when the block ends well."""


class SharedFolder(Store):
    """A folder that every worker has under the same path."""

    def __init__(self, text: str) -> None:
        path = Path(text).resolve()
        super().__init__(str(path))
        self.path = path

    def read(self, name: str) -> bytes | None:
        """See `Store`."""
        try:
            return (self.path / name).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None

    def write(self, name: str, data: bytes) -> None:
        """See `Store`."""
        make_folder((self.path / name).parent)
        with atomic_file(self.path / name) as file:
            file.write(data)

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """See `Store`; what is there already stays."""
        yield make_folder(self.path / name)

    @contextmanager
    def reading(self, name: str, parts: Sequence[str] = ()) -> Iterator[Path]:
        """See `Store`."""
        del parts
        yield self.path / name

    def remove(self, name: str) -> None:
        """See `Store`."""
        shutil.rmtree(self.path / name, ignore_errors=True)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """See `Store`."""
        make_folder(self.path)
        with locked_folder(self.path, _PROGRAM):
            put_back_left(self.path / MERGED, _PROGRAM)
            yield

    @contextmanager
    def joint_map(self) -> Iterator[str]:
        """See `Store`; the earlier map stays whole until then."""
        with claim_merge_folder(self.path / MERGED, overwrite=True) as claimed, claimed.replaced() as made:
            yield made.path.name


class ObjectStore(Store):
    """A place that fsspec has a driver for: `s3://bucket/fleet`, `gs://…`, `memory://…`.

    Raises:
        InputError: fsspec, the extra `fleet`, is not installed; no driver for such a URL.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        fsspec = require("fsspec", "which speaks to object stores")
        try:
            self._files, path = fsspec.core.url_to_fs(text)
        except (ImportError, ValueError) as error:
            raise InputError(
                "a URL that fsspec has a driver for",
                f"{text}: {error}",
                "install its driver (s3fs, gcsfs, adlfs, …) on every worker",
            ) from error
        self._base = path.rstrip("/")

    def read(self, name: str) -> bytes | None:
        """See `Store`.

        Raises:
            InputError: the store does not answer.
        """
        try:
            return bytes(self._files.cat_file(self._at(name)))
        except (FileNotFoundError, IsADirectoryError):
            return None
        except OSError as error:
            raise InputError(f"to read {self / name}", f"{error}", "check the URL and the rights to it") from error

    def write(self, name: str, data: bytes) -> None:
        """See `Store`."""
        with self._writes(name):
            self._files.makedirs(self._at(name).rpartition("/")[0], exist_ok=True)
            self._files.pipe_file(self._at(name), data)

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """See `Store`; what is there already is replaced as a whole."""
        with tempfile.TemporaryDirectory(prefix="boxplus-fleet-") as scratch:
            yield Path(scratch)
            files = {path.relative_to(scratch).as_posix(): path for path in sorted(Path(scratch).rglob("*")) if path.is_file()}
            with self._writes(name):
                # Without run.json nothing there counts: it goes first and comes last.
                there = self._names(name)
                for inner in sorted(there, key=lambda inner: inner != SUMMARY):
                    if inner == SUMMARY or inner not in files:
                        self._files.rm_file(self._at(f"{name}/{inner}"))
                for inner in sorted(files, key=lambda inner: inner == SUMMARY):
                    self._files.makedirs(self._at(f"{name}/{inner}").rpartition("/")[0], exist_ok=True)
                    self._files.put_file(str(files[inner]), self._at(f"{name}/{inner}"))

    @contextmanager
    def reading(self, name: str, parts: Sequence[str] = ()) -> Iterator[Path]:
        """See `Store`.

        Raises:
            InputError: the store does not answer.
        """
        with tempfile.TemporaryDirectory(prefix="boxplus-fleet-") as scratch:
            try:
                for inner in self._names(name):
                    if not parts or any(inner == part or inner.startswith(f"{part}/") for part in parts):
                        target = Path(scratch) / inner
                        make_folder(target.parent)
                        self._files.get_file(self._at(f"{name}/{inner}"), str(target))
            except OSError as error:
                raise InputError(f"to read {self / name}", f"{error}", "check the URL and the rights to it") from error
            yield Path(scratch)

    def remove(self, name: str) -> None:
        """See `Store`."""
        with self._writes(name):
            if self._files.exists(self._at(name)):
                self._files.rm(self._at(name), recursive=True)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """See `Store`; an object store has no locks, so that nothing is promised."""
        yield

    @contextmanager
    def joint_map(self) -> Iterator[str]:
        """See `Store`; the earlier map goes first, its `run.json` before the rest of it."""
        with self._writes(MERGED):
            if self._files.exists(self._at(f"{MERGED}/{SUMMARY}")):
                self._files.rm_file(self._at(f"{MERGED}/{SUMMARY}"))
        self.remove(MERGED)
        yield MERGED

    def _at(self, name: str) -> str:
        return f"{self._base}/{name}"

    def _names(self, folder: str) -> list[str]:
        """Files below a folder, by their paths inside it."""
        self._files.invalidate_cache()
        base = self._at(folder).lstrip("/") + "/"
        found = self._files.find(self._at(folder))
        return sorted(str(path).lstrip("/").removeprefix(base) for path in found)

    @contextmanager
    def _writes(self, name: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if isinstance(error, OutputError):
                raise
            raise output_error(self / name, error) from error


def open_store(text: str | Path) -> Store:
    """The place that a path or a URL says; `file://` is a path.

    Raises:
        InputError: no driver for the URL.

    Example:
        >>> open_store("memory://fleet").write("note.txt", b"here")
        >>> open_store("memory://fleet").read("note.txt")
        b'here'
    """
    given = str(text)
    for begin in _HERE:
        if given.startswith(begin):
            return SharedFolder(given.removeprefix(begin))
    return ObjectStore(given) if "://" in given else SharedFolder(given)
