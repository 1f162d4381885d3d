"""The pose of a camera as many bundle adjusters move it (docs/manifolds.md): q ← Exp(w) ⊗ q, t ← t + τ.

T_camera_world = (q, t), (7,) wxyz and xyz, tangent [w, τ] [rad, m]: the rotation on the left, in the camera, and the translation
by addition. It is equal to `Product(UnitQuaternionLeft, Euclidean(3))`, because it is one. `SE3Left` turns the translation as
well; the two must not be mixed, and `tangent_change` carries Jacobians from one to the other.

Source: Triggs et al., Bundle adjustment – a modern synthesis, 2000, section 2.2.
"""

from __future__ import annotations

from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternionLeft

CameraPose: Manifold = Product(UnitQuaternionLeft, Euclidean(3))
