"""Options that leave nothing to read are refused where they are given."""

import pytest

from boxplus.errors import InputError
from boxplus.recordings import RecordingOptions
from boxplus.runs.lidar_inertial.config import load_run_config


@pytest.mark.parametrize(("low", "high"), [(5.0, 5.0), (50.0, 10.0)])
def test_a_range_without_points_is_refused(low: float, high: float) -> None:
    with pytest.raises(InputError, match=r"--min-range\) below max_range"):
        RecordingOptions(min_range=low, max_range=high)
    with pytest.raises(InputError, match="between which no point lies"):
        load_run_config(None, (f"recording.min_range={low}", f"recording.max_range={high}"))


def test_the_range_of_another_lidar_counts_with_what_it_takes_from_the_first() -> None:
    other = {"topic": "/rear", "max_range": 2.0}
    assert RecordingOptions(lidar_topic="/front", other_lidars=(other,), min_range=1.0)
    with pytest.raises(InputError, match="of /rear"):
        RecordingOptions(lidar_topic="/front", other_lidars=(other,), min_range=3.0)
