"""The process that looks for loops beside the odometry: `python -m boxplus.runs.slam.loop_worker`, begun by `LoopSearch`.

It reads lines of JSON from its standard input, first the settings, then numbers of local maps that are on disk, then `null` for
the end; for every map it answers with a line, and at the end it writes the graph. Where its input ends before, whoever began it
is gone: it ends at once.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import IO, Any

_NICENESS = 10  # the odometry comes first

_Line = Any


def main() -> None:
    """Answer until the end of the input."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in a terminal reaches both; the odometry decides
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print must not be taken for an answer
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
    lines: queue.SimpleQueue[_Line] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(sys.stdin, lines), daemon=True).start()
    code = 0
    try:
        _work(lines, answers)
    except Exception as error:  # noqa: BLE001 - whoever began this process raises it
        code = 1
        _answer(answers, {"error": _described(error)})
    os._exit(code)  # without waiting for the thread that reads


def _read(source: IO[str], lines: queue.SimpleQueue[_Line]) -> None:
    for line in source:
        lines.put(json.loads(line))
    os._exit(3)


def _work(lines: queue.SimpleQueue[_Line], answers: IO[str]) -> None:
    from boxplus.maps.local_maps.folder import LocalMapFolder
    from boxplus.runs.slam.graph_file import write_graph
    from boxplus.systems.slam.config import SlamConfig
    from boxplus.systems.slam.slam import Slam

    job = lines.get()
    maps = LocalMapFolder(job["maps"])
    pairs = {name: [(query, place) for query, place in job[name]] for name in ("forbidden", "forced")}
    slam = Slam(SlamConfig.model_validate(job["config"]), **pairs, stored=maps.__getitem__)
    while (number := lines.get()) is not None:
        began = time.perf_counter()
        looked_at = slam.add(maps[number])
        seconds = time.perf_counter() - began
        answer: dict[str, Any] = {"map": number, "seconds": seconds}
        if any(loop.is_accepted for loop in looked_at):
            answer["loops"] = [[loop.query, loop.place] for loop in slam.loops if loop.is_accepted]
            answer["p_map"] = [[round(value, 3) for value in T[4:].tolist()] for T in slam.T_map]
        _answer(answers, answer)
    write_graph(Path(job["graph"]), slam.outcome())
    _answer(answers, {"end": True})


def _described(error: Exception) -> dict[str, Any]:
    from boxplus.errors import BoxplusError, InputError

    if isinstance(error, InputError):
        return {"kind": "input", "parts": [error.expected, error.got, error.advice]}
    if isinstance(error, BoxplusError):
        return {"kind": "boxplus", "parts": [str(error)]}
    return {"kind": "other", "parts": ["".join(traceback.format_exception(error))]}


def _answer(answers: IO[str], content: dict[str, Any]) -> None:
    answers.write(json.dumps(content) + "\n")
    answers.flush()


if __name__ == "__main__":
    main()
