"""The pose of a body as inertial and visual-inertial estimation moves it (docs/conventions.md): q ← q ⊗ Exp(θ), p ← p + δp.

Every sensor on a body is told on this one variable: T_world_body = (q, p), (7,) wxyz and xyz, tangent [θ, δp] [rad, m]. It is
equal to `Product(UnitQuaternion, Euclidean(3))`, because it is one.

Source: Forster et al., On-Manifold Preintegration, TRO 2017; Qin, Li and Shen, VINS-Mono, TRO 2018.
"""

from __future__ import annotations

from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion

BodyPose: Manifold = Product(UnitQuaternion, Euclidean(3))
