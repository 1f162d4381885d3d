"""Which loops agree with each other: pairwise consistency and the largest set in which all pairs do (PCM).

Two loops a = (i, k) and b = (j, l) close a cycle with the odometry between i and j and between k and l,

    C = Z_a T_kl Z_b⁻¹ T_ji,

which is the identity but for noise. Errors on the right of each factor are carried to the end of the cycle,
ξ = Ad((T_kl Z_b⁻¹ T_ji)⁻¹) ξ_a + Ad((Z_b⁻¹ T_ji)⁻¹) ξ_kl − Ad(T_ji⁻¹ Z_b) ξ_b + ξ_ji, and Log C is compared with the covariance
of that sum.

Source: Mangelson, Dominic, Eustice and Vasudevan, Pairwise Consistent Measurement Set Maximization, ICRA 2018; the clique: Tomita
and Seki, An Efficient Branch-and-Bound Algorithm for Finding a Maximum Clique, DMTCS 2003.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_quantile
from boxplus.manifolds import se3
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.loop import Loop
from boxplus.systems.slam.odometry_chain import OdometryChain, mahalanobis

_EXACT = 200  # loops up to which the largest set is found exactly


def cycle_error(
    a: Loop, b: Loop, odometry: OdometryChain, odometry_scale: float = 1.0, of_places: OdometryChain | None = None
) -> float:
    """By how many standard deviations the cycle of two loops does not close; the odometry's are scaled.

    `of_places` is the odometry of the places, where these are of another session than the queries.
    """
    T_kl, S_kl = odometry.between(a.query, b.query)
    T_ji, S_ji = (odometry if of_places is None else of_places).between(b.place, a.place)
    Z_a, Z_b = a.T_place_query, b.T_place_query
    end = se3.compose(se3.inverse(Z_b), T_ji)
    A_a = se3.adjoint(se3.inverse(se3.compose(T_kl, end)))
    A_kl = se3.adjoint(se3.inverse(end))
    A_b = se3.adjoint(se3.compose(se3.inverse(T_ji), Z_b))
    S = A_a @ a.covariance @ A_a.T + A_b @ b.covariance @ A_b.T + odometry_scale**2 * (A_kl @ S_kl @ A_kl.T + S_ji)
    return mahalanobis(se3.log(se3.compose(se3.compose(Z_a, T_kl), end)), S)


def agree(a: Loop, b: Loop, odometry: OdometryChain, config: SlamConfig, of_places: OdometryChain | None = None) -> bool:
    """Whether the cycle of two loops closes as well as those of true ones do."""
    return cycle_error(a, b, odometry, config.odometry_scale, of_places) ** 2 <= chi_square_quantile(config.innovation, 6)


def largest_clique(adjacent: NDArray[np.bool_]) -> list[int]:
    """Vertices of a largest set in which all are adjacent (n, n), symmetric; the first found of several.

    Exact for up to 200 vertices; beyond, vertices are taken up by their number of neighbours.
    """
    n = len(adjacent)
    masks = [sum(1 << j for j in np.flatnonzero(adjacent[i]).tolist() if j != i) for i in range(n)]
    order = sorted(range(n), key=lambda i: (-masks[i].bit_count(), i))
    greedy: list[int] = []
    for i in order:
        if all(masks[i] >> j & 1 for j in greedy):
            greedy.append(i)
    if n > _EXACT:
        return sorted(greedy)
    best = greedy

    def extend(chosen: list[int], left: int) -> None:
        nonlocal best
        # Colours: vertices of one are not adjacent, so that a clique takes one of each at most.
        coloured: list[tuple[int, int]] = []
        uncoloured, colour = left, 0
        while uncoloured:
            colour += 1
            free = uncoloured
            while free:
                vertex = (free & -free).bit_length() - 1
                free &= ~masks[vertex] & ~(1 << vertex)
                uncoloured &= ~(1 << vertex)
                coloured.append((colour, vertex))
        for bound, vertex in reversed(coloured):
            if len(chosen) + bound <= len(best):
                return
            rest = left & masks[vertex]
            if rest:
                extend([*chosen, vertex], rest)
            elif len(chosen) + 1 > len(best):
                best = [*chosen, vertex]
            left &= ~(1 << vertex)

    extend([], (1 << n) - 1)
    return sorted(best)
