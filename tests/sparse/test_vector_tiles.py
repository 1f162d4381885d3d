"""Register tiles against NumPy, for every number of rows and a range of depths; nothing outside a tile may change."""

from collections.abc import Callable

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.sparse import vector_tiles as tiles

U = np.uint64
COLUMNS = (6, 3, 1)


def shapes() -> list[tuple[int, int, int]]:
    """Columns, rows and index of the tile among those of its kind."""
    found = []
    for k, columns in enumerate(COLUMNS):
        found += [(columns, rows, 2 * k + 1) for rows in range(1, tiles.LANES + 1)]
        found += [(columns, rows, 2 * k) for rows in range(tiles.TALL_FROM, tiles.TILE_ROWS + 1)]
    return found


def compiled(tile: Callable[..., None], arguments: int) -> Callable[..., None]:
    """An intrinsic can only be called from a kernel."""
    names = ", ".join(f"x{k}" for k in range(arguments))
    scope: dict[str, Callable[..., None]] = {"tile": tile}
    exec(f"def call({names}):\n    tile({names})", scope)
    return numba.njit(scope["call"])  # type: ignore[no-any-return]


def all_compiled(kind: str, arguments: int) -> list[Callable[..., None]]:
    return [compiled(getattr(tiles, f"{kind}_{columns}{short}"), arguments) for columns in COLUMNS for short in ("", "_short")]


UPDATES, TRANSPOSED = all_compiled("update", 12), all_compiled("transposed", 12)
SOLVES, FACTORS = all_compiled("solve", 13), all_compiled("factor", 14)
DOTS = [compiled(getattr(tiles, f"dots_{columns}"), 8) for columns in COLUMNS]
ADD = compiled(tiles.add, 5)


class Matrix:
    """A column-major matrix inside a buffer of random numbers."""

    def __init__(self, rng: np.random.Generator, rows: int, columns: int) -> None:
        self.at, self.ld = int(rng.integers(0, 9)), rows + int(rng.integers(0, 5))
        self.buffer = rng.normal(size=self.at + self.ld * max(columns, 1) + 24)
        self.shape = (rows, columns)

    @property
    def view(self) -> NDArray[np.float64]:
        return np.lib.stride_tricks.as_strided(self.buffer[self.at :], self.shape, (8, 8 * self.ld))

    def with_view(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """The buffer as it should be when only the matrix has changed."""
        copy = Matrix.__new__(Matrix)
        copy.at, copy.ld, copy.shape, copy.buffer = self.at, self.ld, self.shape, self.buffer.copy()
        copy.view[:] = values
        return copy.buffer

    @property
    def arguments(self) -> tuple[NDArray[np.float64], np.uint64, np.uint64]:
        return self.buffer, U(self.at), U(self.ld)


@pytest.mark.parametrize("depth", [0, 1, 2, 7, 40])
def test_updates(depth: int) -> None:
    rng = np.random.default_rng(depth)
    for columns, rows, index in shapes():
        for accumulate in (0, 1):
            a, b, c = Matrix(rng, rows, depth), Matrix(rng, columns, depth), Matrix(rng, rows, columns)
            expected = c.with_view(accumulate * c.view - a.view @ b.view.T)
            UPDATES[index](*c.arguments, *a.arguments, *b.arguments, U(depth), U(rows), U(accumulate))
            np.testing.assert_allclose(c.buffer, expected, rtol=1e-12, atol=1e-12)
            b, c = Matrix(rng, depth, columns), Matrix(rng, rows, columns)
            expected = c.with_view(accumulate * c.view - a.view @ b.view)
            TRANSPOSED[index](*c.arguments, *a.arguments, *b.arguments, U(depth), U(rows), U(accumulate))
            np.testing.assert_allclose(c.buffer, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("depth", [0, 1, 5, 12])
def test_solves(depth: int) -> None:
    rng = np.random.default_rng(depth)
    for columns, rows, index in shapes():
        a, b, c = Matrix(rng, rows, depth), Matrix(rng, columns, depth + columns), Matrix(rng, rows, columns)
        triangle = np.tril(b.view[:, depth:], -1) + np.diag(rng.uniform(1.0, 2.0, columns))
        inverse = np.concatenate([[np.nan], 1.0 / np.diag(triangle)])
        expected = c.with_view(np.linalg.solve(triangle, (c.view - a.view @ b.view[:, :depth].T).T).T)
        SOLVES[index](*c.arguments, *a.arguments, *b.arguments, U(depth), U(rows), inverse, U(1))
        np.testing.assert_allclose(c.buffer, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("depth", [0, 1, 5, 12])
def test_factors(depth: int) -> None:
    rng = np.random.default_rng(depth)
    for columns, rows, index in shapes():
        if rows < columns:
            continue
        panel = Matrix(rng, rows, depth + columns)
        done, rest = panel.view[:, :depth].copy(), panel.view[:, depth:].copy()
        root = rng.normal(size=(columns, columns)) + 3.0 * np.eye(columns)
        rest[:columns] = root @ root.T + done[:columns] @ done[:columns].T
        panel.view[:, depth:] = rest
        whole = rest - done @ done[:columns].T
        L = np.linalg.cholesky(whole[:columns])
        expected = np.linalg.solve(L, whole.T).T
        inverse, pivots = np.full(columns + 2, np.nan), np.full(columns + 2, np.nan)
        buffer, at, ld = panel.arguments
        FACTORS[index](buffer, at + U(depth) * ld, ld, buffer, at, ld, buffer, at, ld, U(depth), U(rows), inverse, U(1), pivots)
        found, lower = panel.view[:, depth:], np.tri(rows, columns, dtype=bool)
        np.testing.assert_allclose(found[lower], expected[lower], rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(pivots[1:-1], np.diag(L) ** 2, rtol=1e-9)
        np.testing.assert_allclose(inverse[1:-1], 1.0 / np.diag(L), rtol=1e-9)
        assert np.isnan(inverse[[0, -1]]).all()
        np.testing.assert_array_equal(panel.view[:, :depth], done)


@pytest.mark.parametrize("depth", [0, 1, 7, 8, 9, 30])
def test_dots_and_sums(depth: int) -> None:
    rng = np.random.default_rng(depth)
    for columns, tile in zip(COLUMNS, DOTS, strict=True):
        a, b, c = Matrix(rng, depth, 1), Matrix(rng, depth, columns), Matrix(rng, columns, 1)
        expected = c.with_view(c.view - b.view.T @ a.view)
        tile(c.buffer, U(c.at), a.buffer, U(a.at), *b.arguments, U(depth))
        np.testing.assert_allclose(c.buffer, expected, rtol=1e-12, atol=1e-12)
    if depth:
        a, c = Matrix(rng, depth, 1), Matrix(rng, depth, 1)
        expected = c.with_view(c.view + a.view)
        ADD(c.buffer, U(c.at), a.buffer, U(a.at), U(depth))
        np.testing.assert_array_equal(c.buffer, expected)
