"""The joint covariance of state, map and points, against the same equations in words, with motions about the world's origin.

What moves the whole world is one twist there, wherever the IMU is: no lever arm has to be carried from scan to scan.
"""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.nav_state import NavState
from boxplus.filtering.pose_covariance.correction import Correction
from boxplus.filtering.pose_covariance.map_datum import MapDatum
from boxplus.manifolds import so3

STATE, MAP, THIRD, ALL = slice(0, 18), slice(18, 24), slice(24, 30), 30
POSE, V, G = slice(0, 6), slice(6, 9), slice(15, 18)
SHARED = 1.5


def _state(random: np.random.Generator, before: NavState | None = None) -> NavState:
    zero, turn, shift = np.zeros(3), 0.5 * random.normal(size=3), random.normal(size=3)
    R, p = (np.eye(3), 5.0 * random.normal(size=3)) if before is None else (before.R_world_imu, before.p_world_imu)
    down = np.array([0.0, 0.3, -9.8])
    return NavState(R @ so3.exp(turn), p + shift, 3.0 * random.normal(size=3), zero, zero, down, np.eye(3), zero)


def _covariance(random: np.random.Generator, size: int, scale: float) -> np.ndarray:
    root = random.normal(size=(size, size))
    return scale * (root @ root.T / size + 0.1 * np.eye(size))


def _about_origin(x: NavState, size: int = 6) -> np.ndarray:
    """From [θ about the IMU's axes, p, ...] to the twist about the world's origin, the rest as it is."""
    M = np.eye(size)
    M[:3, :3] = x.R_world_imu
    M[3:6, :3] = so3.hat(x.p_world_imu) @ x.R_world_imu
    return M


