"""The loop search beside the odometry, in a process of its own: a scan does not wait for it.

Its result depends on the local maps and their order alone, not on when it comes to them: nothing of it goes back into the
odometry.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple, cast

import boxplus
from boxplus.errors import BoxplusError, InputError
from boxplus.runs.slam.graph_file import read_graph
from boxplus.runs.slam.loop_file import Pairs
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.outcome import SlamOutcome

_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")  # sums do not depend on the machine's cores, then
_ASKED_EVERY_S = 0.2


class Closure(NamedTuple):
    """Loops that were closed: pairs (query, place) of all that are believed now, and where the local maps are (n, 3) [m]."""

    loops: list[list[int]]
    p_map: list[list[float]]


class LoopSearch:
    """Begins the process where it is entered, and ends it, whatever it does, where it is left.

    Args:
        config: settings of `Slam`; forbidden, forced: as for it.
        maps: folder of the local maps; graph: file to write.

    Attributes:
        seconds: that the search took so far; done: local maps it has come to; given: of how many.
    """

    def __init__(self, config: SlamConfig, forbidden: Pairs, forced: Pairs, maps: Path, graph: Path) -> None:
        pairs = {"forbidden": forbidden, "forced": forced}
        self._job = {"config": config.model_dump(mode="json"), **pairs, "maps": str(maps), "graph": str(graph)}
        self._graph = graph
        self._answers: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self.seconds, self.done, self.given = 0.0, 0, 0

    def __enter__(self) -> LoopSearch:
        self._errors = tempfile.TemporaryFile()
        # The package as it is imported here, from wherever it was found.
        root = str(Path(boxplus.__file__).resolve().parents[1])
        path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        self._process = subprocess.Popen(
            [sys.executable, "-m", "boxplus.runs.slam.loop_worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env={**os.environ, **dict.fromkeys(_ONE_THREAD, "1"), "PYTHONPATH": path},
            text=True,
            encoding="utf-8",
        )
        self._input, self._output = cast(IO[str], self._process.stdin), cast(IO[str], self._process.stdout)
        self._reader = threading.Thread(target=self._read, args=(self._output,), daemon=True)
        self._reader.start()
        self._say(self._job)
        return self

    def give(self, number: int) -> None:
        """The next local map is on disk.

        Raises:
            BoxplusError: the search has failed.
        """
        self._say(number)
        self.given += 1

    def poll(self) -> Closure | None:
        """The newest closure since the last call; None without one. Does not wait.

        Raises:
            BoxplusError: the search has failed, with its reason.
        """
        closure = None
        with suppress(queue.Empty):
            while True:
                closure = self._take(self._answers.get_nowait()) or closure
        return closure

    def finish(self, waiting: Callable[[], None]) -> SlamOutcome:
        """Wait for the last local map, calling `waiting` meanwhile.

        Raises:
            BoxplusError: the search has failed, with its reason.
        """
        self._say(None)
        is_at_end = False
        while not is_at_end:
            waiting()
            with suppress(queue.Empty):
                answer = self._answers.get(timeout=_ASKED_EVERY_S)
                self._take(answer)
                is_at_end = answer is not None and "end" in answer
        return read_graph(self._graph)

    def _say(self, content: object) -> None:
        try:
            self._input.write(json.dumps(content) + "\n")
            self._input.flush()
        except OSError:  # it is gone, and its last answer says why
            self._reader.join()
            self.poll()

    def _read(self, answers: IO[str]) -> None:
        for line in answers:
            self._answers.put(json.loads(line))
        self._answers.put(None)

    def _take(self, answer: dict[str, Any] | None) -> Closure | None:
        if answer is None:
            raise self._ended_by_itself()
        if "error" in answer:
            raise _error(**answer["error"])
        if "map" in answer:
            self.done += 1
            self.seconds += answer["seconds"]
        return Closure(answer["loops"], answer["p_map"]) if "loops" in answer else None

    def _ended_by_itself(self) -> BoxplusError:
        code = self._process.wait()
        self._errors.seek(0)
        said = self._errors.read().decode(errors="replace").strip().splitlines()
        how = f"with code {code}" if code >= 0 else f"by signal {-code}"
        return BoxplusError(
            f"expected the loop search beside the odometry to go on – got its process ended {how}"
            f"{f' ({said[-1]})' if said else ''} – look whether memory was short, then go on with --resume"
        )

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        """No process stays behind."""
        if kind is not None:
            self._process.kill()
        with suppress(OSError):
            self._input.close()
        self._process.wait()
        self._reader.join()
        self._output.close()
        self._errors.close()


def _error(kind: str, parts: list[str]) -> Exception:
    """The error that a worker describes."""
    if kind == "input":
        return InputError(parts[0], parts[1], parts[2])
    if kind == "boxplus":
        return BoxplusError(parts[0])
    return RuntimeError(f"the loop search beside the odometry failed:\n{parts[0]}")
