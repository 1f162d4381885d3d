"""Settings by name: what does not fit is refused in the form of every other input, with what was meant."""

from __future__ import annotations

import pytest

import boxplus as bp
from boxplus._settings import Settings, suggestion
from boxplus.errors import InputError
from boxplus.recordings.options import RecordingOptions
from boxplus.runs.lidar_inertial.config import RunConfig
from boxplus.runs.settings_file import load_settings

CONFIGS = [value for name in dir(bp) if isinstance(value := getattr(bp, name), type) and issubclass(value, Settings)]


def test_all_public_settings_are_of_one_kind():
    names = {kind.__name__ for kind in CONFIGS}
    assert {name for name in dir(bp) if name.endswith(("Config", "Options"))} <= names


@pytest.mark.parametrize("kind", CONFIGS)
def test_an_unknown_setting_is_refused_with_those_there_are(kind):
    known = next(iter(kind.model_fields))
    with pytest.raises(bp.InputError, match=rf"a setting of {kind.__name__} – got '{known}z' – did you mean .*{known}"):
        kind(**{f"{known}z": 1})
    with pytest.raises(bp.InputError, match=rf"expected settings of {kind.__name__} by name – got {{}} – write e.g."):
        kind({})


@pytest.mark.parametrize("kind", CONFIGS)
def test_a_value_of_another_type_is_refused_with_what_the_setting_means(kind):
    for name, field in kind.model_fields.items():
        with pytest.raises(bp.InputError, match=rf"value for {name}\S* of {kind.__name__} .*– got <object .*– correct"):
            kind(**{name: object()})
        assert field.description


def test_settings_in_settings_are_named_with_their_place():
    with pytest.raises(bp.InputError, match=r"a setting of SolverOptions – got 'methods' – did you mean method\?"):
        bp.BundleAdjustmentConfig(solver={"methods": "dogleg"})
    with pytest.raises(bp.InputError, match=r"for solver.method of BundleAdjustmentConfig \(how a step is chosen\)"):
        bp.BundleAdjustmentConfig(solver={"method": "newton"})


def test_settings_in_one_of_several_settings_are_named_with_their_place():
    with pytest.raises(InputError, match=r"^expected a setting of OtherLidar – got 'time_offset' – did you mean time_offset_s\?"):
        RecordingOptions(lidar_topic="/front", other_lidars=({"topic": "/rear", "time_offset": 0.1},))
    with pytest.raises(
        InputError, match=r"^expected other_lidars.0.topic of RecordingOptions \(topic of its clouds\).* – got nothing"
    ):
        RecordingOptions(lidar_topic="/front", other_lidars=({"time_offset_s": 0.1},))


def test_settings_stay_as_they_are_made():
    config = bp.BundleAdjustmentConfig()
    with pytest.raises(bp.InputError, match="as it was made – got another sigma_px"):
        config.sigma_px = 3.0
    assert config.model_copy(update={"sigma_px": 3.0}).sigma_px == 3.0


def test_other_values_in_a_copy_are_looked_at_like_any():
    config = bp.BundleAdjustmentConfig(sigma_px=2.0)
    with pytest.raises(bp.InputError, match=r"a setting of BundleAdjustmentConfig – got 'sigma' – did you mean sigma_px\?"):
        config.model_copy(update={"sigma": 3.0})
    with pytest.raises(bp.InputError, match=r"a valid value for sigma_px .*– got -3.0"):
        config.model_copy(update={"sigma_px": -3.0})
    copied = config.model_copy(update={"solver": {"max_iterations": 7}})
    assert copied.solver == bp.SolverOptions(max_iterations=7) and copied.sigma_px == 2.0
    assert copied.model_fields_set == {"sigma_px", "solver"} and config.solver == bp.BundleAdjustmentConfig().solver
    assert config.model_copy(deep=True) == config.model_copy() == config


def test_all_that_is_wrong_is_said_at_once():
    with pytest.raises(bp.InputError) as caught:
        bp.BundleAdjustmentConfig(sigma_px=-1.0, solver={"method": "newton", "max_iterations": -2}, sigma=3.0)
    expected, got = caught.value.expected.split("; "), caught.value.got.split("; ")
    assert [text.split(" of ")[0].removeprefix("a valid value for ") for text in expected] == [
        "sigma_px",
        "solver.method",
        "solver.max_iterations",
        "a setting",
    ]
    assert [text.split(" ")[0] for text in got] == ["-1.0", "'newton'", "-2", "'sigma'"]
    assert caught.value.advice.count("correct the value") == 1 and "did you mean sigma_px?" in caught.value.advice
    with pytest.raises(bp.InputError, match=r"for solver.max_iterations \(.*; a valid value for solver.time_limit_s \("):
        load_settings(_Sections, settings=["solver.max_iterations=-1", "solver.time_limit_s=0"])


def test_of_errors_of_several_kinds_none_is_lost():
    with pytest.raises(bp.InputError) as caught:
        bp.RecordingOptions(other_lidars=["{topic: ["], min_range=-1.0)
    assert caught.value.expected.startswith("another LiDAR as a topic or as {topic: …") and "min_range" in caught.value.expected
    assert caught.value.got.startswith("'{topic: ['; -1.0") and "see docs/several_lidars.md" in caught.value.advice


class _Sections(Settings):
    solver: bp.SolverOptions = bp.SolverOptions()


def test_a_name_that_is_part_of_others_brings_them_all():
    assert suggestion("voxel", ["odometry.scan_voxel", "map.voxel", "odometry.threads"], "setting").startswith(
        "did you mean map.voxel or odometry.scan_voxel? the settings are: "
    )
    with pytest.raises(bp.InputError, match=r"got 'sigma' – did you mean .*map_sigma"):
        load_settings(RunConfig, settings=["sigma=0.1"])
    with pytest.raises(bp.InputError, match=r"got 'voxel' – did you mean map.voxel or odometry.scan_voxel\?"):
        load_settings(RunConfig, settings=["voxel=0.5"])
    assert load_settings(RunConfig, settings=["map.voxel=0.5"]).map.voxel == 0.5
    with pytest.raises(bp.InputError, match="got 'voxel' – did you mean scan_voxel"):
        bp.LioConfig(voxel=0.5)
