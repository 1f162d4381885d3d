"""3×3 matrices as tuples of nine numbers, row by row: they live in registers, so that kernels read like the formulas."""

from __future__ import annotations

from boxplus._jit import kernel

Matrix3 = tuple[float, float, float, float, float, float, float, float, float]
Vector3 = tuple[float, float, float]

IDENTITY: Matrix3 = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
ZERO: Matrix3 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@kernel(fastmath=True, inline=True)
def add(A: Matrix3, B: Matrix3) -> Matrix3:
    """A + B."""
    return (
        A[0] + B[0],
        A[1] + B[1],
        A[2] + B[2],
        A[3] + B[3],
        A[4] + B[4],
        A[5] + B[5],
        A[6] + B[6],
        A[7] + B[7],
        A[8] + B[8],
    )


@kernel(fastmath=True, inline=True)
def add_scaled(A: Matrix3, s: float, B: Matrix3) -> Matrix3:
    """A + s B."""
    return (
        A[0] + s * B[0],
        A[1] + s * B[1],
        A[2] + s * B[2],
        A[3] + s * B[3],
        A[4] + s * B[4],
        A[5] + s * B[5],
        A[6] + s * B[6],
        A[7] + s * B[7],
        A[8] + s * B[8],
    )


@kernel(fastmath=True, inline=True)
def scaled(s: float, A: Matrix3) -> Matrix3:
    """s A."""
    return (s * A[0], s * A[1], s * A[2], s * A[3], s * A[4], s * A[5], s * A[6], s * A[7], s * A[8])


@kernel(inline=True)
def transposed(A: Matrix3) -> Matrix3:
    """Aᵀ."""
    return (A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8])


@kernel(inline=True)
def mirrored(A: Matrix3) -> Matrix3:
    """The symmetric matrix with the upper triangle of A; what lies below it is then not even computed."""
    return (A[0], A[1], A[2], A[1], A[4], A[5], A[2], A[5], A[8])


@kernel(fastmath=True, inline=True)
def multiply(A: Matrix3, B: Matrix3) -> Matrix3:
    """A B."""
    return (
        A[0] * B[0] + A[1] * B[3] + A[2] * B[6],
        A[0] * B[1] + A[1] * B[4] + A[2] * B[7],
        A[0] * B[2] + A[1] * B[5] + A[2] * B[8],
        A[3] * B[0] + A[4] * B[3] + A[5] * B[6],
        A[3] * B[1] + A[4] * B[4] + A[5] * B[7],
        A[3] * B[2] + A[4] * B[5] + A[5] * B[8],
        A[6] * B[0] + A[7] * B[3] + A[8] * B[6],
        A[6] * B[1] + A[7] * B[4] + A[8] * B[7],
        A[6] * B[2] + A[7] * B[5] + A[8] * B[8],
    )


@kernel(fastmath=True, inline=True)
def multiply_add(C: Matrix3, A: Matrix3, B: Matrix3) -> Matrix3:
    """C + A B."""
    return (
        C[0] + A[0] * B[0] + A[1] * B[3] + A[2] * B[6],
        C[1] + A[0] * B[1] + A[1] * B[4] + A[2] * B[7],
        C[2] + A[0] * B[2] + A[1] * B[5] + A[2] * B[8],
        C[3] + A[3] * B[0] + A[4] * B[3] + A[5] * B[6],
        C[4] + A[3] * B[1] + A[4] * B[4] + A[5] * B[7],
        C[5] + A[3] * B[2] + A[4] * B[5] + A[5] * B[8],
        C[6] + A[6] * B[0] + A[7] * B[3] + A[8] * B[6],
        C[7] + A[6] * B[1] + A[7] * B[4] + A[8] * B[7],
        C[8] + A[6] * B[2] + A[7] * B[5] + A[8] * B[8],
    )


@kernel(fastmath=True, inline=True)
def cross_add(C: Matrix3, a: Vector3, B: Matrix3) -> Matrix3:
    """C + [a]x B."""
    return (
        C[0] + a[1] * B[6] - a[2] * B[3],
        C[1] + a[1] * B[7] - a[2] * B[4],
        C[2] + a[1] * B[8] - a[2] * B[5],
        C[3] + a[2] * B[0] - a[0] * B[6],
        C[4] + a[2] * B[1] - a[0] * B[7],
        C[5] + a[2] * B[2] - a[0] * B[8],
        C[6] + a[0] * B[3] - a[1] * B[0],
        C[7] + a[0] * B[4] - a[1] * B[1],
        C[8] + a[0] * B[5] - a[1] * B[2],
    )


@kernel(fastmath=True, inline=True)
def apply(A: Matrix3, x: float, y: float, z: float) -> Vector3:
    """A (x, y, z)."""
    return (
        A[0] * x + A[1] * y + A[2] * z,
        A[3] * x + A[4] * y + A[5] * z,
        A[6] * x + A[7] * y + A[8] * z,
    )


@kernel(fastmath=True, inline=True)
def polynomial(c: float, a: float, b: float, x: float, y: float, z: float) -> Matrix3:
    """c I + a [w]x + b [w]x² of w = (x, y, z): Exp, its Jacobians and ⟨q⟩_L, ⟨q⟩_R are of this form (docs/manifolds.md)."""
    return (
        c - b * (y * y + z * z),
        b * x * y - a * z,
        b * x * z + a * y,
        b * x * y + a * z,
        c - b * (x * x + z * z),
        b * y * z - a * x,
        b * x * z - a * y,
        b * y * z + a * x,
        c - b * (x * x + y * y),
    )
