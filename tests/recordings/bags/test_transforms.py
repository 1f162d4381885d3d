"""Chains of static transforms, against SciPy."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boxplus.recordings.bags.transforms import apart, chain


def matrix(values: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    T[:3, 3] = values[:3]
    return T


@given(seed=st.integers(0, 10_000), length=st.integers(2, 6), flips=st.lists(st.booleans(), min_size=6, max_size=6))
def test_a_chain_in_either_direction(seed: int, length: int, flips: list[bool]) -> None:
    rng = np.random.default_rng(seed)
    edges, expected = [], np.eye(4)
    for k in range(length - 1):
        values = np.concatenate((rng.normal(size=3), Rotation.random(random_state=seed + k).as_quat()))
        if flips[k]:
            edges.append((f"f{k + 1}", f"f{k}", values))
            expected = expected @ np.linalg.inv(matrix(values))
        else:
            edges.append((f"f{k}", f"f{k + 1}", values))
            expected = expected @ matrix(values)
    edges.append(("f0", "elsewhere", values))
    rng.shuffle(edges)
    found = chain(edges, "f0", f"f{length - 1}")
    assert found is not None
    np.testing.assert_allclose(found[0], expected, atol=1e-9)
    assert found[1] == [f"f{k}" for k in range(length)]


def test_unconnected_broken_and_repeated_edges() -> None:
    identity = np.array([0.0, 0, 0, 0, 0, 0, 1])
    assert chain([("a", "b", identity)], "a", "c") is None
    assert chain([], "a", "b") is None
    assert chain([("a", "b", np.zeros(7))], "a", "b") is None
    assert chain([("a", "b", identity * np.nan)], "a", "b") is None
    moved = identity + np.array([1.0, 0, 0, 0, 0, 0, 0])
    found = chain([("a", "b", identity), ("a", "b", moved)], "a", "b")
    assert found is not None and found[0][0, 3] == 1.0


def test_transforms_that_disagree_are_told_where_they_matter() -> None:
    rng = np.random.default_rng(3)
    poses = [np.concatenate((rng.normal(size=3), Rotation.random(random_state=k).as_quat())) for k in range(3)]
    values = dict(zip("abc", poses, strict=True))
    tree = [("base", name, values[name]) for name in "abc"]
    T_ab = np.linalg.inv(matrix(values["a"])) @ matrix(values["b"])
    direct = np.concatenate((T_ab[:3, 3], Rotation.from_matrix(T_ab[:3, :3]).as_quat()))
    off = direct + np.array([0.3, 0, 0, 0, 0, 0, 0])
    for edges, said in (
        (tree, False),
        ([*tree, *tree], False),
        ([*tree, ("a", "b", direct)], False),
        ([*tree, ("a", "b", direct + np.array([0.002, 0, 0, 0, 0, 0, 0]))], False),
        ([*tree, ("a", "b", off)], True),
        ([("a", "b", off), *tree], True),
        ([*tree, ("base", "b", values["a"])], True),
        ([*tree, ("b", "base", values["b"])], True),
        ([*tree, ("base", "c", values["a"])], False),  # of a frame that is not on the way
        ([*tree, ("d", "e", direct), ("d", "e", off)], False),
    ):
        found = chain(edges, "a", "b")
        assert found is not None and bool(found.disagreement) == said
    found = chain([*tree, ("a", "b", off)], "a", "b")
    assert found is not None and "0.300 m" in found.disagreement and "0.0 deg" in found.disagreement


@given(seed=st.integers(0, 10_000))
def test_a_transform_published_again_with_two_digits_says_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p, angles = rng.uniform(-1.0, 1.0, 3), rng.uniform((-3.0, -0.3, -0.3), (3.0, 0.3, 0.3))
    full, short = (
        np.concatenate([p.round(digits), Rotation.from_euler("ZYX", angles.round(digits)).as_quat()]) for digits in (9, 2)
    )
    for edges in ([("base", "lidar", full), ("base", "lidar", short)], [("base", "lidar", short), ("base", "lidar", full)]):
        found = chain(edges, "base", "lidar")
        assert found is not None and not found.disagreement
    found = chain([("base", "lidar", full), ("base", "lidar", short + np.array([0.02, 0, 0, 0, 0, 0, 0]))], "base", "lidar")
    assert found is not None and found.disagreement


@given(st.floats(0.0, 3.14), st.integers(0, 1000))
def test_how_far_transforms_are_apart(angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, between = np.eye(4), np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)
    axis, between[:3, 3] = rng.normal(size=3), rng.normal(size=3)
    between[:3, :3] = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    np.testing.assert_allclose(apart(T, T @ between), (angle, np.linalg.norm(between[:3, 3])), atol=1e-6)
