"""Machine code out of the cache: it is linked to, counts references and raises as what was compiled a moment ago."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core import config as numba_config

pytestmark = pytest.mark.skipif(bool(numba_config.DISABLE_JIT), reason="nothing is compiled")

_PROGRAM = """
import sys
import numpy as np
from numba.core.runtime import nrtdynmod
from boxplus._jit import kernel, on_compilation

runtimes, create = [], nrtdynmod.create_nrt_module
nrtdynmod.create_nrt_module = lambda context: runtimes.append(1) or create(context)

@kernel(inline=True)
def half(x):
    return 0.5 * x

@kernel
def halves(x):
    if len(x) == 0:
        raise ValueError("nothing to halve")
    out = np.empty(len(x))
    for i in range(len(x)):
        out[i] = half(x[i])
    return out

@kernel
def total(x):
    return halves(x).sum() + halves(x[1:]).sum()

@kernel
def factorial(n):
    return 1 if n < 2 else n * factorial(n - 1)

compiled = []
with on_compilation(compiled.append):
    results = [halves(np.ones(4)).sum(), factorial(5)]
    if "total" in sys.argv:
        results.append(total(np.ones(4)))
        try:
            total(np.ones(1)[:0])
        except ValueError as error:
            results.append(str(error))
own = [name for name in compiled if name in ("half", "halves", "total", "factorial")]
print(*results, *sorted(own), len(runtimes))
"""


def _run(folder: Path, *arguments: str) -> str:
    (folder / "program.py").write_text(_PROGRAM)
    environment = {"BOXPLUS_CACHE_DIR": str(folder / "cache"), "PATH": "", "PYTHONPATH": os.environ.get("PYTHONPATH", "")}
    program = [sys.executable, str(folder / "program.py"), *arguments]
    done = subprocess.run(program, env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip() + done.stderr


@pytest.mark.slow
def test_what_is_loaded_can_be_linked_to(tmp_path: Path) -> None:
    assert _run(tmp_path) == "2.0 120 factorial half halves 1"
    assert _run(tmp_path) == "2.0 120 0"
    # Compiled in a process that loaded what it calls, and loaded in another one.
    assert _run(tmp_path, "total") == "2.0 120 3.5 nothing to halve total 0"
    assert _run(tmp_path, "total") == "2.0 120 3.5 nothing to halve 0"


def test_a_damaged_runtime_is_compiled_again(tmp_path: Path) -> None:
    _run(tmp_path)
    (file,) = (tmp_path / "cache").rglob("*.runtime")
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0x10
    file.write_bytes(content)
    assert "is damaged" in _run(tmp_path)
    assert _run(tmp_path) == "2.0 120 0"
