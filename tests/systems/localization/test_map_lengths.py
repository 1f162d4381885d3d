"""When scans are compared, what they add up to over the way, and from where on lengths are a doubt."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.maps.local_maps.config import LocalMapRegistrationConfig
from boxplus.maps.local_maps.registration import Surface, refine
from boxplus.maps.tiles.voxel_thinning import first_per_voxel
from boxplus.simulation.worlds.world import World, box
from boxplus.simulation.worlds.worlds import hall
from boxplus.systems.localization.map_lengths import MapLengths
from boxplus.systems.slam.lengths import Lengths, compare_lengths

CONFIG = LocalMapRegistrationConfig()
ROOM = World(
    [
        box((0.0, 0.0, 1.4), (8.0, 5.0, 2.8)),
        box((2.5, 1.8, 0.4), (1.2, 0.8, 0.8), yaw=0.3),
        box((-2.5, -1.6, 0.9), (0.8, 0.5, 1.8)),
    ]
)


def seen(count: int, metres: float, log_ratio: float, sigma: float) -> MapLengths:
    """After so many scans that say the same, each so far from the one before."""
    lengths = MapLengths()
    for _ in range(count):
        lengths.walk(metres)
        lengths.see(Lengths(log_ratio, sigma))
    return lengths


def test_a_doubt_takes_five_scans_and_six_in_a_thousand() -> None:
    assert MapLengths().doubt is None and MapLengths().log_ratio == (0.0, math.inf)
    assert seen(4, 5.0, 0.02, 0.001).doubt is None and seen(5, 5.0, 0.02, 0.001).doubt is not None
    for sign in (1.0, -1.0):
        assert seen(5, 5.0, sign * 0.0059, 0.0001).doubt is None and seen(5, 5.0, sign * 0.0061, 0.0001).doubt is not None
    text = seen(5, 5.0, math.log(1.02), 0.001).doubt
    assert text is not None and text.startswith("lengths in the map are 1.0200 times those that are seen (± 0.0005)")


def test_a_doubt_takes_three_and_a_half_sigma_of_the_logarithm() -> None:
    assert seen(5, 0.0, 0.034, 0.01).doubt is None and seen(5, 0.0, 0.036, 0.01).doubt is not None
    # Of the ratio itself, whose distance from 1 ends at 1 towards zero, that would be another test.
    assert seen(5, 0.0, -0.0355, 0.01).doubt is not None and seen(5, 0.0, -5.0, 56.0).doubt is None


def test_scans_within_five_metres_count_as_one() -> None:
    assert math.isclose(seen(50, 0.1, 0.0, 0.01).log_ratio[1], 0.01 / math.sqrt(1.0 + 4.9 / 5.0))
    assert math.isclose(seen(50, 0.0, 0.0, 0.01).log_ratio[1], 0.01)
    assert math.isclose(seen(5, 20.0, 0.0, 0.01).log_ratio[1], 0.01 / math.sqrt(5.0))  # no more than there are scans


def test_a_way_without_scans_adds_one_place() -> None:
    """Beyond the map, lost or searching: that once was added in full, and a hundred scans at one spot were a doubt."""
    lengths = seen(100, 0.0, 0.007, 0.008)
    lengths.walk(500.0)
    lengths.see(Lengths(0.007, 0.008))
    assert math.isclose(lengths.log_ratio[1], 0.008 / math.sqrt(2.0)) and lengths.doubt is None
    lengths.walk(3.0)
    lengths.begin()
    lengths.see(Lengths(0.007, 0.008))
    assert math.isclose(lengths.log_ratio[1], 0.008 / math.sqrt(2.0))  # what was gone while searching adds nothing


def test_a_scan_is_compared_at_once_and_then_every_metre() -> None:
    lengths = MapLengths()
    assert lengths.is_due
    lengths.see(None)  # that told nothing, and is not asked again at the next one
    assert not lengths.is_due and lengths.log_ratio == (0.0, math.inf)
    lengths.walk(0.9)
    assert not lengths.is_due
    lengths.walk(0.2)
    assert lengths.is_due
    lengths.see(Lengths(0.0, 0.01))
    assert not lengths.is_due
    lengths.begin()
    assert lengths.is_due


def spinning(
    world: World, T: NDArray[np.float64], random: np.random.Generator, ratio: float, offset: float
) -> NDArray[np.float32]:
    """(N, 3) what a LiDAR of 32 rings sees from a pose, all ranges times a factor and off by an offset [m]."""
    up, around = np.meshgrid(np.deg2rad(np.linspace(-25, 25, 32)), np.linspace(-np.pi, np.pi, 360, endpoint=False))
    rays = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=-1).reshape(-1, 3)
    R = (se3.act(T, np.eye(3)) - T[4:]).T
    ranges, _ = world.cast(rays, R[None], T[None, 4:], 40.0)
    hit = np.isfinite(ranges)
    seen_as = ratio * ranges[hit] + offset + random.normal(0.0, 0.01, np.count_nonzero(hit))
    return np.asarray(rays[hit] * seen_as[:, None], dtype=np.float32)


def lengths_along(
    world: World, route: NDArray[np.float64], passes: int, ratio: float = 1.0, offset: float = 0.0
) -> tuple[MapLengths, float | None]:
    """What scans to and fro say in the map of an earlier way along the same route (K, 2); m of way until the first doubt."""
    random = np.random.default_rng(0)

    def stand(x: float, y: float) -> NDArray[np.float64]:
        yaw = random.uniform(-3.0, 3.0)
        return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2), x, y, 1.2])

    poses = [stand(x, y) for x, y in route]
    points = np.concatenate([se3.act(T, spinning(world, T, random, 1.0, 0.0).astype(np.float64)) for T in poses])
    points = points.astype(np.float32)
    target, lengths, way, first = Surface.of(points[first_per_voxel(points, 0.25)]), MapLengths(), 0.0, None
    step = float(np.linalg.norm(route[1] - route[0]))
    for x, y in np.concatenate([route[:: (-1) ** k] for k in range(passes)]):
        T = stand(x, y + random.uniform(-0.2, 0.2))
        scan = spinning(world, T, random, ratio, offset)
        scan = scan[first_per_voxel(scan, 0.5)]
        scan = np.ascontiguousarray(scan[:: max(math.ceil(len(scan) / 1000), 1)])
        found = refine(scan, target, se3.compose(T, se3.exp(random.normal(0.0, 0.003, 6))), CONFIG, distance=0.6, steps=2)
        assert found is not None
        lengths.walk(step)
        lengths.see(compare_lengths(scan, target, found.T_target_source, CONFIG, distance=0.6))
        way += step
        first = way if first is None and lengths.doubt else first
    return lengths, first


def test_an_offset_of_ranges_is_no_other_unit() -> None:
    """Of a few centimetres, as data sheets allow: in a small room that was once a per cent, and a map 'not in metres'."""
    route = np.column_stack([np.arange(-2.0, 2.01, 0.5), np.zeros(9)])
    for offset in (0.025, -0.025):
        lengths, first = lengths_along(ROOM, route, 8, offset=offset)
        assert first is None and 0.002 < lengths.log_ratio[1] < 0.05
    # Nor is a hundredth told from one in there: docs/limitations.md.
    assert lengths_along(ROOM, route, 8, ratio=1.01)[1] is None


def test_a_hall_tells_a_factor_from_an_offset() -> None:
    route = np.column_stack([np.arange(-20.0, 20.1, 2.0), np.full(21, -3.0)])
    lengths, first = lengths_along(hall(seed=0), route, 2, ratio=1.01)
    assert first is not None and first <= 12.0
    assert lengths.log_ratio[0] == pytest.approx(-np.log(1.01), abs=0.001)
    lengths, first = lengths_along(hall(seed=0), route, 2, offset=0.03)
    assert first is None and lengths.log_ratio[0] == pytest.approx(0.0, abs=0.001)
