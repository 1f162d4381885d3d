"""Where tasks run: in this process, or on the workers of a Ray cluster. A task is a function of arguments that can be pickled."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol

from boxplus._extras import require
from boxplus.errors import InputError

_RETRIES = 3  # of a task whose worker or machine was lost
_IN_FLIGHT = 2000  # tasks that the cluster knows of at a time, however many there are


@dataclass(frozen=True, slots=True)
class TaskEnd:
    """How a task ended: its number, its value, or the sentence of what went wrong."""

    number: int
    value: Any = None
    error: str | None = None


class Executor(Protocol):
    """Runs tasks that do not depend on each other."""

    def run(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> Iterator[TaskEnd]:
        """Call the function with each of the arguments; ends come as they come, in any order."""


class InProcess:
    """One task after the other, here."""

    def run(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> Iterator[TaskEnd]:
        """See `Executor`."""
        for number, given in enumerate(arguments):
            try:
                yield TaskEnd(number, function(*given))
            except Exception as error:  # noqa: BLE001 - what a task raises ends that task alone, here as on a cluster
                yield TaskEnd(number, error=f"{type(error).__name__}: {error}")


class RayExecutor:
    """Tasks on a Ray cluster; one whose worker or machine is lost is run again, three times at most.

    Args:
        address: of a cluster that runs already; None starts one on this machine, for as long as the block lasts.
        workers: tasks at a time on this machine, where one is started; None: as many as it has cores.

    Raises:
        InputError: Ray, the extra `fleet`, is not installed; no cluster at the address, or none that would start.
    """

    def __init__(self, address: str | None = None, workers: int | None = None) -> None:
        self._ray = require("ray", "which runs tasks on many machines")
        self._address, self._workers = address, workers

    def __enter__(self) -> RayExecutor:
        try:
            quiet = {"log_to_driver": False, "logging_level": logging.ERROR, "ignore_reinit_error": True}
            if self._address is None:
                self._ray.init(num_cpus=self._workers, include_dashboard=False, **quiet)
            else:
                self._ray.init(address=self._address, **quiet)
        except Exception as error:
            if self._address is None:
                found, advice = "none that would start on this machine", "try again when it has less to do, or give --address"
            else:
                found, advice = f"none at {self._address}", "start it, or leave --address out"
            raise InputError("a Ray cluster", f"{found}: {error}", advice) from error
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._ray.shutdown()

    def run(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> Iterator[TaskEnd]:
        """See `Executor`."""
        remote = self._ray.remote(num_cpus=1, max_retries=_RETRIES)(function)
        rest, numbers = iter(enumerate(arguments)), dict[Any, int]()
        while True:
            for number, given in itertools.islice(rest, _IN_FLIGHT - len(numbers)):
                numbers[remote.remote(*given)] = number
            if not numbers:
                return
            (done,), _ = self._ray.wait(list(numbers), num_returns=1)
            number = numbers.pop(done)
            try:
                yield TaskEnd(number, self._ray.get(done))
            except self._ray.exceptions.RayTaskError as error:
                yield TaskEnd(number, error=f"{type(error.cause).__name__}: {error.cause}")
            except self._ray.exceptions.RayError as error:
                lost = str(error).splitlines()[0] if str(error) else type(error).__name__
                yield TaskEnd(number, error=f"lost {_RETRIES + 1} times: {lost}")
