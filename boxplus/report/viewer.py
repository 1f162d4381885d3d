"""Where a run is shown in 3D: a window of rerun (extra `view`), one that is open already, or a file that is opened later."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from boxplus._extras import require
from boxplus.errors import InputError

WINDOW = "window"
FILE_LIMIT = 1_000_000_000
"""A file of a view does not grow beyond so many bytes: points get sparser as it fills, so that the path still has room."""
_MEMORY = "2GB"  # of the viewer that is started: beyond it drops what is oldest
_LOOPBACK = "127.0.0.1"
_LOOPBACK_NAMES = (_LOOPBACK, "localhost", "::1")
_LONGEST_WAIT_S = 20.0
_SETTLED_S = 0.5  # after its port opened: a viewer that finds no screen ends within it
_LOOKED_AFTER = 20  # times something is shown, between looks at the file or the viewer
_FORMS = "'window', FILE.rrd, or the address of a viewer on this machine, rerun+http://127.0.0.1:9876/proxy"


def check_target(where: str) -> str:
    """What `--view` may name, told before anything is read.

    Raises:
        InputError: none of the forms, a viewer on another machine, or a file that exists.
    """
    if where == WINDOW:
        return where
    if "://" in where:
        address = urlsplit(where)
        if address.scheme != "rerun+http" or address.port is None:
            raise InputError(f"--view with {_FORMS}", f"{where!r}", "correct it")
        if address.hostname not in _LOOPBACK_NAMES:
            raise InputError(
                "a viewer on this machine: nothing of a run is sent over the network",
                f"the host {address.hostname!r}",
                "write a file with --view FILE.rrd, or forward a port of this machine (ssh -L) and give that",
            )
        return where
    if Path(where).suffix != ".rrd":
        raise InputError(f"--view with {_FORMS}", f"{where!r}", "write --view window behind the other words, for a window")
    if Path(where).exists():
        raise InputError("a new file for the view", f"{where}, which exists", "give another name, or remove it")
    return where


class Viewer:
    """Sends what is shown to where it was asked for, and never holds up the run.

    A viewer that is closed, and a file that is full, end the view and leave the run alone: `note` says so.

    Args:
        title: name of what is shown.
        where: `window`, the name of a file (.rrd), the address of a viewer on this machine, or None to prepare only.

    Raises:
        InputError: as `check_target`; rerun-sdk is not installed; no screen; a viewer that does not open or answer.
    """

    def __init__(self, title: str, where: str | None = WINDOW) -> None:
        if where is not None:
            check_target(where)
        rerun = require("rerun", "which shows a run in 3D")
        self.note: str | None = None
        """Why nothing more is shown; None while all is."""
        self._rerun = rerun
        self._process: subprocess.Popen[bytes] | None = None
        self._file: Path | None = None
        self._address: tuple[str, int] | None = None
        self._looks, self._share = 0, 1.0
        rerun.init("boxplus-" + re.sub(r"\W+", "-", title))  # all that its names may hold
        if where == WINDOW:
            self._process, port = _open_window()
            rerun.connect_grpc(f"rerun+http://{_LOOPBACK}:{port}/proxy")
        elif where is not None and "://" in where:
            address = urlsplit(where)
            self._address = (address.hostname or _LOOPBACK, address.port or 0)
            if not _answers(*self._address):
                raise InputError(
                    f"a viewer that listens at {where}",
                    "none",
                    f"start one with 'rerun --bind {_LOOPBACK} --port {address.port}'",
                )
            rerun.connect_grpc(where)
        elif where is not None:
            self._file = Path(where)
            try:
                self._file.touch()
                rerun.save(where)
            except (OSError, RuntimeError) as error:
                raise InputError("a file that the view can be written to", f"{where}: {error}", "choose another") from error

    def log(self, name: str, *parts: Any, static: bool = False) -> None:
        """Show something under a name; nothing once the view has ended."""
        if self.note is None:
            self._rerun.log(name, *parts, static=static)

    def thinned(self, most: int) -> int:
        """How many points may be shown at once: `most`, and fewer as the file fills."""
        return max(1, int(most * self._share**2))

    def look_after(self) -> bool:
        """Whether there still is something to show to; to be asked once for every instant that is shown."""
        self._looks += 1
        if self.note is None and self._looks % _LOOKED_AFTER == 0:
            if self._process is not None and self._process.poll() is not None:
                self._end("the window was closed; the run went on without it")
            elif self._address is not None and not _answers(*self._address):
                self._end("the viewer does not answer any more; the run went on without it")
            elif self._file is not None:
                self._share = 1.0 - self._file.stat().st_size / FILE_LIMIT
                if self._share <= 0.0:
                    self._end(f"{self._file} has reached {FILE_LIMIT / 1e9:g} GB and ends there")
        return self.note is None

    def close(self) -> None:
        """Complete the file, or hand the rest to the viewer, which stays open."""
        if self.note is None:
            self._rerun.disconnect()

    def _end(self, note: str) -> None:
        self.note = note
        self._rerun.disconnect()


def _answers(host: str, port: int) -> bool:
    with suppress(OSError), socket.create_connection((host, port), timeout=1.0):
        return True
    return False


def _open_window() -> tuple[subprocess.Popen[bytes], int]:
    """Start a viewer, which outlives this process: it and its port. Started by rerun itself it would listen to every network."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError(
            "a screen for the viewer's window",
            "none: neither DISPLAY nor WAYLAND_DISPLAY is set",
            "write a file with --view FILE.rrd, and open it where there is one: rerun FILE.rrd",
        )
    with socket.socket() as free:
        free.bind((_LOOPBACK, 0))
        port = int(free.getsockname()[1])
    viewer = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "rerun",
            f"--bind={_LOOPBACK}",
            f"--port={port}",
            f"--memory-limit={_MEMORY}",
            "--expect-data-soon",
        ],
        env={**os.environ, "RERUN_APP_ONLY": "true"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    until = time.monotonic() + _LONGEST_WAIT_S
    while viewer.poll() is None and time.monotonic() < until:
        if _answers(_LOOPBACK, port):
            with suppress(subprocess.TimeoutExpired):
                viewer.wait(_SETTLED_S)
            if viewer.poll() is None:
                return viewer, port
        time.sleep(0.05)
    got = "none in 20 s" if viewer.poll() is None else f"a process that ended with code {viewer.returncode}"
    viewer.terminate()
    raise InputError(
        "the viewer of rerun in a window", got, "write a file with --view FILE.rrd, or try 'python -m rerun' by itself"
    )
