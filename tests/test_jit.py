"""The door to Numba: cache keys that follow the sources, and chunks that do not depend on the threads."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba.core import config as numba_config

from boxplus import _jit


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A small package of kernels in place of boxplus: top imports middle, middle imports bottom; aside is imported by none."""
    root = tmp_path / "boxplus"
    (root / "low").mkdir(parents=True)
    (root / "__init__.py").write_text("")
    (root / "low" / "__init__.py").write_text("")
    (root / "low" / "bottom.py").write_text("X = 1\n")
    (root / "middle.py").write_text("from boxplus.low.bottom import (\n    X,\n)\n")
    (root / "top.py").write_text("import numpy as np\nfrom boxplus import middle as m\n")
    (root / "aside.py").write_text("Y = 1\n")
    monkeypatch.setattr(_jit, "_PACKAGE_ROOT", root)
    _forget()
    yield root
    _forget()


def _forget() -> None:
    _jit._imported_files.cache_clear()
    _jit._source_key.cache_clear()


def _key(file: Path) -> str:
    _forget()
    return _jit._source_key(file)


@pytest.mark.parametrize("changed", ["top.py", "middle.py", "low/bottom.py", "low/__init__.py"])
def test_the_key_follows_every_dependency(package: Path, changed: str) -> None:
    if changed == "low/__init__.py":  # seen only where the package itself is imported from
        (package / "middle.py").write_text("from boxplus.low import bottom\n")
    before = _key(package / "top.py")
    assert _key(package / "top.py") == before
    with (package / changed).open("a") as file:
        file.write("Z = 2\n")
    assert _key(package / "top.py") != before


@pytest.mark.parametrize("changed", ["low/bottom.py", "low/__init__.pyi"])
def test_the_key_follows_the_stub_of_a_package(package: Path, changed: str) -> None:
    (package / "low" / "__init__.pyi").write_text("from .bottom import X as X\n")
    (package / "middle.py").write_text("from boxplus.low import X\n")
    before = _key(package / "top.py")
    with (package / changed).open("a") as file:
        file.write("Z = 2\n")
    assert _key(package / "top.py") != before


@pytest.mark.parametrize("changed", ["aside.py", "top.py"])
def test_the_key_ignores_what_is_not_imported(package: Path, changed: str) -> None:
    before = _key(package / "middle.py")
    (package / changed).write_text("Y = 2\n")
    assert _key(package / "middle.py") == before


def test_files_that_import_one_another_have_a_key(package: Path) -> None:
    (package / "low" / "bottom.py").write_text("from boxplus.top import m\n")
    assert len(_key(package / "top.py")) == 24


def test_the_key_follows_the_processor(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = _key(package / "top.py")
    monkeypatch.setattr(_jit, "_processor", lambda: "another one")
    assert _key(package / "top.py") != before


def test_the_cache_folder_can_be_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BOXPLUS_CACHE_DIR", str(tmp_path))
    assert _jit.cache_root() == tmp_path
    monkeypatch.delenv("BOXPLUS_CACHE_DIR")
    assert _jit.cache_root().name == "boxplus"


_PROGRAM = """
from boxplus._jit import kernel, on_compilation
@kernel
def twice(x):
    return 2.0 * x
compiled = []
with on_compilation(compiled.append):
    twice(3.0)
print(twice(4.0), compiled)
"""


@pytest.mark.skipif(bool(numba_config.DISABLE_JIT), reason="nothing is compiled")
def test_a_second_process_compiles_nothing(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(_PROGRAM)

    def run(cache: Path) -> str:
        environment = {"BOXPLUS_CACHE_DIR": str(cache), "PATH": ""}
        done = subprocess.run(
            [sys.executable, str(tmp_path / "program.py")], env=environment, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    assert run(tmp_path / "cache") == "8.0 ['twice']"
    assert run(tmp_path / "cache") == "8.0 []"
    # Where the cache cannot be written the kernel works all the same.
    (tmp_path / "file").write_text("")
    assert run(tmp_path / "file") == "8.0 ['twice']"


@given(st.integers(0, 50), st.integers(1, 20), st.integers(1, 4))
def test_chunks_cover_everything_once(items: int, chunk: int, threads: int) -> None:
    done: dict[int, tuple[int, int]] = {}
    count = _jit.run_chunks(lambda index, begin, end: done.__setitem__(index, (begin, end)), items, chunk, threads)
    assert count == len(done) == -(-items // chunk)
    assert [row for index in range(count) for row in range(*done[index])] == list(range(items))
    assert all(end - begin <= chunk for begin, end in done.values())


@given(st.integers(0, 2**32 - 1), st.integers(1, 64))
def test_partial_sums_do_not_depend_on_the_threads(seed: int, chunk: int) -> None:
    values = np.random.default_rng(seed).normal(size=200) * 10.0 ** np.arange(-100, 100)
    totals = []
    for threads in (1, 2, 3):
        parts = np.zeros(200)

        def work(index: int, begin: int, end: int, parts: np.ndarray = parts) -> None:
            parts[index] = values[begin:end].sum()

        count = _jit.run_chunks(work, len(values), chunk, threads)
        total = 0.0
        for part in parts[:count]:
            total += part
        totals.append(total)
    assert totals[0] == totals[1] == totals[2]


def test_one_thread_is_the_callers_own() -> None:
    seen = set()
    _jit.run_chunks(lambda *_: seen.add(threading.get_ident()), 10, 3, 1)
    assert seen == {threading.get_ident()}


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_in_a_chunk_comes_out(threads: int) -> None:
    def work(index: int, begin: int, end: int) -> None:
        if index == 1:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        _jit.run_chunks(work, 10, 3, threads)
