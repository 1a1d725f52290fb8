"""Which side of an edge a ray passes: the one decision on which traversal rests.

Seen along the ray, a face is hit when the ray passes on the same side of its three directed edges. The side
of an edge is decided exactly for the projected corners, which are the same bits in all tets around them: a
ray cannot slip between two tets. Ties are resolved as if the ray were moved by (epsilon, epsilon^2), so a
ray through an edge or a vertex is passed on exactly once.

Points are sequences of arrays (x, y, ...) instead of a trailing axis: each operation is one long vector one.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Lanes = Float[Array, "*lanes"]

EDGE_ON = 1e-2  # height by width of a projected face, below which its area loses two digits: not trusted


def ray_frame(directions: Sequence[Lanes]) -> tuple[tuple[Lanes, ...], ...]:
    """Orthonormal axes for a unit direction (Duff et al. 2017): two across the ray, then its own.

    The same bits wherever it is compiled, as `project`.
    """
    x, y, z = directions
    sign = jnp.where(z >= 0, 1.0, -1.0).astype(x.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    across = (1 + rounded(sign * x * x * a), sign * b, -sign * x)
    return across, (b, sign + rounded(y * y * a), -y), (x, y, z)


def project(
    point: Sequence[Lanes], origin: Sequence[Lanes], axes: Sequence[Sequence[Lanes]]
) -> tuple[Lanes, ...]:
    """Coordinates of a point on the given axes, relative to the ray's origin.

    The same bits wherever it is compiled: without `rounded`, some kernels would fuse multiply and add and
    others not, and a ray through a vertex would pass it on different sides in different tets.
    """
    dx, dy, dz = (p - o for p, o in zip(point, origin, strict=True))
    return tuple(rounded(a[0] * dx) + rounded(a[1] * dy) + rounded(a[2] * dz) for a in axes)


def rounded(product: Lanes) -> Lanes:
    """A product itself; the selection keeps compilers from fusing it with the addition that follows."""
    return jnp.where(product == product, product, 0)


def passes_left(u: Sequence[Lanes], v: Sequence[Lanes]) -> Bool[Array, "*lanes"]:
    """Whether the ray, which is the origin of the projected plane, lies left of u -> v; opposite for v -> u.

    Looks at x and y of `project`ed points only. The sign of u x v is exact: products are compared, not
    subtracted, and where their rounded values are equal, what was rounded off decides. Anything less lets
    the tests around a face that is seen edge-on contradict each other, and a walk may then run in circles.
    """
    forward, backward = _products(u, v)
    more, less = _rest(u[0], v[1], forward), _rest(u[1], v[0], backward)
    tie = (u[1] > v[1]) | ((u[1] == v[1]) & (v[0] > u[0]))
    tie = (more > less) | ((more == less) & tie)
    return (forward > backward) | ((forward == backward) & tie)


def quick_passes_left(
    u: Sequence[Lanes], v: Sequence[Lanes]
) -> tuple[Bool[Array, "*lanes"], Bool[Array, "*lanes"]]:
    """`passes_left` by rounded products, and whether they are equal, so that it may be wrong."""
    forward, backward = _products(u, v)
    return forward > backward, forward == backward


def _products(u: Sequence[Lanes], v: Sequence[Lanes]) -> tuple[Lanes, Lanes]:
    return rounded(u[0] * v[1]), rounded(u[1] * v[0])


def _rest(a: Lanes, b: Lanes, product: Lanes) -> Lanes:
    """a b minus its rounded value, exactly (Dekker 1971)."""
    (a_high, a_low), (b_high, b_low) = _halves(a), _halves(b)
    return ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low


def _halves(x: Lanes) -> tuple[Lanes, Lanes]:
    """Two numbers of half the digits with the sum x (Veltkamp 1968): their products are exact."""
    digits = jnp.finfo(x.dtype).nmant + 1
    scaled = rounded(x * (2.0 ** -(-digits // 2) + 1))
    high = scaled - (scaled - x)
    return high, x - high


def face_weights(a: Sequence[Lanes], b: Sequence[Lanes], c: Sequence[Lanes]) -> tuple[Lanes, Lanes, Lanes]:
    """Barycentric coordinates, within a face, of the point where the ray's line meets it.

    a, b, c: projected corners. The weights stay well conditioned however flat the tets beside the face are,
    and never leave [0, 1]. The face is cut across its longer side where the ray is: two of its edges end the
    cut, and the point lies between them. Of a face seen edge-on, the ratio of areas would be a ratio of
    rounding errors; here the point is still one at which the line is within the face.
    """
    extent = [
        jnp.maximum(jnp.maximum(jnp.abs(a[i] - b[i]), jnp.abs(b[i] - c[i])), jnp.abs(c[i] - a[i]))
        for i in range(2)
    ]
    wide = extent[0] >= extent[1]
    along = [jnp.where(wide, p[0], p[1]) for p in (a, b, c)]
    across = [jnp.where(wide, p[1], p[0]) for p in (a, b, c)]
    first, second = _tip(along)
    tip_along, q_along, r_along = _turned(first, second, along)
    tip_across, q_across, r_across = _turned(first, second, across)
    # From the tip to where the cut ends; an edge along the cut is all of it.
    to_q = _share(tip_along, tip_along - q_along, 1)
    to_r = _share(tip_along, tip_along - r_along, 1)
    end_q = tip_across + to_q * (q_across - tip_across)
    end_r = tip_across + to_r * (r_across - tip_across)
    between = _share(end_q, end_q - end_r, 0.5)
    wq, wr = (1 - between) * to_q, between * to_r
    tip = jnp.maximum(1 - wq - wr, 0)
    return (
        jnp.where(first, tip, jnp.where(second, wr, wq)),
        jnp.where(first, wq, jnp.where(second, tip, wr)),
        jnp.where(first, wr, jnp.where(second, wq, tip)),
    )


def quick_face_weights(
    a: Sequence[Lanes], b: Sequence[Lanes], c: Sequence[Lanes]
) -> tuple[tuple[Lanes, Lanes, Lanes], Bool[Array, "*lanes"]]:
    """`face_weights` as the ratio of areas, and whether the face is too flat, as seen, to trust them."""
    products = [(u[0] * v[1], u[1] * v[0]) for u, v in ((b, c), (c, a), (a, b))]
    wa, wb, wc = (forward - backward for forward, backward in products)
    total = wa + wb + wc
    rounded = sum(jnp.abs(forward) + jnp.abs(backward) for forward, backward in products)
    inverse = 1 / jnp.where(total == 0, 1, total)
    first = jnp.clip(wa * inverse, 0, 1)
    second = jnp.minimum(jnp.clip(wb * inverse, 0, 1), 1 - first)
    return (first, second, 1 - first - second), jnp.abs(total) <= EDGE_ON * rounded


def _tip(along: Sequence[Lanes]) -> tuple[Bool[Array, "*lanes"], Bool[Array, "*lanes"]]:
    """Whether the first, or the second, of three numbers has its sign alone; else the third.

    Where all have one sign, because of rounding, it is the one nearest to 0.
    """
    a, b, c = (x > 0 for x in along)
    near = [jnp.abs(x) for x in along]
    first = jnp.where((a == b) & (b == c), (near[0] <= near[1]) & (near[0] <= near[2]), (a != b) & (b == c))
    second = jnp.where((a == b) & (b == c), near[1] <= near[2], (a == c) & (a != b))
    return first, second & ~first


def _turned(first: Lanes, second: Lanes, values: Sequence[Lanes]) -> tuple[Lanes, Lanes, Lanes]:
    """Three values in cyclic order, from the first, the second, or else the third."""
    a, b, c = values
    return (
        jnp.where(first, a, jnp.where(second, b, c)),
        jnp.where(first, b, jnp.where(second, c, a)),
        jnp.where(first, c, jnp.where(second, a, b)),
    )


def _share(part: Lanes, whole: Lanes, otherwise: float) -> Lanes:
    """part / whole in [0, 1]; a constant where the whole is 0, or so little that it is rounding.

    Two of these follow on each other: their slopes, multiplied, must not overflow.
    """
    valid = jnp.abs(whole) > jnp.finfo(whole.dtype).tiny ** 0.25  # 3e-10 in float32
    return jnp.where(valid, jnp.clip(part / jnp.where(valid, whole, 1), 0, 1), otherwise)
