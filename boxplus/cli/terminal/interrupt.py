"""Ctrl-C (or SIGTERM) while a command runs: the first asks to come to an end, the second stops at once.

What may be left out without harm is left at once.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_on_interrupt(announce: Callable[[], None]) -> Iterator[Callable[[], bool]]:
    """Yields a question: was it asked to stop? The first Ctrl-C (or SIGTERM) only asks, the second stops at once."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield stop.is_set
        return

    def ask(number: int, frame: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()
        announce()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def left_at_once() -> Iterator[None]:
    """Ctrl-C (or SIGTERM) ends this block by KeyboardInterrupt, and asks those around it to come to an end as well."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    around = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def leave(number: int, frame: FrameType | None) -> None:
        asked = around[signal.Signals(number)]
        if callable(asked):
            asked(number, frame)
        raise KeyboardInterrupt

    for number in around:
        signal.signal(number, leave)
    try:
        yield
    finally:
        for number, handler in around.items():
            signal.signal(number, handler)
