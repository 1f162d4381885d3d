"""Pose graphs that are computed: a walk through a city of square blocks, in the plane or in space, with false loop closures.

The robot goes straight for a block, then turns by a right angle or not, and stays within a box so small that it comes by every
place several times. Odometry joins successive poses; loop closures join poses that are near each other and not in time. False
ones are what a front end brings that is deceived: `random` ones alone, each between any two places, or `clustered` ones, which
claim for a stretch of the walk that it is another and agree with each other (perceptual aliasing: Sünderhauf and Protzel, IROS
2012).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from boxplus._settings import Settings
from boxplus.errors import InputError
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.manifolds import se2, se3
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3

_VISITS = 3.0  # of a place, on average; gives the size of the box
_WOBBLE = (0.03, 0.1)  # rotation [rad] and translation [m] by which poses lie off the lattice
_LEAST_GAP = 20  # steps between two poses that a loop closure may join


class GraphSimulationConfig(Settings):
    """What `simulate_pose_graph` makes."""

    dimension: Literal[2, 3] = Field(2, description="a city in the plane, or one with storeys")
    poses: int = Field(1000, ge=30, description="steps of one metre")
    loops: int | None = Field(None, ge=0, description="loop closures, true and false; as many as poses if left out")
    block: int = Field(5, ge=1, description="[m] between two crossings")
    reach_m: float = Field(1.5, gt=0, description="[m] largest distance of two poses that a true loop closure joins")
    sigma_rotation: float = Field(0.005, gt=0, description="[rad] of odometry and loop closures, about every axis")
    sigma_translation: float = Field(0.03, gt=0, description="[m] of odometry and loop closures, along every axis")
    false_share: float = Field(0.0, ge=0, le=1, description="share of the loop closures that is false")
    false_kind: Literal["random", "clustered", "mixed"] = Field(
        "random", description="each alone; stretches of `cluster` that agree; half of each"
    )
    cluster: int = Field(10, ge=2, description="false loop closures that agree with each other")
    seed: int = Field(0, ge=0)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedPoseGraph:
    """A pose graph with everything that is true about it.

    Attributes:
        graph: odometry first, then loop closures; its poses are dead reckoning. The information matrices are the true ones.
        truth: (n, 7) or (n, 3), laid out as the graph's poses; the first pose of both is the same.
        is_loop: (m,) bool, edges that are loop closures.
        is_false: (m,) bool, those that are false.
    """

    graph: PoseGraph
    truth: NDArray[np.float64]
    is_loop: NDArray[np.bool_]
    is_false: NDArray[np.bool_]


def simulate_pose_graph(config: GraphSimulationConfig | None = None, **settings: object) -> SimulatedPoseGraph:
    """Walk, measure, and invent false loop closures; the same bits for the same settings.

    Args:
        config: see `GraphSimulationConfig`; single settings may be given as keywords instead.

    Raises:
        InputError: a configuration and single settings; the walk passes no place twice, so that there is no true loop closure.

    Example:
        `simulate_pose_graph(dimension=3, poses=3000, false_share=0.3, seed=1).graph`
    """
    if config is not None and settings:
        raise InputError("a configuration or single settings", "both", "put the settings into the configuration")
    config = config if config is not None else GraphSimulationConfig.model_validate(settings)
    walk, choice, noise = (np.random.Generator(np.random.PCG64([config.seed, 300 + stream])) for stream in range(3))
    spatial = config.dimension == 3
    manifold, group = (SE3, se3) if spatial else (SE2, se2)
    rotation, translation = (3, 3) if spatial else (1, 2)
    truth = _lattice_walk(config, walk)
    wobble = walk.standard_normal((len(truth), manifold.dof)) * np.repeat(_WOBBLE, (rotation, translation))
    truth = manifold.boxplus(truth, wobble)
    count = config.loops if config.loops is not None else config.poses
    wrong = round(config.false_share * count)
    true_pairs = _near_pairs(config, truth, count - wrong, choice)
    false_pairs, claimed = _false_loops(config, truth, wrong, choice)
    chain = np.stack([np.arange(len(truth) - 1), np.arange(1, len(truth))], 1)
    edges = np.concatenate([chain, true_pairs, false_pairs])
    exact = group.compose(group.inverse(truth[edges[:, 0]]), truth[edges[:, 1]])
    exact[len(edges) - wrong :] = claimed
    sigma = np.repeat([config.sigma_rotation, config.sigma_translation], (rotation, translation))
    measured = manifold.boxplus(exact, sigma * noise.standard_normal((len(edges), manifold.dof)))
    reckoned = truth[:1].repeat(len(truth), 0)
    for k in range(len(chain)):
        reckoned[k + 1] = group.compose(reckoned[k], measured[k])
    is_loop = np.arange(len(edges)) >= len(chain)
    is_false = np.arange(len(edges)) >= len(edges) - wrong
    # Loop closures in the order in which a front end would find them.
    order = np.concatenate([np.arange(len(chain)), len(chain) + np.argsort(edges[len(chain) :].max(axis=1), kind="stable")])
    graph = PoseGraph(
        config.dimension,
        np.arange(len(truth)),
        reckoned,
        edges[order],
        measured[order],
        np.tile(np.diag(sigma**-2.0), (len(edges), 1, 1)),
        np.zeros(0, dtype=np.int64),
        source=f"simulated graph with seed {config.seed}",
    )
    return SimulatedPoseGraph(graph, truth, is_loop, is_false[order])


def without_false_loops(simulated: SimulatedPoseGraph) -> PoseGraph:
    """The same graph as a front end that is never deceived would have made it."""
    graph, kept = simulated.graph, ~simulated.is_false
    return replace(graph, edges=graph.edges[kept], measurements=graph.measurements[kept], information=graph.information[kept])


def _lattice_walk(config: GraphSimulationConfig, random: np.random.Generator) -> NDArray[np.float64]:
    """(n, 7) or (n, 3) poses of a walk of unit steps along the streets, the x axis ahead."""
    d, n, b = config.dimension, config.poses, config.block
    # Streets hold d b places for every crossing.
    crossings = max((n / (_VISITS * d * b)) ** (1.0 / d), 2.0)
    side = b * round(crossings)
    axes = np.eye(3)  # columns: ahead, left, up
    p = np.zeros(3)
    poses = np.zeros((n, 7 if d == 3 else 3))
    for k in range(n):
        if d == 3:
            poses[k] = np.concatenate([_quaternion_of(axes), p])
        else:
            poses[k] = [np.arctan2(axes[1, 0], axes[0, 0]), p[0], p[1]]
        if k % b == 0:
            ways = [axes[:, 0], axes[:, 1], -axes[:, 1]] + ([axes[:, 2], -axes[:, 2]] if d == 3 else [])
            inside = [way for way in ways if ((p + b * way >= 0.0) & (p + b * way <= side)).all()]
            ahead = inside[random.integers(len(inside))] if inside else -axes[:, 0]
            axes = _turned(axes, ahead)
        p = p + axes[:, 0]
    return poses


def _turned(axes: NDArray[np.float64], ahead: NDArray[np.float64]) -> NDArray[np.float64]:
    """The body's axes after a turn about one of them that makes `ahead` the first."""
    if np.array_equal(ahead, axes[:, 0]):
        return axes
    if abs(ahead @ axes[:, 2]) > 0.5:  # pitch
        return np.stack([ahead, axes[:, 1], np.cross(ahead, axes[:, 1])], 1)
    return np.stack([ahead, np.cross(axes[:, 2], ahead), axes[:, 2]], 1)


