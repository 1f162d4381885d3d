"""The results of an earlier run, which stay in its folder until the run that replaces them has come to its end."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from boxplus.formats.output import EARLIER_SUFFIX, TEMPORARY_SUFFIX

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class EarlierResults:
    """What an earlier run left in a folder that is locked, and where it is kept while a new one has the folder.

    Files are moved one by one, and the folder that they go to has its name when all are there: a process that is killed leaves
    them in one place or, where no new run had begun, in two that the next one puts together.

    Attributes:
        path: the output folder.
        files, folders: what a run writes, and the folders that go where they are empty, in this order.
        holds_results: whether the run that has the folder now left something worth keeping.
    """

    path: Path
    files: Callable[[], Iterable[Path]]
    folders: Callable[[], Iterable[Path]]
    holds_results: Callable[[], bool]

    @property
    def kept(self) -> Path:
        """Where they are, whole, while a new run goes on; not there else."""
        return self.path / f"results{EARLIER_SUFFIX}"

    @property
    def _moving(self) -> Path:
        return self.path / f"results{TEMPORARY_SUFFIX}"

    def set_aside(self) -> None:
        """Make room for a new run. Where results are kept already, those of the run after them go, which did not end."""
        if not self.kept.is_dir():
            for file in self._summary_last():
                there = self._moving / file.relative_to(self.path)
                there.parent.mkdir(parents=True, exist_ok=True)
                os.replace(file, there)
            os.rename(self._moving, self.kept)
        self.clear()

    def put_together(self) -> None:
        """Put back what a killed process was moving: no new run had begun, or nothing was left of it."""
        if self._moving.is_dir():
            for file in [path for path in self._moving.rglob("*") if not path.is_dir()]:
                there = self.path / file.relative_to(self._moving)
                there.parent.mkdir(parents=True, exist_ok=True)
                os.replace(file, there)
            shutil.rmtree(self._moving)

    def settle(self, *, is_finished: bool) -> None:
        """Where the new run came to its end, the earlier results go; where it left none, they are put back."""
        if is_finished:
            shutil.rmtree(self.kept)
        elif not self.holds_results():
            self.clear()
            os.rename(self.kept, self._moving)
            self.put_together()
            _log.warning("the earlier results in %s stay as they were", self.path)

    def clear(self) -> None:
        """Remove what a run wrote, with what it had begun to write."""
        for file in self._summary_last():
            for name in (file.name, file.name + TEMPORARY_SUFFIX):
                file.with_name(name).unlink(missing_ok=True)
        for inner in self.folders():
            with suppress(OSError):  # a folder with files of others stays
                inner.rmdir()

    def _summary_last(self) -> list[Path]:
        """Interrupted before, the folder is still known as a run's."""
        return sorted(set(self.files()), key=lambda file: file == self.path / "run.json")
