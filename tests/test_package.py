"""The package as a whole: quick to import, typed, pure Python, and its house rules."""

from __future__ import annotations

import ast
import graphlib
import importlib
import importlib.metadata
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import boxplus

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted((ROOT / "boxplus").rglob("*.py"))
STUBS = sorted((ROOT / "boxplus").rglob("*.pyi"))
HEAVY = ["numba", "scipy", "matplotlib", "plotly", "rosbags", "pydantic", "typer", "rich", "yaml", "numpy"]
# From the lowest room to the highest: each imports only from those before it.
ROOMS = [
    "differentiation",
    "manifolds",
    "cameras",
    "sparse",
    "residuals",
    "optimization",
    "formats",
    "filtering",
    "maps",
    "sensors",
    "recordings",
    "systems",
    "runs",
    "evaluation",
    "simulation",
    "report",
    "cli",
]


def modules_after(code: str) -> set[str]:
    """Top-level modules in a fresh interpreter after `code`."""
    program = f"{code}\nimport sys\nsys.stdout.write(' '.join(sorted({{name.split('.')[0] for name in sys.modules}})))"
    return set(subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split())


def setuptools_knows_licence_expressions() -> bool:
    try:
        return int(importlib.metadata.version("setuptools").split(".")[0]) >= 77
    except importlib.metadata.PackageNotFoundError:
        return False


def test_import_pulls_in_nothing_heavy() -> None:
    assert not modules_after("import boxplus") & set(HEAVY)


def test_command_line_starts_without_the_numerics() -> None:
    code = (
        "import sys\nfrom boxplus.cli import app\nsys.argv = ['boxplus', '--help']\ntry:\n    app()\nexcept SystemExit:\n    pass"
    )
    assert not modules_after(code) & {"numba", "scipy", "matplotlib", "plotly", "rosbags"}


def test_sensor_types_need_no_compiler() -> None:
    assert not modules_after("from boxplus import Scan, ImuSamples, RecordingOptions, InputError") & {"numba", "scipy", "rosbags"}


def test_public_names_are_what_they_are_in_their_homes() -> None:
    for name in boxplus.__all__:
        assert getattr(boxplus, name) is not None
    assert set(boxplus.__all__) <= set(dir(boxplus))
    assert len(boxplus.__all__) == len(set(boxplus.__all__))
    from boxplus.maps.ikd_tree import IkdTree

    assert boxplus.IkdTree is IkdTree
    with pytest.raises(AttributeError, match="No boxplus attribute Nothing"):
        boxplus.Nothing  # noqa: B018


