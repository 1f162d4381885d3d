"""The benchmarks' gate: judged on made-up figures, nothing is timed here."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
NAMES = ("metrics", "run")


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[ModuleType, ModuleType]]:
    """`metrics` and `run` of the folder, which is not a package; they leave no trace."""
    import importlib

    monkeypatch.syspath_prepend(str(FOLDER))
    for name in NAMES:
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield tuple(importlib.import_module(name) for name in NAMES)
    for name in NAMES:
        sys.modules.pop(name, None)


def fake(modules, monkeypatch, *metrics):
    """The runner finds these figures for the benchmark `scan`, without running it."""
    monkeypatch.setattr(modules[1], "run_benchmark", lambda name, *, quick: list(metrics))


def test_with_an_opponent_the_ratio_is_judged(modules):
    Metric = modules[0].Metric
    metric = Metric("scan/total", 3.0, "ms", bar=1.0, opponent="cKDTree", opponent_value=4.0)
    assert metric.ratio == 0.75
    assert (metric.judged, metric.judged_unit, metric.verdict) == (0.75, "ratio", "ok")
    assert Metric("scan/total", 5.0, "ms", bar=1.0, opponent="cKDTree", opponent_value=4.0).verdict == "FALLS SHORT"


def test_without_an_opponent_the_value_is_judged(modules):
    Metric = modules[0].Metric
    assert Metric("recordings/speed", 4.9, "x real time", "higher", bar=5.0).verdict == "FALLS SHORT"
    assert Metric("recordings/speed", 5.0, "x real time", "higher", bar=5.0).verdict == "ok"
    assert Metric("recordings/speed", 5.0, "x real time", "higher").verdict == ""


def test_what_is_not_a_number_falls_short(modules):
    Metric = modules[0].Metric
    assert Metric("recordings/ATE", np.nan, "cm", bar=1.0).verdict == "FALLS SHORT"
    assert Metric("recordings/ATE", np.inf, "cm", bar=1.0).verdict == "FALLS SHORT"


def test_an_opponent_that_failed_is_beaten(modules):
    metric = modules[0].Metric("recordings/ATE", 1.0, "cm", bar=1.0, opponent="other", opponent_value=np.inf)
    assert (metric.ratio, metric.verdict) == (0.0, "ok")


def test_the_table_says_what_falls_short(modules):
    Metric, table = modules[0].Metric, modules[0].table
    text = table([Metric("a/short", 2.0, "ms", bar=1.0), Metric("a/ok", 8.0, "x", "higher", 5.0), Metric("a/plain", 1.5, "MB")])
    header, short, fine, plain = text.splitlines()
    assert header.split() == ["figure", "value", "unit", "opponent", "its", "value", "ratio", "bar"]
    assert short.endswith("≤ 1  FALLS SHORT") and fine.endswith("≥ 5  ok") and plain.endswith("MB")


def test_metrics_survive_json(modules):
    metrics = modules[0]
    before = [metrics.Metric("a/b", 1.0, "ms", bar=2.0, opponent="o", opponent_value=4.0), metrics.Metric("a/c", 2.0, "MB")]
    assert metrics.from_json(json.loads(json.dumps(metrics.to_json(before)))) == before


@pytest.mark.parametrize(
    ("direction", "value", "worse"),
    [("lower", 1.09, False), ("lower", 1.11, True), ("lower", 0.2, False), ("higher", 0.91, False), ("higher", 0.89, True)],
)
def test_a_regression_is_worse_than_the_tolerance(modules, direction, value, worse):
    metrics = modules[0]
    baseline = {"scan/x": metrics.Expected(1.0, "cm", direction, 0.1)}
    found = metrics.regressions(baseline, [metrics.Metric("scan/x", value, "cm", direction)], ["scan"])
    assert bool(found) == worse
    if worse:
        assert found[0].startswith(f"scan/x: {value:.4g} cm, baseline 1 and at {'most' if direction == 'lower' else 'least'}")


def test_a_missing_figure_is_a_regression_only_where_its_benchmark_ran(modules):
    metrics = modules[0]
    baseline = {"scan/x": metrics.Expected(1.0, "ms", "lower", 0.1)}
    assert metrics.regressions(baseline, [], ["memory"]) == []
    assert metrics.regressions(baseline, [], ["scan"]) == ["scan/x: in the baseline, but not measured"]


def test_another_unit_is_a_regression(modules):
    metrics = modules[0]
    baseline = {"scan/x": metrics.Expected(1.0, "ratio", "lower", 0.1)}
    found = metrics.regressions(baseline, [metrics.Metric("scan/x", 0.5, "ms")], ["scan"])
    assert found == ["scan/x: measured in ms, the baseline is in ratio"]


def test_gate_and_update_of_the_runner(modules, monkeypatch, tmp_path, capsys):
    run, Metric = modules[1], modules[0].Metric
    baseline, output = tmp_path / "baseline.json", tmp_path / "figures.json"
    paths = ["scan", "--baseline", str(baseline)]
    good = Metric("scan/total", 3.0, "ms", bar=1.0, opponent="cKDTree", opponent_value=4.0, tolerance=0.1)
    absolute = Metric("scan/alone", 3.0, "ms", gated=False)

    fake(modules, monkeypatch, good, absolute)
    assert run.main([*paths, "--update-baseline", "--json", str(output)]) == 0
    expected = {"value": 0.75, "unit": "ratio", "direction": "lower", "tolerance": 0.1}
    assert json.loads(baseline.read_text()) == {"scan/total": expected}
    assert [entry["name"] for entry in json.loads(output.read_text())] == ["scan/total", "scan/alone"]
    assert run.main([*paths, "--gate"]) == 0

    fake(modules, monkeypatch, Metric("scan/total", 4.0, "ms", opponent="cKDTree", opponent_value=4.0))
    capsys.readouterr()
    assert run.main([*paths, "--gate"]) == 1
    assert "REGRESSION  scan/total: 1 ratio, baseline 0.75 and at most 0.825 allowed" in capsys.readouterr().out
    assert run.main(paths) == 0, "without --gate nothing is compared"


def test_an_untimed_gate_judges_what_no_load_changes(modules, monkeypatch, tmp_path, capsys):
    run, Metric = modules[1], modules[0].Metric
    baseline = tmp_path / "baseline.json"
    slow = Metric("scan/total", 9.0, "ms", opponent="cKDTree", opponent_value=4.0)
    fake(modules, monkeypatch, replace(slow, value=4.0), Metric("scan/memory", 30.0, "bytes", tolerance=0.1))
    assert run.main(["scan", "--baseline", str(baseline), "--update-baseline"]) == 0
    for memory, code in ((32.0, 0), (34.0, 1)):
        fake(modules, monkeypatch, slow, Metric("scan/memory", memory, "bytes"))
        assert run.main(["scan", "--baseline", str(baseline), "--gate", "--untimed"]) == code
        assert run.main(["scan", "--baseline", str(baseline), "--gate"]) == 1
    fake(modules, monkeypatch, slow)
    capsys.readouterr()
    assert run.main(["scan", "--baseline", str(baseline), "--gate", "--untimed"]) == 1
    assert "REGRESSION  scan/memory: in the baseline, but not measured" in capsys.readouterr().out


def test_an_update_keeps_other_benchmarks_and_drops_figures_that_are_gone(modules):
    metrics = modules[0]
    before = {name: metrics.Expected(1.0, "MB", "lower", 0.1) for name in ("memory/x", "scan/gone", "scan/total")}
    after = metrics.updated_baseline(before, [metrics.Metric("scan/total", 2.0, "MB")], ["scan"])
    assert {name: expected.value for name, expected in after.items()} == {"memory/x": 1.0, "scan/total": 2.0}


def test_a_benchmark_that_fails_fails_the_run_and_keeps_the_baseline(modules, monkeypatch, tmp_path, capsys):
    import subprocess

    run = modules[1]

    def fail(name: str, *, quick: bool) -> list[object]:
        raise subprocess.CalledProcessError(3, ["bench"])

    monkeypatch.setattr(run, "run_benchmark", fail)
    baseline = tmp_path / "baseline.json"
    assert run.main(["scan", "--baseline", str(baseline), "--update-baseline"]) == 1
    assert "scan: failed with exit code 3" in capsys.readouterr().out
    assert not baseline.exists()


def test_unknown_names_and_quick_gates_are_refused(modules, capsys):
    for arguments, text in (
        (["nonsense"], "no benchmark nonsense"),
        (["scan", "--quick", "--gate"], "a quick run measures nothing"),
    ):
        with pytest.raises(SystemExit) as refused:
            modules[1].main(arguments)
        assert refused.value.code == 2
        assert text in capsys.readouterr().err


def test_the_committed_baseline_fits_the_benchmarks(modules):
    metrics, run = modules
    baseline = metrics.read_baseline(run.BASELINE)
    assert baseline, "benchmarks/baseline.json is committed"
    assert {name.split("/")[0] for name in baseline} <= set(run.BENCHMARKS)
    for name, expected in baseline.items():
        assert np.isfinite(expected.value) and 0 <= expected.tolerance <= 1, name
        assert expected.unit not in ("ms", "us", "s"), f"{name}: absolute times belong to one machine"
