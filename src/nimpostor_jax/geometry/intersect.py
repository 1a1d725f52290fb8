"""Which side of an edge a ray passes: the one decision on which traversal rests.

Seen along the ray, a face is hit when the ray passes on the same side of its three directed edges. The side
of an edge is decided by comparing two rounded products, which swap when the edge is turned around: all tets
around an edge agree bit for bit, so that a ray cannot slip between two of them. Ties are resolved as if the
ray were moved by (epsilon, epsilon^2), so a ray through an edge or a vertex is passed on exactly once.

Points are sequences of arrays (x, y, ...) instead of a trailing axis: each operation is one long vector one.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Lanes = Float[Array, "*lanes"]


def ray_frame(directions: Sequence[Lanes]) -> tuple[tuple[Lanes, ...], ...]:
    """Orthonormal axes for a unit direction (Duff et al. 2017): two across the ray, then its own."""
    x, y, z = directions
    sign = jnp.where(z >= 0, 1.0, -1.0).astype(x.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    return (1 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y), (x, y, z)


def project(
    point: Sequence[Lanes], origin: Sequence[Lanes], axes: Sequence[Sequence[Lanes]]
) -> tuple[Lanes, ...]:
    """Coordinates of a point on the given axes, relative to the ray's origin.

    The same bits wherever it is compiled: without `_rounded`, some kernels would fuse multiply and add and
    others not, and a ray through a vertex would pass it on different sides in different tets.
    """
    dx, dy, dz = (p - o for p, o in zip(point, origin, strict=True))
    return tuple(_rounded(a[0] * dx) + _rounded(a[1] * dy) + _rounded(a[2] * dz) for a in axes)


def _rounded(product: Lanes) -> Lanes:
    """The product itself; the selection keeps compilers from fusing it with the addition that follows."""
    return jnp.where(product == product, product, 0)


def passes_left(u: Sequence[Lanes], v: Sequence[Lanes]) -> Bool[Array, "*lanes"]:
    """Whether the ray, which is the origin of the projected plane, lies left of u -> v; opposite for v -> u.

    Looks at x and y of `project`ed points only. The products are compared, not subtracted: a fused
    multiply-add would round the two ways of writing the difference differently.
    """
    forward, backward = u[0] * v[1], u[1] * v[0]
    tie = (u[1] > v[1]) | ((u[1] == v[1]) & (v[0] > u[0]))
    return (forward > backward) | ((forward == backward) & tie)


def face_weights(a: Sequence[Lanes], b: Sequence[Lanes], c: Sequence[Lanes]) -> tuple[Lanes, Lanes, Lanes]:
    """Barycentric coordinates, within a face, of the point where the ray's line meets it.

    a, b, c: projected corners. They stay well conditioned however flat the tets beside the face are.
    Clipped to [0, 1], so that rounding never extrapolates. A face that is seen edge-on has none: the result
    is 1/3 each, with zero gradient.
    """
    wa, wb, wc = b[0] * c[1] - b[1] * c[0], c[0] * a[1] - c[1] * a[0], a[0] * b[1] - a[1] * b[0]
    total = wa + wb + wc
    valid = total != 0
    inverse = 1 / jnp.where(valid, total, 1)
    wa = jnp.where(valid, jnp.clip(wa * inverse, 0, 1), 1 / 3)
    wb = jnp.minimum(jnp.where(valid, jnp.clip(wb * inverse, 0, 1), 1 / 3), 1 - wa)
    return wa, wb, 1 - wa - wb
