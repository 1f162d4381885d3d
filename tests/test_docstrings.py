"""Every public class and function has an example, and every example of a docstring does what it says.

Examples of public names take `import numpy as np` and `import boxplus as bp` for granted, and nothing else; those of others know
their file's names, too. They run in a folder with a recording `flight.bag` (and `flight.gt.tum`), a pose graph `loops.g2o`, a
reconstruction `scene.txt.bz2`, a COLMAP model `colmap`, a line set `Corridor` and a camera recording `room_stereo`.
"""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import boxplus as bp
from boxplus.formats.reconstructions.vgg_writer import write_vgg_lines
from boxplus.manifolds import se3
from boxplus.optimization import losses
from boxplus.simulation import SpinningLidar, simulate, write_recording
from boxplus.simulation.cameras import make_rig, simulate_cameras, write_camera_recording
from tests.small_problems import colmap_model, write_small_files

ROOT = Path(__file__).resolve().parents[1]


def public_objects() -> dict[str, Any]:
    """Classes and functions by the shortest name that a stub gives them; the manifolds that are objects by their class."""
    found: dict[str, Any] = {}
    seen: set[int] = set()
    for stub in sorted((ROOT / "boxplus").rglob("*.pyi"), key=lambda path: (len(path.parts), path)):
        package = ".".join(stub.parent.relative_to(ROOT).parts)
        module = importlib.import_module(package)
        for name in module.__all__:
            value = getattr(module, name)
            if isinstance(value, bp.Manifold):
                value = type(value)
            if (inspect.isclass(value) or inspect.isfunction(value)) and id(value) not in seen:
                seen.add(id(value))
                found[f"{package}.{name}"] = value
    for name, value in vars(losses).items():
        if name[0].isupper() and callable(value) and value.__module__ == losses.__name__:
            found[f"boxplus.losses.{name}"] = value
    return found


PUBLIC = public_objects()
HOMES = {(inspect.unwrap(value).__module__, inspect.unwrap(value).__name__) for value in PUBLIC.values()}
ROOMS = sorted({inspect.unwrap(value).__module__.split(".")[1] for value in PUBLIC.values()})


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("examples")
    write_small_files(folder)
    write_recording(simulate("walk", duration_s=2.0, lidar=SpinningLidar(azimuth_steps=300)), folder / "flight", "ros1")
    write_camera_recording(
        simulate_cameras("room", duration_s=1.0, rig=make_rig("stereo", scale=0.25, rate_hz=5.0)), folder / "room_stereo"
    )
    bp.formats.write_colmap(folder / "colmap", colmap_model())
    write_vgg_lines(folder / "Corridor", line_set())
    return folder


def line_set() -> bp.formats.VggLines:
    """Twelve lines in six views, 0.3 px of noise, cameras half a milliradian and half a millimetre off."""
    rng = np.random.default_rng(0)
    ends, angle, zero = rng.uniform(-3.0, 3.0, (12, 6)), np.linspace(-0.6, 0.6, 6), np.zeros(6)
    T_camera_world = np.column_stack([np.cos(angle), zero, np.sin(angle), zero, zero, zero, zero + 12.0])
    view_of, line_of = (grid.ravel() for grid in np.mgrid[:6, :12])
    camera = bp.Pinhole(600.0, 600.0, 320.0, 240.0)
    pixels = [camera.project(se3.act(T_camera_world[view_of], p[line_of]))[0] for p in (ends[:, :3], ends[:, 3:])]
    return bp.formats.VggLines(
        names=tuple("abcdef"),
        K=np.tile(camera.K, (6, 1, 1)),
        T_camera_world=bp.SE3Left.boxplus(T_camera_world, 5e-4 * rng.normal(size=(6, 6))),
        end_points_world=ends,
        view_of=view_of.astype(np.uint32),
        line_of=line_of.astype(np.uint32),
        segments=np.hstack(pixels) + rng.normal(0.0, 0.3, (72, 4)),
    )


def test_every_public_class_and_function_has_an_example() -> None:
    assert len(PUBLIC) > 160
    without = [name for name, value in PUBLIC.items() if not doctest.DocTestParser().get_examples(value.__doc__ or "")]
    assert not without, f"no example in the docstring of {', '.join(without)}"


def examples_of(source: Path) -> Iterator[tuple[str, str]]:
    """Name and docstring of everything in a file whose docstring has an example."""
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            text = ast.get_docstring(node)
            if text is not None and ">>>" in text:
                yield getattr(node, "name", source.stem), text


@pytest.mark.parametrize("room", ROOMS)
def test_examples_do_what_they_say(room: str, workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workspace)
    home = ROOT / "boxplus" / room
    runner, told, parser = doctest.DocTestRunner(verbose=False), list[str](), doctest.DocTestParser()
    for source in sorted(home.rglob("*.py")) if home.is_dir() else [home.with_suffix(".py")]:
        for name, text in examples_of(source):
            module = ".".join(source.relative_to(ROOT).with_suffix("").parts)
            is_public = (module, name) in HOMES
            known = {} if is_public else vars(importlib.import_module(module))
            test = parser.get_doctest(text, {**known, "np": np, "bp": bp}, name, str(source.relative_to(ROOT)), None)
            skipped = any(doctest.SKIP in example.options for example in test.examples)
            assert not (is_public and skipped), f"{source.name}: {name} is skipped"
            runner.run(test, out=told.append)
    assert not told, "".join(told)
    assert runner.summarize(verbose=False).attempted > 0


@pytest.mark.parametrize("room", ROOMS)
def test_arguments_that_are_described_are_those_of_the_signature(room: str) -> None:
    for name, value in PUBLIC.items():
        described = re.search(r"^ *Args:\n((?: +.*\n|\n)*?)(?=^ *\w+:$|\Z)", inspect.cleandoc(value.__doc__ or "") + "\n", re.M)
        if inspect.unwrap(value).__module__.split(".")[1] != room or described is None:
            continue
        words = re.findall(r"^    (\*{0,2}\w+(?:, \*{0,2}\w+)*)[:(]", described[1], re.M)
        arguments = {word.lstrip("*") for names in words for word in names.split(", ")}
        assert arguments <= set(inspect.signature(value).parameters), f"{name}: {sorted(arguments)}"
