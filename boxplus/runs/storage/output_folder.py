"""The folder that a command writes its results into: one run at a time, and nothing is replaced that nobody asked to replace."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from boxplus.errors import InputError
from boxplus.formats.output import TEMPORARY_SUFFIX, make_folder, output_error
from boxplus.runs.storage.folder_lock import LOCK, locked_folder

SUMMARY = "run.json"


def refuse_both(overwrite: bool, resume: bool) -> None:
    """An earlier run is either replaced or gone on with.

    Raises:
        InputError: both are asked for.
    """
    if overwrite and resume:
        raise InputError(
            "overwrite or resume", "both", "to go on with the earlier run leave overwrite out; to begin anew, leave resume out"
        )


def refuse_finished(folder: Path, program: str) -> None:
    """A run that is finished leaves nothing to go on with.

    Args:
        folder: of the run.
        program: who goes on, as `run.json` says; a run of another one is not looked at.

    Raises:
        InputError: it is finished.
    """
    summary = folder / SUMMARY
    if summary.is_file() and program_of(summary) == program and state_of(summary) == "finished":
        raise InputError(
            f"an unfinished run of '{program}' to go on with",
            f"one that is finished already, in {folder}",
            "nothing is left to do; to run it anew, give --overwrite in place of --resume",
        )


@contextmanager
def output_folder(
    folder: str | Path,
    program: str,
    files: Callable[[], Iterable[Path]],
    folders: Callable[[], Iterable[Path]],
    *,
    overwrite: bool = False,
    holds_results: Callable[[], bool] = lambda: True,
) -> Iterator[Path]:
    """A folder to write results into, locked while the block runs: new, empty, or cleared of an earlier run's own files.

    An earlier run is replaced with `overwrite`, or where it has left nothing worth keeping. What a run did not write is never
    removed.

    Args:
        program: who writes here, as `run.json` says; the results of another program are not replaced.
        files, folders: what a run writes, `run.json` included; folders are removed where they are empty, in this order.
        holds_results: whether there are results beside a `run.json`.

    Raises:
        InputError: another process is writing there; the folder holds something else, or an earlier run's results and
            `overwrite` is not set.
        OutputError: it cannot be created or cleared.
    """
    is_new = not Path(folder).exists()
    path = make_folder(folder)
    with _gone_where_empty(path, is_new), locked_folder(path, program) as lock:
        try:
            if _has_to_be_cleared(path, program, files, overwrite, lock.began_before, holds_results):
                # The summary goes last: interrupted here, the folder is still known as a run's.
                for file in sorted(files(), key=lambda file: file == path / SUMMARY):
                    for name in (file.name, file.name + TEMPORARY_SUFFIX):
                        file.with_name(name).unlink(missing_ok=True)
                for inner in folders():
                    with suppress(OSError):  # a folder with files of others stays
                        inner.rmdir()
        except OSError as error:
            raise output_error(path, error) from error
        try:
            yield path
        finally:
            left = [entry for entry in path.iterdir() if entry.name != LOCK] if path.is_dir() else []
            lock.keep_file = bool(left) and not (path / SUMMARY).exists()


@contextmanager
def _gone_where_empty(path: Path, is_new: bool) -> Iterator[None]:
    """A folder that was made for a run which then was refused does not stay."""
    try:
        yield
    finally:
        if is_new:
            with suppress(OSError):  # there is something in it
                path.rmdir()


def _has_to_be_cleared(
    path: Path,
    program: str,
    files: Callable[[], Iterable[Path]],
    overwrite: bool,
    began_before: bool,
    holds_results: Callable[[], bool],
) -> bool:
    """Whether there is something to remove, which may be removed; raises where it may not."""
    found = {file for file in path.rglob("*") if not file.is_dir() and file.name != LOCK}  # also that of a run within a run
    if not found and all(entry.name == LOCK for entry in path.iterdir()):
        return False
    if not (path / SUMMARY).is_file():
        own = set(files())
        if began_before and all(file in own or file.with_name(file.name.removesuffix(TEMPORARY_SUFFIX)) in own for file in found):
            return True
        raise InputError(
            "a new or empty output folder, or one with an earlier run of boxplus",
            f"other files in {path}",
            "choose another folder with --output",
        )
    earlier = program_of(path / SUMMARY)
    if not overwrite and (earlier != program or holds_results()):
        raise InputError(
            "a new or empty output folder",
            f"the results of an earlier run in {path}",
            "choose another folder with --output, or add --overwrite to replace them",
        )
    if earlier not in (program, None):
        raise InputError(
            f"an earlier run of '{program}' to replace", f"one of {earlier!r} in {path}", "choose another folder with --output"
        )
    return True


def doubts_of(summary: Path) -> tuple[list[str], list[str]]:
    """Why a run is not to be trusted, as its summary says: what nobody accepted, and what somebody did.

    None where nothing speaks against it, or the summary cannot be read.
    """
    found = _facts(summary)
    doubts, accepted = ([*map(str, own)] if isinstance(own := found.get(key), list) else [] for key in ("doubts", "accepted"))
    doubts += [str(found[key]) for key in ("doubt", "contradiction") if found.get(key)]
    return [text for text in doubts if text not in accepted], [text for text in doubts if text in accepted]


def program_of(summary: Path) -> str | None:
    """Who wrote a summary; None where it cannot be read."""
    found = _facts(summary)
    return str(found["program"]) if "program" in found else None


def state_of(summary: Path) -> str | None:
    """How a run ended, as its summary says; None where it cannot be read."""
    state = _facts(summary).get("state")
    return None if state is None else str(state)


def _facts(summary: Path) -> dict[str, Any]:
    """What a summary holds; nothing where it cannot be read."""
    try:
        found = json.loads(summary.read_bytes())
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
