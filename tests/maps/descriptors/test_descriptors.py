"""Density images, their features and the index against brute force and made-up places."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.maps.descriptors.config import DescriptorConfig
from boxplus.maps.descriptors.density_image import density_image
from boxplus.maps.descriptors.features import Features, describe, match_features
from boxplus.maps.descriptors.place_index import PlaceIndex
from boxplus.maps.descriptors.rigid_2d import find_rigid_motion
from boxplus.maps.descriptors.scan_context import SECTORS, ScanContextIndex, scan_context
from tests.maps.descriptors.places import visited, walls

_NO_OPENCV = r"OpenCV, which describes density images – got it is not installed – .*pip install .*opencv"


def bits_of(random: np.random.Generator, count: int) -> np.ndarray:
    return random.integers(0, 2**64, (count, 4), dtype=np.uint64)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31), st.integers(1, 400), st.floats(0.2, 2.0))
def test_density_counts_the_points_of_every_cell(seed: int, count: int, cell: float) -> None:
    points = np.random.default_rng(seed).normal(0.0, 3.0, (count, 3))
    image = density_image(points, cell)
    counts: dict[tuple[int, int], int] = {}
    for x, y in np.floor(points[:, :2] / cell).astype(int).tolist():
        counts[x, y] = counts.get((x, y), 0) + 1
    full = max(np.quantile(list(counts.values()), 0.99), 1.0)
    assert np.count_nonzero(image.pixels) <= len(counts)
    for (x, y), n in counts.items():
        share = min(n / full, 1.0)
        u, v = np.rint((np.array([x, y]) * cell - image.origin) / cell).astype(int)
        assert image.pixels[v, u] == (np.rint(255.0 * share) if share >= 0.05 else 0)
        np.testing.assert_allclose(image.to_map(np.array([[u, v]], float))[0], (np.array([x, y]) + 0.5) * cell, atol=1e-9)


def test_what_has_no_density_is_refused() -> None:
    with pytest.raises(InputError, match="at least one, finite"):
        density_image(np.zeros((0, 3)), 0.5)
    with pytest.raises(InputError, match=r"4096 cells at most – got 20001 × 1 – leave out far points"):
        density_image([[0.0, 0.0, 0.0], [10_000.0, 0.0, 0.0]], 0.5)


def test_a_missing_opencv_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(InputError, match=_NO_OPENCV):
        describe(np.zeros((5, 3)))


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31), st.integers(0, 40), st.integers(0, 40), st.integers(0, 256))
def test_matches_are_mutual_nearest_neighbours(seed: int, n: int, m: int, limit: int) -> None:
    random = np.random.default_rng(seed)
    # Few different bits, so that distances tie.
    a, b = (Features(np.zeros((k, 2)), bits_of(random, k) & np.uint64(0x0101)) for k in (n, m))
    distance = np.array([[sum(bin(int(w)).count("1") for w in p ^ q) for q in b.bits] for p in a.bits]).reshape(n, m)
    expected = []
    for i in range(n if m else 0):
        j = int(np.argmin(distance[i]))
        if distance[i, j] <= limit and int(np.argmin(distance[:, j])) == i:
            expected.append([i, j])
    np.testing.assert_array_equal(match_features(a, b, limit), np.array(expected, dtype=np.int64).reshape(-1, 2))


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31), st.floats(-3.1, 3.1), st.integers(8, 80), st.floats(0.0, 0.6))
def test_the_motion_of_most_matches_is_found(seed: int, yaw: float, count: int, false_share: float) -> None:
    random = np.random.default_rng(seed)
    p, t = random.uniform(-40.0, 40.0, (count, 2)), random.uniform(-20.0, 20.0, 2)
    c, s = np.cos(yaw), np.sin(yaw)
    q = p @ np.array([[c, s], [-s, c]]) + t + random.normal(0.0, 0.1, p.shape)
    false = int(false_share * count)
    q[:false] = random.uniform(-60.0, 60.0, (false, 2))
    motion = find_rigid_motion(p, q, 1.5, seed=1)
    assert motion is not None
    assert motion.inliers[false:].all()
    turn = (motion.yaw - yaw + np.pi) % (2 * np.pi) - np.pi
    assert abs(turn) < 0.06 and np.linalg.norm(motion.t - t) < 1.5
    again = find_rigid_motion(p, q, 1.5, seed=1)
    assert again is not None and again.yaw == motion.yaw


def test_no_motion_without_two_matches_that_fit() -> None:
    assert find_rigid_motion(np.zeros((1, 2)), np.zeros((1, 2)), 1.0) is None
    assert find_rigid_motion(np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([[0.0, 0.0], [30.0, 0.0]]), 1.0) is None


def test_places_are_found_under_any_heading_and_others_are_not() -> None:
    """Visits turned, shifted and cut off; and visits of places that are not in the index, which nothing may look like."""
    index = PlaceIndex()
    places = [walls(seed) for seed in range(25)]
    for place in places:
        index.add(describe(place))
    found = 0
    for k in range(0, 25, 3):
        points, yaw, t = visited(places[k], seed=100 + k)
        candidates = index.candidates(describe(points))
        if candidates and candidates[0].place == k:
            found += 1
            turn = (candidates[0].motion.yaw - yaw + np.pi) % (2 * np.pi) - np.pi
            assert abs(turn) < 0.05 and np.linalg.norm(candidates[0].motion.t - t) < 1.0
            assert len(candidates[0].seen_at) == candidates[0].inliers
    assert found >= 8
    strangers = [index.candidates(describe(visited(walls(500 + k), seed=k)[0])) for k in range(6)]
    assert max([c.inliers for found in strangers for c in found], default=0) < 10


def test_votes_are_brute_force_where_bits_agree(random_seed: int = 5) -> None:
    """A feature that is in a place votes for it once, however often; growing tables forget nothing; `before` is kept."""
    random = np.random.default_rng(random_seed)
    index, config = PlaceIndex(), DescriptorConfig()
    places = [
        Features(random.uniform(-40.0, 40.0, (90, 2)), bits_of(random, 90)) for _ in range(120)
    ]  # more than there is room for
    for place in places:
        index.add(place)
    assert len(index) == 120
    query = Features(np.concatenate([places[3].xy, places[70].xy[:40]]), np.concatenate([places[3].bits, places[70].bits[:40]]))
    found = index.votes(query)
    near = np.zeros(120, dtype=int)
    for k, place in enumerate(places):
        differing = np.array([[np.bitwise_count(p ^ q).sum() for q in place.bits] for p in query.bits[::10]])
        near[k] = np.count_nonzero((differing <= config.max_distance).any(axis=1))
    assert found.places.tolist() == [3, 70] and found.count.tolist() == [90, 40]
    np.testing.assert_allclose(found.weight, np.array([90, 40]) * np.log(121.0), rtol=1e-12)  # each in one of 120 places
    assert found.of_at_least(41).places.tolist() == [3] and found.of_at_least(41).weight == found.weight[:1]
    assert (near[np.setdiff1d(np.arange(120), [3, 70])] == 0).all() and near[3] and near[70]
    again = index.votes(query)  # a query leaves no trace
    assert again.count.tolist() == [90, 40] and again.weight.tolist() == found.weight.tolist()
    assert (index.votes(places[70]).places.tolist(), index.votes(places[70]).count.tolist()) == ([70], [90])
    earlier = index.votes(query, before=70)
    assert (earlier.places.tolist(), earlier.count.tolist()) == ([3], [90])
    np.testing.assert_allclose(earlier.weight, [90 * np.log(71.0)], rtol=1e-12)  # of 70 places
    assert [c.place for c in index.candidates(query)] == [3, 70]
    assert [c.place for c in index.candidates(query, before=70)] == [3]
    assert index.candidates(query, before=0) == []
    with pytest.raises(InputError, match="a place from 0 to 119"):
        index.align(query, 120)


def test_a_feature_of_many_places_weighs_less() -> None:
    """20 features that a place shares with nine others count less than 12 that it alone has."""
    random = np.random.default_rng(6)
    index, xy = PlaceIndex(), random.uniform(-40.0, 40.0, (32, 2))
    common, own = bits_of(random, 20), [bits_of(random, 12) for _ in range(10)]
    for k in range(10):
        index.add(Features(xy[12:] if k else xy, common if k else np.concatenate([own[0], common])))
    index.add(Features(xy[:12], own[1]))
    votes = index.votes(Features(np.concatenate([xy[12:], xy[:12]]), np.concatenate([common, own[1]])))
    np.testing.assert_array_equal(votes.count, [20] * 10 + [12])
    np.testing.assert_allclose(votes.weight, [20 * np.log1p(1.1)] * 10 + [12 * np.log(12.0)], rtol=1e-12)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**31), st.integers(0, SECTORS - 1))
def test_a_turn_by_whole_sectors_is_found_exactly(seed: int, sectors: int) -> None:
    random = np.random.default_rng(seed)
    # Within the sectors, so that a turn moves whole cells.
    cell = (random.integers(0, SECTORS, 300) + random.uniform(0.1, 0.9, 300)) / SECTORS * 2 * np.pi
    distance, height = random.uniform(1.0, 39.0, 300), random.uniform(0.0, 5.0, 300)
    turn = 2 * np.pi * sectors / SECTORS
    one, two = (
        scan_context(np.column_stack([distance * np.cos(a), distance * np.sin(a), height]), 40.0) for a in (cell, cell + turn)
    )
    np.testing.assert_allclose(one.ring_key, two.ring_key)
    far, yaw = one.distance(two)
    assert far == pytest.approx(0.0, abs=1e-9)
    assert abs((yaw - turn + np.pi) % (2 * np.pi) - np.pi) < 1e-9


def test_scan_contexts_find_places_from_near_by() -> None:
    index = ScanContextIndex()
    places = [walls(seed) for seed in range(80)]  # more than there is room for in the beginning
    for place in places:
        index.add(scan_context(place, 28.0))
    right = 0
    for k in range(0, 80, 8):
        points, yaw, t = visited(places[k], seed=300 + k)
        c, s = np.cos(yaw), np.sin(yaw)
        points[:, :2] += 0.9 * t @ np.array([[c, -s], [s, c]])  # within a metre of where the place was described
        place, far, turned = index.candidates(scan_context(points, 28.0))[0]
        right += place == k and far < 0.65 and abs((turned - yaw + np.pi) % (2 * np.pi) - np.pi) < 0.16
    assert right >= 9
    assert all(place < 5 for place, _, _ in index.candidates(scan_context(places[40], 28.0), before=5))
    assert index.candidates(scan_context(places[40], 28.0), before=0) == []
    with pytest.raises(InputError, match="a positive range"):
        scan_context(places[0], 0.0)
