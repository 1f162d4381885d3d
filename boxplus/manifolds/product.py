"""Several manifolds as one variable: storages and tangents one after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.manifolds._kernel_manifold import KernelManifold, checked_rows
from boxplus.manifolds.manifold import Manifold


class Product(KernelManifold):
    """M₁ × M₂ × …: every component moves by its own ⊞.

    `Product(UnitQuaternion, Euclidean(3))` is a pose whose rotation moves on the right and whose translation by addition in
    the world: tangent [w, t]. Two products are equal when their components are, in order.

    Raises:
        InputError: no component, or one that is no manifold.

    Example:
        >>> body = bp.Product(bp.UnitQuaternion, bp.Euclidean(3))
        >>> body.size, body.dof
        (7, 6)
        >>> body.boxplus(body.identity(), [0.0, 0.0, 0.0, 1.0, 2.0, 3.0])
        array([1., 0., 0., 0., 1., 2., 3.])
    """

    def __init__(self, *components: Manifold) -> None:
        for component in components:
            if not isinstance(component, Manifold):
                raise InputError("manifolds", repr(component), "write Product(UnitQuaternion, Euclidean(3))")
        if not components:
            raise InputError("at least one manifold", "none", "write Product(UnitQuaternion, Euclidean(3))")
        self.components = components
        self.name = f"Product({', '.join(component.name for component in components)})"
        self.size = sum(component.size for component in components)
        self.dof = sum(component.dof for component in components)
        counted = [tangent for component in components for tangent in component.tangent_names]
        self.tangent_names = tuple(
            # A name that two components share tells them apart by their numbers.
            tangent if counted.count(tangent) == 1 else f"{tangent} of component {number}"
            for number, component in enumerate(components)
            for tangent in component.tangent_names
        )
        starts, tangent_starts = np.cumsum([0, *(c.size for c in components)]), np.cumsum([0, *(c.dof for c in components)])
        self._parts = tuple(
            (c, slice(int(starts[k]), int(starts[k + 1])), slice(int(tangent_starts[k]), int(tangent_starts[k + 1])))
            for k, c in enumerate(components)
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Product) and self.components == other.components

    def __hash__(self) -> int:
        return hash(self.components)

    def boxplus_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        for component, stored, tangent in self._parts:
            out[:, stored] = component.boxplus(x[:, stored], delta[:, tangent])

    def boxminus_into(self, x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        for component, stored, tangent in self._parts:
            out[:, tangent] = component.boxminus(x[:, stored], base[:, stored])

    def boxplus_jacobian_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        for component, stored, tangent in self._parts:
            J[:, tangent, tangent] = component.boxplus_jacobian(x[:, stored], delta[:, tangent])

    def boxminus_jacobian_into(self, x: NDArray[np.float64], base: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        for component, stored, tangent in self._parts:
            J[:, tangent, tangent] = component.boxminus_jacobian(x[:, stored], base[:, stored])

    def check(self, name: str, x: ArrayLike) -> NDArray[np.float64]:
        rows = checked_rows(name, x, self.size, self.name)
        for component, stored, _ in self._parts:
            rows[:, stored] = component.check(name, rows[:, stored])
        return rows

    def identity(self) -> NDArray[np.float64]:
        return np.concatenate([component.identity() for component in self.components])

    def random(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        return np.concatenate([component.random(rng, count) for component in self.components], axis=1)