@pytest.mark.parametrize("stub", [pytest.param(path, id=path.parent.name) for path in STUBS])
def test_a_package_has_the_names_of_its_stub(stub: Path) -> None:
    package = ".".join(stub.parent.relative_to(ROOT).parts)
    module = importlib.import_module(package)
    homes = {
        alias.name: f"{package}.{node.module}" if node.module else package
        for node in ast.parse(stub.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert sorted(module.__all__) == sorted(homes)
    for name, home in homes.items():
        assert getattr(module, name) is getattr(importlib.import_module(home), name)


def test_packages_of_names_pull_in_nothing_heavy() -> None:
    packages = [".".join(stub.parent.relative_to(ROOT).parts) for stub in STUBS]
    assert not modules_after(f"import {', '.join(packages)}") & set(HEAVY)


def test_version_is_that_of_the_changelog() -> None:
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(rf"^## {re.escape(boxplus.__version__)}\b", changelog, re.MULTILINE)


def test_wheel_is_pure_python_and_typed(tmp_path: Path) -> None:
    if not setuptools_knows_licence_expressions():
        pytest.skip("setuptools 77 or later is not installed here, and building must not download anything")
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        (source / name).write_bytes((ROOT / name).read_bytes())
    for path in [*SOURCES, *STUBS, ROOT / "boxplus" / "py.typed", ROOT / "boxplus" / "report" / "page.js"]:
        target = source / path.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())
    build = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", build, str(tmp_path)], cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name == f"boxplus-{boxplus.__version__}-py3-none-any.whl"
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (metadata,) = [archive.read(name).decode() for name in names if name.endswith("METADATA")]
        (entries,) = [archive.read(name).decode() for name in names if name.endswith("entry_points.txt")]
    assert {"boxplus/py.typed", "boxplus/report/page.js"} <= set(names)
    assert {name.split("/")[0] for name in names} == {"boxplus", f"boxplus-{boxplus.__version__}.dist-info"}
    assert {str(path.relative_to(ROOT)) for path in [*SOURCES, *STUBS]} <= set(names)
    assert "License-Expression: MIT" in metadata
    assert "boxplus = boxplus.cli:main" in entries


def test_sources_that_texts_name_are_there_for_their_readers() -> None:
    pages = sorted((ROOT / "docs").rglob("*.md"))
    cited = {(path, name) for path in SOURCES for name in re.findall(r"docs/[\w/]+\.md", path.read_text(encoding="utf-8"))}
    assert len(cited) > 100
    assert not [f"{path.relative_to(ROOT)}: {name}" for path, name in sorted(cited) if not (ROOT / name).is_file()]
    private = re.compile(r"\b(SPEC|SPEC_SYSTEMS|DESIGN|ERRATA|MODELS)(\.md)?\b(?!\s*=)")
    assert not [str(path.relative_to(ROOT)) for path in (*SOURCES, *pages) if private.search(path.read_text(encoding="utf-8"))]


def test_the_page_on_the_architecture_names_every_folder_in_the_row_of_its_room() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)/` \| (.*) \|$", page, re.MULTILINE))
    assert list(rows) == [room for room in ROOMS if (ROOT / "boxplus" / room).is_dir()]
    folders = sorted({path.parent.relative_to(ROOT / "boxplus") for path in SOURCES if path.parent != ROOT / "boxplus"})
    assert not [str(f) for f in folders if len(f.parts) > 1 and f"`{f.name}/`" not in rows[f.parts[0]]]


@pytest.mark.parametrize("path", [pytest.param(path, id=str(path.relative_to(ROOT))) for path in SOURCES])
def test_house_rules(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 400, "a file is one noun, at most 400 lines"
    tree = ast.parse(text)
    room = path.relative_to(ROOT / "boxplus").parts[0]
    for node in ast.walk(tree):
        assert not isinstance(node, ast.Assert), f"line {node.lineno}: assert in library code"
        assert not (isinstance(node, ast.ExceptHandler) and node.type is None), f"line {node.lineno}: bare except"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in ("print", "exit", "quit"), f"line {node.lineno}: {node.func.id} in library code"
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "sys":
            assert node.attr != "exit" or room == "cli", f"line {node.lineno}: sys.exit in library code"
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import"


@pytest.mark.parametrize("room", [room for room in ROOMS if (ROOT / "boxplus" / room).is_dir()])
def test_rooms_import_downwards_only(room: str) -> None:
    """Imports at the top of a file; a command or a test of the wiring may reach further inside a function.

    The sparse factorisation is a library of its own: it imports from no other room at all.
    """
    for path in sorted((ROOT / "boxplus" / room).rglob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.module is not None and node.module.startswith("boxplus."):
                used = node.module.split(".")[1]
                if used in ROOMS:
                    assert ROOMS.index(used) <= ROOMS.index(room), f"{path.relative_to(ROOT)} imports {node.module}"
                    assert room != "sparse" or used == "sparse", f"{path.relative_to(ROOT)} imports {node.module}"


def imports_of_files() -> dict[str, set[str]]:
    """The modules that each module imports. Imports inside functions count; those for type checkers alone do not."""
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in SOURCES}
    imported: dict[str, set[str]] = {}
    for module, path in modules.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        guards = [node for node in ast.walk(tree) if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
        typed = {node for guard in guards for node in ast.walk(guard)}
        imported[module] = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node not in typed and node.module is not None:
                submodules = {f"{node.module}.{alias.name}" for alias in node.names} & modules.keys()
                imported[module] |= submodules or {node.module} & modules.keys()
    return imported


def test_no_files_import_one_another_in_a_circle() -> None:
    graphlib.TopologicalSorter(imports_of_files()).prepare()  # raises CycleError, which names the files


def test_no_folders_import_one_another_in_a_circle() -> None:
    """Of two folders in one room; a folder and the one it lies in are one concept."""
    folders = {".".join(path.parent.relative_to(ROOT).parts) for path in SOURCES}
    used: dict[str, set[str]] = {folder: set() for folder in folders}

    def home(module: str) -> str:
        return module if module in folders else module.rpartition(".")[0]

    for module, others in imports_of_files().items():
        own = home(module)
        for other in map(home, others):
            if not f"{own}.".startswith(f"{other}.") and not f"{other}.".startswith(f"{own}."):
                used[own].add(other)
    graphlib.TopologicalSorter(used).prepare()  # raises CycleError, which names the folders
