"""Refusing what two threads do to one object at once, where its compiled code would read what the other is moving."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, TypeVar, cast

from boxplus.errors import InputError

_Method = TypeVar("_Method", bound=Callable[..., Any])


class ThreadGuard:
    """Who is in an object: any number of calls that read it, or one thread that changes it.

    Nobody waits: a call that would meet another one is refused, because the result would depend on chance. A thread never
    refuses itself, so that a callback may look at what calls it.

    Args:
        what: the class it guards, for the message.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._lock = threading.Lock()
        self._inside: list[tuple[int, str, bool]] = []  # thread, method, whether it changes the object

    def __reduce__(self) -> tuple[type[ThreadGuard], tuple[str]]:
        return ThreadGuard, (self._what,)  # nobody is in a copy

    def enter(self, method: str, *, changes: bool) -> tuple[int, str, bool]:
        """Let a call in, which `leave` has to be told about afterwards.

        Raises:
            InputError: another thread is inside, and one of the two changes the object.
        """
        call = (threading.get_ident(), method, changes)
        with self._lock:
            for thread, other, other_changes in self._inside:
                if thread != call[0] and (changes or other_changes):
                    raise InputError(
                        f"one thread at a time in a {self._what} that changes",
                        f"{method}() while another thread is in {other}()",
                        f"take a lock around both, or give each thread a {self._what} of its own",
                    )
            self._inside.append(call)
        return call

    def leave(self, call: tuple[int, str, bool]) -> None:
        """The call is over."""
        with self._lock:
            self._inside.remove(call)


def changes(method: _Method) -> _Method:
    """A method that nothing else may run beside; its object has the guard as `_guard`."""
    return _guarded(method, changes=True)


def reads(method: _Method) -> _Method:
    """A method that may run beside itself and others that only read."""
    return _guarded(method, changes=False)


def _guarded(method: _Method, *, changes: bool) -> _Method:
    @functools.wraps(method)
    def guarded(self: Any, /, *args: Any, **kwargs: Any) -> Any:
        guard: ThreadGuard = self._guard
        call = guard.enter(method.__name__, changes=changes)
        try:
            return method(self, *args, **kwargs)
        finally:
            guard.leave(call)

    return cast(_Method, guarded)
