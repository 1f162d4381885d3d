"""What single comparisons leave open, the watch puts together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from boxplus.sensors.scan import Scan
from boxplus.systems.lidar_inertial_agreement import watch
from boxplus.systems.lidar_inertial_agreement.agreement import Agreement, compare_sensors
from boxplus.systems.lidar_inertial_agreement.hypotheses import contradictions
from boxplus.systems.lidar_inertial_agreement.translation import SLOPE
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data, handheld


@pytest.mark.parametrize(("slope", "named"), [(0.88, True), (1.12, True), (0.96, False)])
def test_lengths_are_named_by_several_comparisons(monkeypatch: pytest.MonkeyPatch, slope: float, named: bool) -> None:
    simulation = handheld(4)
    T = simulation.T_imu_lidar
    scans, imu = data(simulation)
    seen = compare_sensors(scans[:25], imu, CONFIG, T_declared=T)
    assert seen.translation is not None
    covariance = seen.translation.covariance.copy()
    covariance[SLOPE, SLOPE] = 0.045**2
    walking = replace(seen, translation=replace(seen.translation, slope=slope, covariance=covariance, explained=0.9))
    assert contradictions(walking, T) == []
    compared = []

    def compare(scans: Sequence[Scan], *_: Any, **__: Any) -> Agreement:
        compared.append(scans[-1].end_ns)
        time_ns = np.linspace(scans[0].start_ns, scans[-1].end_ns, len(walking.path)).astype(np.int64)
        return replace(walking, path=replace(walking.path, time_ns=time_ns))

    monkeypatch.setattr(watch, "compare_sensors", compare)
    following = watch.Watch(CONFIG, T)
    still = np.zeros(3), np.zeros(3)
    said = [following.add(scans[0].shifted(k * 100_000_000), imu, T, still) for k in range(220)]
    following.finish()
    assert len(compared) >= 3
    assert [text for text in said if text is not None and "the points are not in metres" in text] == [
        text for text in said if text is not None
    ]
    assert (following.contradiction is not None) == named == any(said)