class _Equations:
    """[e, d, u or l] (30, 30) against the first pose, or the marked one."""

    def __init__(self, x: NavState, cov: np.ndarray) -> None:
        self.C = np.zeros((ALL, ALL))
        self.C[STATE, STATE] = _about_origin(x, 18) @ cov[STATE, STATE] @ _about_origin(x, 18).T
        self.laid = False

    def common(self, x: NavState) -> np.ndarray:
        B = np.zeros((ALL, 6))
        B[POSE] = B[MAP] = np.eye(6)
        B[V, :3], B[G, :3] = -so3.hat(x.v_world_imu), -so3.hat(x.gravity_world)
        if self.laid:
            B[THIRD] = np.eye(6)
        return B

    def mark(self, x: NavState) -> None:
        step = np.eye(ALL)
        step[:, POSE] -= self.common(x)
        self.C = step @ self.C @ step.T

    def insert(self, points: int) -> None:
        step = np.eye(ALL)
        step[THIRD] = 0.0
        step[THIRD, POSE] = np.eye(6)
        if not self.laid:
            step[THIRD, THIRD] = -np.eye(6)
        self.C, self.laid = step @ self.C @ step.T, points > 0

    def go_on(self, before: NavState, x: NavState, Phi: np.ndarray, Q: np.ndarray, found: Correction | None) -> None:
        to, state = _about_origin(x), _about_origin(x, 18)
        if found is not None and self.laid and found.renewed is not None:
            F, step = to @ found.renewed @ np.linalg.inv(to), np.eye(ALL)
            step[MAP, MAP], step[MAP, THIRD] = np.eye(6) - F, F
            values, vectors = np.linalg.eigh(0.5 * SHARED * (found.renewed @ found.alone + found.alone @ found.renewed.T))
            self.C = step @ self.C @ step.T
            self.C[MAP, MAP] += to @ (vectors * np.maximum(values, 0.0)) @ vectors.T @ to.T
            self.laid = False
        Phi, Q, step = state @ Phi @ np.linalg.inv(_about_origin(before, 18)), state @ Q @ state.T, np.eye(ALL)
        step[STATE, STATE] = Phi
        share = 0.0 if found is None else found.deskewed
        noise = np.zeros((ALL, ALL))
        noise[STATE, STATE] = Q
        if not self.laid:
            step[THIRD] = 0.0
            step[THIRD, STATE] = 0.5 * share * (Phi - np.eye(18))[POSE]  # of what is rigid nothing is left
            noise[THIRD, THIRD] = share**2 / 3.0 * Q[POSE, POSE]
            noise[THIRD, STATE], noise[STATE, THIRD] = 0.5 * share * Q[POSE], 0.5 * share * Q[:, POSE]
        self.C = step @ self.C @ step.T + noise
        if found is not None:
            G = state @ found.gain @ np.linalg.inv(to)
            step = np.eye(ALL)
            step[STATE, POSE] -= G
            step[STATE, MAP] += G
            step[STATE, THIRD] += G
            self.C = step @ self.C @ step.T
            self.C[STATE, STATE] += SHARED * state @ found.noise @ state.T

    def pose(self, x: NavState) -> np.ndarray:
        back = np.linalg.inv(_about_origin(x))
        return back @ self.C[POSE, POSE] @ back.T


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_against_the_same_equations_about_the_origin(seed: int) -> None:
    """On a way with turns: scans that are not taken, motions nobody knows, scans that store nothing, marks, and excesses."""
    random = np.random.default_rng(seed)
    x, cov = _state(random), _covariance(random, 24, 1e-3)
    datum, first, marked = MapDatum(x.pack(), cov, SHARED, 18), _Equations(x, cov), _Equations(x, cov)
    marked.mark(x)
    known: list[_Equations] = [first, marked]
    stored: int | None = 100
    found: Correction | None = None
    for scan in range(14):
        grown = cov.copy()
        if stored is not None:
            datum.insert(stored)
            for each in known:
                each.insert(stored)
            datum.creep(grown, x.pack())
            alone = np.zeros((6, 6)) if found is None else found.alone_by_weights
            np.testing.assert_allclose((grown - cov)[POSE, POSE], SHARED * datum.new_share * alone, rtol=1e-9, atol=1e-15)
        before, cov, x = x, grown, _state(random, x)
        is_known, is_taken = random.random() < 0.7, scan == 0 or random.random() < 0.7
        if is_known:
            Phi = np.eye(18)
            Phi[:9] += 0.1 * random.normal(size=(9, 18))
        else:
            Phi = np.eye(18)
            Phi[POSE, POSE] = np.linalg.inv(_about_origin(x)) @ _about_origin(before)
        Q, prior = _covariance(random, 18, 1e-5), np.zeros((24, 24))
        prior[STATE, STATE] = Phi @ cov[STATE, STATE] @ Phi.T + Q
        prior[18:, 18:] = 1e-4 * np.eye(6)
        cov, found = prior, None
        if is_taken:
            A = np.linalg.inv(_covariance(random, 6, 1e-4))
            information = np.linalg.inv(prior)
            information[POSE, POSE] += A
            cov = np.linalg.inv(information)
            gain, alone = cov[STATE, POSE] @ A, 0.3 * np.linalg.inv(A)
            renewed = np.eye(6) if scan == 0 else np.linalg.solve(A + 1e3 * _covariance(random, 6, 1.0), 0.3 * A)
            share = float(random.choice([0.1, 1.0]))
            found = Correction(gain, gain @ alone @ gain.T, alone, np.linalg.inv(A), 5.0, np.zeros(3), share, renewed)
        datum.follow(x.pack(), prior, cov, found, Phi if is_known else None)
        for each in known:
            each.go_on(before, x, Phi, Q, found)
        if random.random() < 0.3:
            excess = _covariance(random, 6, 1e-4)
            datum.widen(excess, x.pack())
            for each in known:
                spread = each.common(x) @ _about_origin(x)
                each.C = each.C + spread @ excess @ spread.T
        if random.random() < 0.3:
            datum.mark()
            marked.mark(x)
        for said, each in ((datum.pose_covariance(x.pack()), first), (datum.covariance_since_mark(x.pack()), marked)):
            np.testing.assert_allclose(said, each.pose(x), rtol=1e-7, atol=1e-9 * max(1.0, np.abs(each.pose(x)).max()))
        stored = int(random.choice([0, 50])) if is_taken or random.random() < 0.3 else None  # a new map, where it is lost
