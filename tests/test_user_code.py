"""Functions of users on disk: a key that follows all they refer to, and machine code of nothing but what is there now."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core import config as numba_config
from numba.extending import overload

from boxplus import _kernel_cache, _user_code
from boxplus._jit import kernel, on_compilation
from boxplus._user_code import UserCode, snapshot
from boxplus.manifolds.euclidean import Euclidean
from boxplus.optimization.losses import UserLoss
from boxplus.optimization.user_loss import compiled_loss
from boxplus.residuals.user.residual import UserResidual

compiles = pytest.mark.skipif(bool(numba_config.DISABLE_JIT), reason="nothing is compiled")

# Every place that a value or an operation can come from.
_SOURCE = """
import math
import numba
import numpy as np

CONSTANT = {constant}
TABLE = np.array([1.0, {entry}], dtype=np.{dtype})
PAIR = (1, {pair})

@numba.njit
def deepest(x):
    return x {deepest} 2.0

@numba.njit
def helper(x):
    return deepest(x) + CONSTANT

def made(cell):
    def function(x, y={default}, *, z={keyword}):
        value = helper(x[0]) {outer} cell * y + TABLE[1] * z + PAIR[1]
        return value + other.scale * other.helper(x[0]) + math.{name}(x[0]) + {literal}
    return function

function = made({cell})
"""
_OTHER = """
import numba

scale = {scale}
unused = {unused}

@numba.njit
def helper(x):
    return x {module_operation} scale
