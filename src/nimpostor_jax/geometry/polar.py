"""The rotation in a deformation gradient: the factor R of its polar decomposition, safe where that is none.

The proper rotation nearest to F maximises tr(R^T F). As a unit quaternion it is the eigenvector of the
largest eigenvalue of a symmetric 4 x 4 matrix that is linear in F (Horn 1987): flat and inverted F have one.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# Of the matrix's size: below, F hardly says which rotation is nearest, and the derivative is held bounded.
_LEAST = 1e-4


@jax.custom_jvp
def nearest_rotation(matrices: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """The rotation R, det R = 1, that minimises the Frobenius norm of F - R, for each F.

    Differentiable; exact for the identity. Where several rotations are nearest (F = 0, or turned inside out
    with two equal stretches) one of them is returned, and the derivative is bounded, not infinite.
    """
    return _from_quaternion(jnp.linalg.eigh(_horn(matrices))[1][..., 3])


@nearest_rotation.defjvp
def _nearest_rotation_jvp(primals, tangents):  # type: ignore[no-untyped-def]
    """dR = R [w], (tr(S) I - S) w = axial(R^T dF) with S = R^T F (McAdams et al. 2011)."""
    (matrices,), (changes,) = primals, tangents
    rotations = nearest_rotation(matrices)
    stretches = _transposed_product(rotations, matrices)
    turning = _transposed_product(rotations, changes)
    right = jnp.stack(
        [
            turning[..., 2, 1] - turning[..., 1, 2],
            turning[..., 0, 2] - turning[..., 2, 0],
            turning[..., 1, 0] - turning[..., 0, 1],
        ],
        axis=-1,
    )
    trace = stretches[..., 0, 0] + stretches[..., 1, 1] + stretches[..., 2, 2]
    symmetric = (stretches + jnp.swapaxes(stretches, -1, -2)) / 2
    left = trace[..., None, None] * jnp.eye(3, dtype=matrices.dtype) - symmetric
    # Sums of two stretches, all positive unless F is turned inside out or flat.
    values, vectors = jnp.linalg.eigh(left)
    size = jnp.sqrt(jnp.sum(matrices * matrices, axis=(-1, -2)))[..., None]
    values = jnp.maximum(values, jnp.maximum(_LEAST * size, jnp.finfo(matrices.dtype).tiny ** 0.5))
    along = jnp.sum(vectors * right[..., :, None], axis=-2) / values
    spin = jnp.sum(vectors * along[..., None, :], axis=-1)
    x, y, z = (spin[..., i] for i in range(3))
    zero = jnp.zeros_like(x)
    skew = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(matrices.shape)
    return rotations, _product(rotations, skew)


def _horn(f: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 4 4"]:
    """q^T K q = tr(R(q)^T F)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = ([f[..., i, j] for j in range(3)] for i in range(3))
    rows = [
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, xy + yx, zx + xz],
        [xz - zx, xy + yx, yy - xx - zz, yz + zy],
        [yx - xy, zx + xz, yz + zy, zz - xx - yy],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _from_quaternion(q: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3 3"]:
    w, x, y, z = (q[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _product(a: Float[Array, "*batch 3 3"], b: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Elementwise: a float32 dot runs in reduced precision on accelerators."""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def _transposed_product(
    a: Float[Array, "*batch 3 3"], b: Float[Array, "*batch 3 3"]
) -> Float[Array, "*batch 3 3"]:
    return _product(jnp.swapaxes(a, -1, -2), b)
