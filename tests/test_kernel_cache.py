"""Compiled kernels on disk: keys that follow the sources, and nothing unpickled that is damaged or could be another's."""

from __future__ import annotations

import ast
import logging
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from numba.core import config as numba_config

from boxplus import _jit, _kernel_cache, _source_keys

compiles = pytest.mark.skipif(bool(numba_config.DISABLE_JIT), reason="nothing is compiled")
posix = pytest.mark.skipif(os.name == "nt", reason="the mode of a file says nothing there")


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
    monkeypatch.setattr(_source_keys, "_PACKAGE_ROOT", str(root))
    _forget()
    yield root
    _forget()


def _forget() -> None:
    _source_keys._module_files.cache_clear()
    _source_keys._source.cache_clear()
    _source_keys._listing.cache_clear()
    _source_keys.source_key.cache_clear()


def _key(file: Path) -> str:
    _forget()
    return _source_keys.source_key(str(file))


@pytest.mark.parametrize("changed", ["top.py", "middle.py", "low/bottom.py", "low/__init__.py"])
def test_the_key_follows_every_dependency(package: Path, changed: str) -> None:
    if changed == "low/__init__.py":  # seen only where the package itself is imported from
        (package / "middle.py").write_text("from boxplus.low import bottom\n")
    before = _key(package / "top.py")
    assert _key(package / "top.py") == before
    with (package / changed).open("a") as file:
        file.write("Z = 2\n")
    assert _key(package / "top.py") != before


@pytest.mark.parametrize(
    "line",
    [
        "from boxplus.low import bottom  # noqa: F401",
        "from boxplus.low import bottom as b  # a comment, with (brackets)",
        "from boxplus.low import (  # of (one)\n    X,\n    bottom,  # and (another)\n)",
        "from boxplus.low import X, \\\n    bottom",
        "if True:\n    from boxplus.low import bottom # here",
        "import boxplus.low.bottom as b  # noqa: F401",
    ],
)
def test_the_key_follows_an_import_however_it_is_written(package: Path, line: str) -> None:
    (package / "middle.py").write_text(f"{line}\n")
    before = _key(package / "top.py")
    (package / "low" / "bottom.py").write_text("X = 2\n")
    assert _key(package / "top.py") != before


def _imported_by(file: Path, root: Path) -> set[str]:
    """Names of modules of boxplus that a file imports, or may, as Python reads it: of `from a import b` both a and a.b."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = [*file.relative_to(root.parent).parts][: -node.level] if node.level else []
            module = ".".join([*package, *([node.module] if node.module else [])])
            names |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    return {name for name in names if name.startswith("boxplus.")}


def test_the_imports_of_every_file_of_the_package_are_found() -> None:
    root = Path(_source_keys._PACKAGE_ROOT)
    files = [*root.rglob("*.py"), *root.rglob("*.pyi")]
    assert len(files) > 300
    missed = {}
    for file in files:
        wanted = {path for name in _imported_by(file, root) for path in _source_keys._module_files(name)}
        found = _source_keys._source(str(file))[1]
        # What stands in the examples of docstrings is found too, which does no harm.
        if wanted - found:
            missed[str(file.relative_to(root))] = sorted(wanted - found)
    assert not missed


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


def test_the_key_is_that_of_the_same_files_elsewhere(package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = _key(package / "top.py")
    package.rename(tmp_path / "moved")
    monkeypatch.setattr(_source_keys, "_PACKAGE_ROOT", str(tmp_path / "moved"))
    assert _key(tmp_path / "moved" / "top.py") == before
    outside = tmp_path / "top.py"
    outside.write_text((tmp_path / "moved" / "top.py").read_text())
    assert _key(outside) != before


def test_files_that_import_one_another_have_a_key(package: Path) -> None:
    (package / "low" / "bottom.py").write_text("from boxplus.top import m\n")
    assert len(_key(package / "top.py")) == 24


def test_the_key_follows_the_processor(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = _key(package / "top.py")
    monkeypatch.setattr(_source_keys, "processor", lambda: "another one")
    assert _key(package / "top.py") != before


def test_the_cache_folder_can_be_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BOXPLUS_CACHE_DIR", str(tmp_path))
    assert _kernel_cache.cache_root() == tmp_path
    monkeypatch.delenv("BOXPLUS_CACHE_DIR")
    assert _kernel_cache.cache_root().name == "boxplus"


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


@pytest.mark.slow
@compiles
def test_a_second_process_compiles_nothing(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(_PROGRAM)

    def run(cache: Path) -> str:
        environment = {"BOXPLUS_CACHE_DIR": str(cache), "PATH": "", "PYTHONPATH": os.environ.get("PYTHONPATH", "")}
        done = subprocess.run(
            [sys.executable, str(tmp_path / "program.py")], env=environment, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    assert run(tmp_path / "cache") == "8.0 ['twice']"
    assert run(tmp_path / "cache") == "8.0 []"
    # Where the cache cannot be written the kernel works all the same.
    (tmp_path / "file").write_text("")
    assert run(tmp_path / "file") == "8.0 ['twice']"


@compiles
def test_what_is_loaded_needs_no_compiler(tmp_path: Path) -> None:
    """Most of Numba is its compiler; a process that compiles nothing must not import it, and still allocate and raise."""
    (tmp_path / "program.py").write_text("""