"""
_CHOICES: dict[str, list[str]] = {
    "constant": ["1.0", "1", "True", "0.0", "-0.0"],
    "entry": ["2.0", "3.0"],
    "dtype": ["float64", "int64"],
    "pair": ["2", "2.0"],
    "deepest": ["*", "+"],
    "default": ["1.0", "2.0"],
    "keyword": ["1.0", "2.0"],
    "outer": ["+", "-"],
    "name": ["sin", "cos"],
    "literal": ["1", "1.0", "0.0", "-0.0"],
    "cell": ["3.0", "4.0"],
    "scale": ["5.0", "6.0"],
    "module_operation": ["*", "-"],
}


def _module(choice: dict[str, str], unused: str = "1", comment: str = "") -> FunctionType:
    other, main = ModuleType("other"), ModuleType("written_by_a_user")
    exec(_OTHER.format(**choice, unused=unused), vars(other))
    vars(main)["other"] = other
    exec(comment + _SOURCE.format(**choice), vars(main))
    function: FunctionType = vars(main)["function"]
    return function


def _key(function: Any) -> str | None:
    return UserCode.of(function).key


_chosen = st.fixed_dictionaries({name: st.sampled_from(values) for name, values in _CHOICES.items()})


@compiles
@settings(max_examples=40, deadline=None)
@given(_chosen, st.sampled_from(sorted(_CHOICES)), st.data())
def test_the_key_follows_every_value_and_operation(choice: dict[str, str], changed: str, data: st.DataObject) -> None:
    before = _key(_module(choice))
    assert before is not None
    # Neither what is not used, nor where the text stands, nor another module object of the same content make a difference.
    assert _key(_module(choice, unused="2", comment="# moved down\n\n")) == before
    other = data.draw(st.sampled_from([value for value in _CHOICES[changed] if value != choice[changed]]))
    assert _key(_module({**choice, changed: other})) != before


@compiles
def test_values_that_change_in_place_change_the_key() -> None:
    function = _module({name: values[0] for name, values in _CHOICES.items()})
    seen = {_key(function)}
    function.__globals__["CONSTANT"] = 2.0
    seen.add(_key(function))
    function.__globals__["TABLE"][1] = 7.0
    seen.add(_key(function))
    function.__globals__["other"].scale = 8.0
    seen.add(_key(function))
    function.__defaults__ = (9.0,)
    seen.add(_key(function))
    assert len(seen) == 5 and None not in seen


class _Opaque:
    pass


_opaque = _Opaque()
_helpers_in_a_tuple = (np.sin, _opaque)


class _Pair(NamedTuple):
    scale: float


def _reads_an_object(x):
    return _opaque if x[0] > 0.0 else x[0]


def _reads_a_tuple_of_objects(x):
    return _helpers_in_a_tuple[0](x[0])


@numba.njit
def recursive(n):
    return 1.0 if n <= 0 else recursive(n - 1)


def _calls_itself(x):
    return recursive(3) * x[0]


@compiles
@pytest.mark.parametrize("function", [_reads_an_object, _reads_a_tuple_of_objects])
def test_what_cannot_be_told_by_its_value_has_no_key(function: Any) -> None:
    assert _key(function) is None


@compiles
def test_a_function_compiled_before_its_constant_changed_has_no_key_of_the_new_one() -> None:
    assert recursive(3) == 1.0  # it is compiled: with what, nobody looks up
    assert _key(_calls_itself) is None


@compiles
def test_functions_of_numpy_and_lambdas_have_keys() -> None:
    from numpy import arctan2, cross, dot, float64
    from numpy.linalg import norm

    functions = [
        lambda x: dot(x, x),
        lambda x: norm(x),
        lambda x: cross(x, x),
        lambda x: arctan2(x[0], x[1]),
        lambda x: float64(x[0]),
        lambda x: abs(x[0]) + max(x[0], 1.0),
        eval("lambda x: x[0] + 1"),
        eval("lambda x: x[0] + 2"),
    ]
    keys = {_key(function) for function in functions}
    assert None not in keys and len(keys) == len(functions)


@compiles
def test_the_key_follows_versions_and_the_files_of_boxplus(monkeypatch: pytest.MonkeyPatch) -> None:
    def plain(x):
        return x[0]

    before = _key(plain)
    with monkeypatch.context() as patch:
        patch.setattr(_user_code.np, "__version__", "0.0")
        assert _key(plain) != before
    with monkeypatch.context() as patch:
        patch.setattr(_user_code, "processor", lambda: "another one")
        assert _key(plain) != before
    with monkeypatch.context() as patch:
        patch.setattr(_user_code, "source_key", lambda file: "edited")
        assert _key(plain) != before
    assert _key(plain) == before


@compiles
def test_the_key_follows_what_others_teach_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    def plain(x):
        return x[0]

    def stub(x):
        raise NotImplementedError

    registry = _user_code.templates.builtin_registry
    monkeypatch.setattr(registry, "functions", list(registry.functions))
    keys = [_key(plain)]
    for factor in (2.0, 3.0):

        def implementation(x, factor=factor):
            return lambda x, factor=factor: factor * x

        overload(stub)(implementation)
        keys.append(_key(plain))
    assert len(set(keys)) == 3 and None not in keys


@compiles
def test_a_snapshot_keeps_what_was_there() -> None:
    scope: dict[str, Any] = {"numba": numba}
    exec("C = 1.0\n@numba.njit\ndef h(x): return C * x\ndef f(x): return h(x) + C", scope)
    assert kernel(scope["f"], cached=False)(2.0) == 3.0  # h is compiled with C = 1
    scope["C"] = 10.0
    taken = snapshot(scope["f"], checked=False)
    scope["C"] = 100.0
    assert kernel(taken, cached=False)(2.0) == 30.0


@compiles
def test_a_snapshot_keeps_arrays_that_are_written_to_later() -> None:
    scope: dict[str, Any] = {"numba": numba, "np": np}
    text = """
    A, PAIR, RECORD = np.array([1.0]), (2, np.array([2.0])), np.array([(4.0,)], dtype=[("w", "f8")])
    @numba.njit
    def h(x):
        return x + A[0]
    def outer(cell):
        def f(x, y=np.array([16.0])):
            return h(x) + PAIR[1][0] + RECORD.w[0] + cell[0] + y[0]
        return f
    """
    exec(textwrap.dedent(text), scope)
    cell = np.array([8.0])
    function = scope["outer"](cell)
    code = UserCode.of(function)
    for array in (scope["A"], scope["PAIR"][1], scope["RECORD"]["w"], cell, function.__defaults__[0]):
        array *= 100.0
    assert code.key is not None and code.key != _key(function)
    for checked in (False, True):
        taken = code.snapshot(checked=checked)
        assert taken.__defaults__ is not None and taken.__defaults__[0][0] == 16.0
        assert kernel(taken, cached=False)(0.0, np.array([0.0])) == 15.0


@compiles
def test_what_has_no_key_is_never_taken_for_what_it_was_before() -> None:
    scope: dict[str, Any] = {"C": _Pair(2.0)}
    exec("def f(x):\n    return C.scale * x[0]\ndef loss(s):\n    return C.scale * s, C.scale, 0.0", scope)

    def value() -> float:
        residual = UserResidual(scope["f"], dim=1, manifolds=(Euclidean(1),), count=1)
        assert residual.linearize([1.0]).jacobians[0][0, 0, 0] == residual.evaluate([1.0])[0, 0]
        return float(residual.evaluate([1.0])[0, 0])

    assert _key(scope["f"]) is None
    assert value() == 2.0
    losses = [UserLoss(scope["loss"])]
    scope["C"] = _Pair(3.0)
    assert value() == 3.0
    losses.append(UserLoss(scope["loss"]))
    assert losses[0] != losses[1] and losses[0] == losses[0].with_scale(1.0)
    derivatives = np.zeros((2, 1, 3))
    for loss, found in zip(losses, derivatives, strict=True):
        assert loss.taken_down is not None
        compiled_loss(loss.taken_down)[0](0, 1, 1.0, np.ones((1, 1)), np.ones(1, dtype=np.bool_), found)
    assert np.array_equal(derivatives[:, 0], [[2.0, 2.0, 0.0], [3.0, 3.0, 0.0]])


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("BOXPLUS_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def _value_and_compiled(function: Any) -> tuple[float, bool]:
    compiled: list[str] = []
    with on_compilation(compiled.append):
        residual = UserResidual(function, dim=1, manifolds=(Euclidean(1),), count=1, jacobian=_no_jacobian)
        value = float(residual.linearize([2.0]).residuals[0, 0])
    return value, bool(compiled)


def _no_jacobian(x, J):
    J[0, 0] = 1.0


@compiles
def test_unchanged_is_loaded_and_changed_is_compiled(cache: Path) -> None:
    def made(cell: float, helper_text: str, constant: float) -> Any:
        scope: dict[str, Any] = {"numba": numba, "C": constant}
        exec(f"@numba.njit\ndef h(x):\n    return {helper_text}\n", scope)
        exec("def outer(cell):\n    def f(x):\n        return h(x[0]) + cell + C\n    return f\n", scope)
        return scope["outer"](cell)

    assert _value_and_compiled(made(1.0, "x", 0.0)) == (3.0, True)
    assert _value_and_compiled(made(1.0, "x", 0.0)) == (3.0, False)
    assert _value_and_compiled(made(5.0, "x", 0.0)) == (7.0, True)
    assert _value_and_compiled(made(1.0, "2.0 * x", 0.0)) == (5.0, True)
    assert _value_and_compiled(made(1.0, "x", 10.0)) == (13.0, True)
    assert _value_and_compiled(made(1.0, "x", 0.0)) == (3.0, False)
    # One object, its global changed between two residuals, each of which is as it was when it was made.
    function = made(1.0, "x", 20.0)
    assert _value_and_compiled(function) == (23.0, True)
    function.__globals__["C"] = 30.0
    assert _value_and_compiled(function) == (33.0, True)


@compiles
def test_what_holds_an_address_of_this_process_is_not_kept(cache: Path) -> None:
    scope: dict[str, Any] = {"LARGE": np.arange(300_000.0)}
    exec("def f(x):\n    return x[0] + LARGE[7]", scope)
    assert _value_and_compiled(scope["f"])[0] == 9.0
    again: dict[str, Any] = {"LARGE": np.arange(300_000.0)}
    exec("def f(x):\n    return x[0] + LARGE[7]", again)
    assert _value_and_compiled(again["f"]) == (9.0, True)


@pytest.mark.slow
@compiles
def test_a_new_process_compiles_nothing_of_a_loss_and_a_residual(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    text = textwrap.dedent("""
        import boxplus as bp
        from boxplus._jit import on_compilation

        def welsch(s):
            e = 0.5 * s
            return s / (1.0 + e), 1.0 / ((1.0 + e) * (1.0 + e)), -1.0 / ((1.0 + e) * (1.0 + e) * (1.0 + e))

        compiled = []
        with on_compilation(compiled.append):
            residual = bp.residuals.UserResidual(lambda x, z: x[0] - z, dim=1, manifolds=(bp.Euclidean(1),), data=([1.0],))
            problem = bp.Problem()
            x = problem.add_variables(bp.Euclidean(1), [[3.0]])
            problem.add_residuals(residual, x, loss=bp.losses.UserLoss(welsch))
            cost = problem.cost()
        print(round(cost, 9), len(compiled) > 0)
    """)

    def run(text: str) -> str:
        program.write_text(text)
        environment = {**os.environ, "BOXPLUS_CACHE_DIR": str(tmp_path / "cache")}
        done = subprocess.run([sys.executable, str(program)], env=environment, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    assert run(text) == "0.666666667 True"
    assert run(text) == "0.666666667 False"
    assert run("# one line more\n" + text.replace("x[0] - z", "x[0] - z - 1.0")) == "0.333333333 True"


@pytest.mark.slow
@compiles
def test_arrays_written_to_between_two_compilations_do_not_reach_other_processes(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(
        textwrap.dedent("""
        import sys
        import numpy as np
        import boxplus as bp

        K = np.array([2.0])
        stretched = bp.UserManifold(
            "Stretched", size=1, dof=1, identity=[0.0],
            plus=lambda x, delta: (x[0] + K[0] * delta[0],), minus=lambda x, base: ((x[0] - base[0]) / K[0],),
        )
        K[0] = float(sys.argv[1])
        position = bp.residuals.UserResidual(lambda x: x[0], dim=1, manifolds=(stretched,), count=1, jacobian="automatic")
        print(position.linearize([1.0]).jacobians[0].item(), stretched.boxplus([1.0], [1.0]).item())
        """)
    )
    environment = {**os.environ, "BOXPLUS_CACHE_DIR": str(tmp_path / "cache")}
    for factor in ("5.0", "2.0"):
        command = [sys.executable, str(program), factor]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.split() == ["2.0", "3.0"]


def test_losses_of_one_function_are_equal_and_follow_its_constants() -> None:
    scope: dict[str, Any] = {"C": 1.0}
    exec("def f(s):\n    return C * s, C, 0.0", scope)
    first = UserLoss(scope["f"])
    assert first == UserLoss(scope["f"]) and first.taken_down is not None
    if numba_config.DISABLE_JIT:
        return
    scope["C"] = 2.0
    assert first != UserLoss(scope["f"])


@compiles
def test_of_what_users_compiled_the_longest_unused_makes_room(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def made(constant: float) -> Any:
        scope: dict[str, Any] = {"C": constant}
        exec("def f(x):\n    return x[0] + C", scope)
        return scope["f"]

    def folders() -> set[str]:
        return {path.name for path in (cache / "kernels").iterdir() if path.name.startswith("user-")}

    kernels = cache / "kernels"
    assert _value_and_compiled(made(1.0)) == (3.0, True)
    own = folders()
    old, kept = time.time() - 1e6, ["0123456789abcdef01234567-00000000", "user-of somebody else"]
    for name in [*kept, *(f"user-{number:024x}-00000000" for number in range(8))]:
        (kernels / name).mkdir(mode=0o700)
        (kernels / name / "f.nbi").touch()
        os.utime(kernels / name, (old, old))
    for name in own:
        os.utime(kernels / name, (old + 1.0, old + 1.0))
    monkeypatch.setattr(_kernel_cache, "_MOST_OF_USERS", len(own) + 3)
    _kernel_cache._forget_old.cache_clear()
    assert _value_and_compiled(made(1.0)) == (3.0, False)
    left = folders()
    assert own < left and len(left - set(kept)) == len(own) + 3 and set(kept) <= {path.name for path in kernels.iterdir()}
    assert all((kernels / name).stat().st_mtime > old + 1e5 for name in own)  # used again, and so the newest
    # What another process may be about to read stays.
    for number in range(8, 20):
        (kernels / f"user-{number:024x}-00000000").mkdir(mode=0o700)
    _kernel_cache._forget_old.cache_clear()
    _value_and_compiled(made(1.0))
    assert len(folders() - set(kept)) == len(own) + 12