def _quaternion_of(R: NDArray[np.float64]) -> NDArray[np.float64]:
    from boxplus.manifolds import quaternion

    return np.asarray(quaternion.from_matrix(R[None])[0])


def _near_pairs(
    config: GraphSimulationConfig, truth: NDArray[np.float64], count: int, random: np.random.Generator
) -> NDArray[np.int64]:
    """(count, 2) different pairs of poses within reach of each other, drawn at random."""
    from scipy.spatial import cKDTree

    positions = truth[:, 4:] if config.dimension == 3 else truth[:, 1:]
    pairs = cKDTree(positions).query_pairs(config.reach_m, output_type="ndarray").astype(np.int64)
    pairs = np.sort(pairs[np.abs(pairs[:, 1] - pairs[:, 0]) > _LEAST_GAP], axis=1)
    if len(pairs) < count:
        raise InputError(
            f"a walk with {count} true loop closures",
            f"one with {len(pairs)} pairs of poses within {config.reach_m} m",
            "ask for fewer loops, more poses or a longer reach",
        )
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    return np.asarray(pairs[random.permutation(len(pairs))[:count]])


def _false_loops(
    config: GraphSimulationConfig, truth: NDArray[np.float64], count: int, random: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(count, 2) pairs of poses and the relative poses that are claimed of them, without noise."""
    manifold, group = (SE3, se3) if config.dimension == 3 else (SE2, se2)
    n = len(truth)
    pairs: list[NDArray[np.int64]] = []
    claimed: list[NDArray[np.float64]] = []
    alone = {"random": count, "clustered": 0, "mixed": count // 2}[config.false_kind]
    while len(pairs) < count:
        length = 1 if len(pairs) < alone else min(config.cluster, count - len(pairs), n - _LEAST_GAP)
        i, j = np.sort(random.integers(0, n - length + 1, 2))
        if j - i <= _LEAST_GAP + length:
            continue
        # What the front end takes the two places for: near each other, in any direction.
        Z = manifold.boxplus(manifold.identity()[None], _near(config, random)[None])
        moved = group.compose(group.compose(truth[i : i + 1], Z), group.inverse(truth[j : j + 1]))
        stretch = np.arange(length)
        there = group.compose(moved.repeat(length, 0), truth[j + stretch])
        claimed += list(group.compose(group.inverse(truth[i + stretch]), there))
        pairs += list(np.stack([i + stretch, j + stretch], 1))
    size = truth.shape[1]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2), np.array(claimed).reshape(-1, size)


def _near(config: GraphSimulationConfig, random: np.random.Generator) -> NDArray[np.float64]:
    """A tangent of a relative pose as true loop closures have it: within reach, turned at will about the vertical."""
    ahead = random.uniform(-config.reach_m, config.reach_m, 2)
    turn = 0.5 * np.pi * random.integers(-1, 3) + 0.1 * random.standard_normal()
    return np.array([turn, *ahead]) if config.dimension == 2 else np.array([0.0, 0.0, turn, *ahead, 0.0])