import sys
import numpy as np
from boxplus._jit import kernel

@kernel
def doubled(x):
    if len(x) == 0:
        raise ValueError("nothing to double")
    out = np.empty(len(x))
    for i in range(len(x)):
        out[i] = 2.0 * np.sin(x[i])
    return out, np.dot(out, out)

print(round(doubled(np.ones(2))[1], 3), "numba.cpython.charseq" in sys.modules)
try:
    doubled(np.empty(0))
except ValueError as error:
    print(error)
""")

    def run() -> list[str]:
        environment = {"BOXPLUS_CACHE_DIR": str(tmp_path / "cache"), "PATH": "", "PYTHONPATH": os.environ.get("PYTHONPATH", "")}
        program = [sys.executable, str(tmp_path / "program.py")]
        return subprocess.run(program, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()

    assert run() == ["5.665 True", "nothing to double"]
    assert run() == ["5.665 False", "nothing to double"]


@pytest.mark.slow
@compiles
def test_a_file_under_another_module_name_has_kernels_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(_PROGRAM)
    as_a_module = "import importlib.util as u; s = u.spec_from_file_location({0!r}, {1!r}); m = u.module_from_spec(s); "
    as_a_module += "import sys; sys.modules[{0!r}] = m; s.loader.exec_module(m)"

    def run(*arguments: str) -> str:
        environment = {"BOXPLUS_CACHE_DIR": str(tmp_path / "cache"), "PATH": "", "PYTHONPATH": os.environ.get("PYTHONPATH", "")}
        done = subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True, check=True)
        assert done.stderr == ""
        return done.stdout.strip()

    for arguments in (
        [str(tmp_path / "program.py")],
        ["-c", as_a_module.format("first", str(tmp_path / "program.py"))],
        ["-c", as_a_module.format("second.name", str(tmp_path / "program.py"))],
    ):
        assert run(*arguments) == "8.0 ['twice']"
        assert run(*arguments) == "8.0 []"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of this test's own, about which nothing was said yet."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("BOXPLUS_CACHE_DIR", str(folder))
    monkeypatch.setattr(_kernel_cache, "_told", set())
    _kernel_cache._is_usable.cache_clear()
    return folder


def _compiled_names() -> list[str]:
    """Which kernels a new process would have to compile: the dispatcher is new, the file it comes from is not."""

    def twice(x: float) -> float:
        return 2.0 * x

    compiled: list[str] = []
    with _jit.on_compilation(compiled.append):
        assert _jit.kernel(twice)(3.0) == 6.0
    return compiled


def _files(cache: Path, ending: str) -> list[Path]:
    return sorted(cache.rglob(f"*{ending}"))


@compiles
@pytest.mark.parametrize("ending", [".nbi", ".nbc"])
@pytest.mark.parametrize("damage", ["emptied", "cut", "changed"])
def test_a_damaged_file_is_discarded_said_once_and_written_again(
    cache: Path, caplog: pytest.LogCaptureFixture, ending: str, damage: str
) -> None:
    assert _compiled_names() == ["twice"] and _compiled_names() == []
    (file,) = _files(cache, ending)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0x10
    file.write_bytes({"emptied": b"", "cut": file.read_bytes()[:-7], "changed": bytes(content)}[damage])
    with caplog.at_level(logging.WARNING):
        assert _compiled_names() == ["twice"]
        assert _compiled_names() == []
    assert [record.getMessage() for record in caplog.records] == [
        f"{file} is damaged (cut or changed): it is discarded and its kernel compiled again"
    ]


def _gone() -> None:
    raise ModuleNotFoundError("No module named 'gone'")


class _Unrestorable:
    """Unpickling it fails, as that of machine code does whose module has gone."""

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return _gone, ()


@compiles
@pytest.mark.parametrize("ending", [".nbi", ".nbc"])
def test_what_cannot_be_restored_is_said_once_and_compiled_again(
    cache: Path, caplog: pytest.LogCaptureFixture, ending: str
) -> None:
    assert _compiled_names() == ["twice"] and _compiled_names() == []
    (file,) = _files(cache, ending)
    payload = pickle.dumps(_Unrestorable())
    file.write_bytes(_kernel_cache.hashlib.sha256(payload).digest() + payload)
    with caplog.at_level(logging.WARNING):
        assert _compiled_names() == ["twice"]
        assert _compiled_names() == []
    (record,) = caplog.records
    assert f"{file} cannot be restored" in record.getMessage() and "No module named 'gone'" in record.getMessage()


class _Planted:
    """Unpickling it leaves a file behind."""

    def __init__(self, trace: Path) -> None:
        self._trace = trace

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Path.touch, (self._trace,)


@compiles
@posix
@pytest.mark.parametrize("where", ["root", "kernels", "key", "file"])
@pytest.mark.parametrize("how", ["group", "others", "owner"])
def test_what_others_can_write_is_never_unpickled(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, where: str, how: str
) -> None:
    assert _compiled_names() == ["twice"]
    (index,) = _files(cache, ".nbi")
    payload = pickle.dumps(_Planted(tmp_path / "planted"))
    index.write_bytes(_kernel_cache.hashlib.sha256(payload).digest() + payload)
    path = {"root": cache, "kernels": cache / "kernels", "key": index.parent, "file": index}[where]
    if how == "owner":
        this = path.stat().st_ino
        distrusted = _kernel_cache._distrusted

        def of_another(path: str | Path, status: os.stat_result) -> bool:
            fields = list(status)
            fields[4] = 4321 if status.st_ino == this else status.st_uid  # st_uid
            return distrusted(path, os.stat_result(fields))

        monkeypatch.setattr(_kernel_cache, "_distrusted", of_another)
    else:
        path.chmod(path.stat().st_mode | (0o020 if how == "group" else 0o002))
    _kernel_cache._is_usable.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert _compiled_names() == ["twice"]
        _compiled_names()
    assert not (tmp_path / "planted").exists()
    (record,) = caplog.records
    said = "belongs to user 4321" if how == "owner" else "can be written by other users"
    assert f"{path} {said}" in record.getMessage() and "BOXPLUS_CACHE_DIR" in record.getMessage()


@compiles
@posix
def test_what_is_written_is_closed_to_others_whatever_the_umask(cache: Path) -> None:
    before = os.umask(0)
    try:
        assert _compiled_names() == ["twice"]
    finally:
        os.umask(before)
    for path in [cache, *cache.rglob("*")]:
        assert path.stat().st_mode & 0o077 == 0, path


@compiles
def test_a_disk_without_room_leaves_the_kernel_working(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_kernel_cache.os, "replace", full)
    with caplog.at_level(logging.WARNING):
        assert _compiled_names() == ["twice"]
        assert _compiled_names() == ["twice"]
    assert [record.getMessage() for record in caplog.records] == [
        f"compiled kernels cannot be kept in {next(cache.glob('kernels/*'))}: [Errno 28] No space left on device"
    ]
    assert not _files(cache, "nbi") and not list(cache.rglob("*.tmp.*"))
