"""The folder that a command writes its results into: nothing is ever replaced that nobody asked to replace."""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from boxplus.errors import InputError
from boxplus.formats.output import make_folder, output_error

SUMMARY = "run.json"


def prepare_output_folder(
    folder: str | Path, program: str, files: Iterable[Path], folders: Iterable[Path] = (), *, overwrite: bool = False
) -> Path:
    """A folder to write results into: new, empty, or (with `overwrite`) cleared of an earlier run's own files.

    Nothing that a run did not write is ever removed.

    Args:
        program: who writes here, as `run.json` says; the results of another program are not replaced.
        files, folders: what a run writes, `run.json` included; folders are removed where they are empty, in this order.

    Raises:
        InputError: the folder holds something else, or an earlier run and `overwrite` is not set.
        OutputError: it cannot be created or cleared.
    """
    path = make_folder(folder)
    summary = path / SUMMARY
    try:
        if next(path.iterdir(), None) is None:
            return path
        if not summary.is_file():
            raise InputError(
                "a new or empty output folder, or one with an earlier run of boxplus",
                f"other files in {path}",
                "choose another folder with --output",
            )
        if not overwrite:
            raise InputError(
                "a new or empty output folder",
                f"the results of an earlier run in {path}",
                "choose another folder with --output, or add --overwrite to replace them",
            )
        found = _program(summary)
        if found not in (program, None):
            raise InputError(
                f"an earlier run of '{program}' to replace", f"one of {found!r} in {path}", "choose another folder with --output"
            )
        # The summary goes last: interrupted here, the folder is still known as a run's.
        for file in sorted(files, key=lambda file: file == summary):
            file.unlink(missing_ok=True)
        for inner in folders:
            with suppress(OSError):  # a folder with files of others stays
                inner.rmdir()
    except OSError as error:
        raise output_error(path, error) from error
    return path


def _program(summary: Path) -> str | None:
    """Who wrote a summary; None where it cannot be read."""
    try:
        found = json.loads(summary.read_bytes())
    except ValueError:
        return None
    return str(found.get("program")) if isinstance(found, dict) and "program" in found else None
