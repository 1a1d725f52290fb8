"""Deformation by handles: a few material points are moved, and the cage follows as rigidly as it can.

Minimised over the vertices x, in the mesh's own frame (half diagonal 1), from the rest shape X:

    sum_t V_t / V |F_t - R(F_t)|^2,   F_t = dx/dX on tet t,   R(F) the rotation nearest to F

(as-rigid-as-possible; Chao et al. 2010, "A simple geometric model for elastic deformations"), subject to
the handles. It is zero for rigid motions only, finite for flat and inverted tets, and pushes those back.

Axes: V vertices, T tets, H handle points, of which P are vertices and Q = H - P points within tets.
Units: `targets`, `points` and errors in world units; energy, stiffness and residual in the mesh's frame.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from flax import struct
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from nimpostor_jax.edit.deform import Scalar, deform
from nimpostor_jax.geometry.barycentric import interpolate
from nimpostor_jax.geometry.locate import locate
from nimpostor_jax.geometry.polar import nearest_rotation
from nimpostor_jax.geometry.tetrahedron import corners, cross, num_inverted
from nimpostor_jax.types import NeuralImpostor, TetMesh

# Of the energy's diagonal, added by Levenberg-Marquardt at first. Of 1e-4, 1e-3 and 1e-2 the last takes the
# fewest steps: Gauss-Newton underrates how stiff stretched tets are against rotation.
INITIAL_DAMPING = 1e-2
CG_STEPS = 60  # of an inner solve; where it stops early, it still goes downhill
ADJOINT_CG_STEPS = 2000  # of the one solve behind a gradient, which nothing corrects afterwards
TOWARDS_IDENTITY = 1e-4  # decides the rigid start where handles leave a rotation open (one or two of them)


@struct.dataclass
class Handles:
    """Material points of a cage, made by `make_handles`: P vertices, then Q points within tets."""

    vertex_ids: Int[Array, " P"]
    point_corners: Int[Array, "Q 4"]
    point_weights: Float[Array, "Q 4"]  # barycentric
    # (B B^T)^+ of the points' interpolation B, without vertices that are handles: for exact interpolation.
    point_inverse: Float[Array, "Q Q"]

    def __len__(self) -> int:
        return self.vertex_ids.shape[0] + self.point_corners.shape[0]


@struct.dataclass
class CageFit:
    """How a fit ended: data, because it may happen under jit."""

    converged: Bool[Array, ""]  # False: more steps needed, or input that is not finite
    num_steps: Int[Array, ""]
    energy: Float[Array, ""]  # mean of |F - R|^2 over the rest volume: squared strain
    residual: Float[Array, ""]  # how far the worst vertex would move in a Jacobi step, in half diagonals
    handle_error: Float[Array, ""]  # largest distance of a handle from its target, world units
    num_inverted: Int[Array, ""]  # tets without positive volume


class _Problem(NamedTuple):
    """What the residuals depend on beside the unknowns; differentiable arrays."""

    tets: Int[Array, "T 4"]
    gradients: Float[Array, "T 3 3"]  # of the barycentric coordinates of corners 1 to 3, at rest
    volume_shares: Float[Array, " T"]
    handles: Handles
    targets: Float[Array, "H 3"]  # in the mesh's frame
    stiffness: Scalar | None
    start: Float[Array, "V 3"]
    widths: Float[Array, "V 1"]  # vertex = start + width * unknown: brings the energy's diagonal to one size
    gain: Float[Array, ""]


def make_handles(
    mesh: TetMesh,
    *,
    vertices: ArrayLike = (),
    points: ArrayLike = (),
    tets: ArrayLike = (),
    lambdas: ArrayLike = (),
) -> Handles:
    """Handles of a cage at rest: vertices, then (tet, barycentric coordinates), then world points. Host code.

    Args:
        mesh: the cage at rest.
        vertices: ids [P].
        points: world positions at rest [N, 3], inside the cage.
        tets, lambdas: material points: ids [M] and coordinates [M, 4] that sum to 1.

    Raises:
        ValueError: no handle at all, a vertex or tet that does not exist or a vertex given twice,
            coordinates that do not sum to 1, a point that is not finite or not inside the cage; names the
            first.
    """
    vertex_ids = _ids(vertices, len(mesh.vertices), "vertex")
    repeated = np.flatnonzero(np.bincount(vertex_ids, minlength=1) > 1)
    if repeated.size:
        raise ValueError(f"vertex {repeated[0]} is a handle twice; give every vertex once")
    tet_ids = _ids(tets, len(mesh.tets), "tet")
    weights = np.asarray(lambdas, np.float64).reshape(-1, 4)
    if len(weights) != len(tet_ids):
        raise ValueError(f"{len(tet_ids)} tets and {len(weights)} rows of barycentric coordinates")
    # 1e-4: float32 coordinates of slivers pass.
    bad = np.flatnonzero(~(np.abs(weights.sum(axis=1) - 1) < 1e-4))
    if bad.size:
        raise ValueError(f"lambdas of material point {bad[0]} do not sum to 1: {weights[bad[0]].tolist()}")
    world = np.asarray(points, np.float64).reshape(-1, 3)
    if len(world):
        found, located = (np.asarray(x) for x in locate(mesh, jnp.asarray(world, mesh.vertices.dtype)))
        outside = np.flatnonzero(found < 0)
        if outside.size:
            raise ValueError(
                f"{outside.size} of {len(world)} handle points are not inside the cage; first: point "
                f"{outside[0]} at {world[outside[0]].tolist()}; give points inside, at rest"
            )
        tet_ids, weights = np.concatenate([tet_ids, found]), np.concatenate([weights, located])
    if not len(vertex_ids) + len(tet_ids):
        raise ValueError("no handles: give vertices, points, or tets with lambdas")
    point_corners = np.asarray(mesh.tets)[tet_ids]
    dtype = mesh.vertices.dtype
    return Handles(
        vertex_ids=jnp.asarray(vertex_ids, jnp.int32),
        point_corners=jnp.asarray(point_corners, jnp.int32),
        point_weights=jnp.asarray(weights, dtype),
        point_inverse=jnp.asarray(_coupling(vertex_ids, point_corners, weights), dtype),
    )


def _ids(values: ArrayLike, count: int, what: str) -> Int[np.ndarray, " N"]:
    ids = np.asarray(values).reshape(-1)
    if ids.size and not np.issubdtype(ids.dtype, np.integer):
        raise ValueError(f"{what} ids must be integers, got {ids.dtype}")
    ids = ids.astype(np.int64)
    bad = np.flatnonzero((ids < 0) | (ids >= count))
    if bad.size:
        raise ValueError(f"handle {bad[0]}: {what} {ids[bad[0]]} does not exist; there are {count}")
    return ids


def _coupling(
    vertex_ids: Int[np.ndarray, " P"],
    point_corners: Int[np.ndarray, "Q 4"],
    weights: Float[np.ndarray, "Q 4"],
) -> Float[np.ndarray, "Q Q"]:
    """Pseudo-inverse of B B^T; B interpolates points from vertices, those that are handles left out."""
    free = np.where(np.isin(point_corners, vertex_ids), 0, weights)
    same = point_corners[:, None, :, None] == point_corners[None, :, None, :]
    gram = np.einsum("qi,rj,qrij->qr", free, free, same)
    # Points that contradict each other (five in a tet) are met by least squares: `handle_error` tells.
    return np.linalg.pinv(gram, rcond=1e-6, hermitian=True) if len(gram) else gram


def fit_cage(
    impostor: NeuralImpostor,
    handles: Handles,
    targets: Float[Array, "H 3"],
    *,
    stiffness: Scalar | None = None,
    start: Float[Array, "V 3"] | None = None,
    max_steps: int = 100,
) -> tuple[NeuralImpostor, CageFit]:
    """The impostor with its handles at `targets`, and the rest of its cage where that takes least strain.

    Levenberg-Marquardt with conjugate gradients (optimistix), matrix-free. Differentiable in targets, rest
    vertices and stiffness by the implicit function theorem; a gradient means something where the fit has
    converged. Works under jit and does not compile again for other targets. Parts of the cage that hang
    together with no handle follow the best rigid motion. The energy has several local minima for large
    rotations of some handles against others: move there in steps, and pass the last vertices as `start`.

    Args:
        impostor: at rest; its vertices are the shape without strain, except that flat and inverted tets
            resist nothing.
        handles: of `make_handles` on this impostor's mesh.
        targets: world positions, in the order of the handles.
        stiffness: None: handles are met exactly (to rounding). Otherwise they pull: missing a target
            by d half diagonals of the cage adds stiffness * d^2 to the energy, as much as stretching the
            whole cage by the share sqrt(stiffness) * d along one direction. Exact in the limit.
        start: world vertices to begin from, by default the best rigid motion of the handles.
        max_steps: of Levenberg-Marquardt; static.

    Returns:
        The impostor (the rest vertices where nothing finite came out) and the status.

    Raises:
        ValueError: wrong shapes; outside jit, targets or a start that are not finite (names the first), or a
            stiffness that is not positive.
    """
    mesh = impostor.mesh
    dtype = mesh.vertices.dtype
    _check(targets, (len(handles), 3), "targets")
    if start is not None:
        _check(start, mesh.vertices.shape, "start")
    if stiffness is not None and not isinstance(stiffness, jax.core.Tracer) and not stiffness > 0:
        raise ValueError(f"stiffness must be > 0, or None for exact handles; got {stiffness}")
    local = (jnp.asarray(targets, dtype) - mesh.center) / mesh.scale
    if start is None:
        first = _best_rigid(mesh.vertices, _handle_points(handles, mesh.vertices), local)
    else:
        first = (jnp.asarray(start, dtype) - mesh.center) / mesh.scale
    vertices, status = _solve(mesh.vertices, mesh.tets, handles, local, stiffness, first, max_steps=max_steps)
    status = status.replace(handle_error=status.handle_error * mesh.scale)
    return deform(impostor, lambda _: mesh.center + mesh.scale * vertices), status


def _check(values: Any, shape: tuple[int, ...], what: str) -> None:
    if np.shape(values) != shape:
        raise ValueError(f"{what} must have shape {shape}, got {np.shape(values)}")
    if not isinstance(values, jax.core.Tracer):
        bad = np.flatnonzero(~np.isfinite(np.asarray(values)).all(axis=1))
        if bad.size:
            raise ValueError(
                f"{bad.size} of {shape[0]} {what} are not finite; first: number {bad[0]}, "
                f"{np.asarray(values)[bad[0]].tolist()}"
            )


@partial(jax.jit, static_argnames="max_steps")
def _solve(
    rest: Float[Array, "V 3"],
    tets: Int[Array, "T 4"],
    handles: Handles,
    targets: Float[Array, "H 3"],
    stiffness: Scalar | None,
    start: Float[Array, "V 3"],
    *,
    max_steps: int,
) -> tuple[Float[Array, "V 3"], CageFit]:
    """`fit_cage` on arrays in the mesh's frame."""
    problem = _problem(rest, tets, handles, targets, stiffness, jax.lax.stop_gradient(start))
    precise = rest.dtype == jnp.float64
    tolerance = 1e-11 if precise else 1e-5
    noise = float(jnp.finfo(rest.dtype).eps) / INITIAL_DAMPING  # of a force, whose diagonal is 1 / damping
    # Too short for rounding to add up, and a third less to compile than with residuals computed anew.
    inner = _Downhill(rtol=1e-3, atol=10 * noise, stabilise_every=None, max_steps=CG_STEPS)
    adjoint = _Downhill(rtol=tolerance, atol=noise * (1e-2 if precise else 1), max_steps=ADJOINT_CG_STEPS)
    solution: optx.Solution = optx.least_squares(
        _residuals,
        optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance, linear_solver=lx.Normal(inner)),
        jnp.zeros_like(rest),
        args=problem,
        max_steps=max_steps,
        adjoint=_ForceAdjoint(linear_solver=adjoint),
        throw=False,
    )
    vertices = _positions(solution.value, problem)
    strain, _ = _residuals(jax.lax.stop_gradient(solution.value), problem)
    force = _forces(jax.lax.stop_gradient(solution.value), problem) * INITIAL_DAMPING
    finite = jnp.all(jnp.isfinite(vertices))
    vertices = jnp.where(finite, vertices, rest)
    miss = _handle_points(handles, vertices) - targets
    return vertices, CageFit(
        converged=(solution.result == optx.RESULTS.successful) & finite,
        num_steps=solution.stats["num_steps"],
        energy=jnp.sum(strain**2) / problem.gain**2,
        residual=jnp.max(jnp.sqrt(jnp.sum((force * problem.widths) ** 2, axis=-1))),
        handle_error=jnp.sqrt(jnp.max(jnp.sum(miss**2, axis=-1))),
        num_inverted=num_inverted(vertices, tets),
    )


class _Downhill(lx.CG):
    """Conjugate gradients that say "done" where they stop: each iterate is a step down the energy.

    lineax would call an exhausted count of steps a failure, and optimistix would end there. The operator is
    known to be positive semidefinite: normal equations, or the Hessian at a minimum.
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> Any:
        """As of `lx.CG`, with the tag."""
        return super().init(lx.TaggedLinearOperator(operator, lx.positive_semidefinite_tag), options)

    def compute(self, state: Any, vector: Any, options: dict[str, Any]) -> tuple[Any, Any, dict[str, Any]]:
        """Drop the result."""
        solution, _, stats = super().compute(state, vector, options)
        return solution, lx.RESULTS.successful, stats


def _problem(
    rest: Float[Array, "V 3"],
    tets: Int[Array, "T 4"],
    handles: Handles,
    targets: Float[Array, "H 3"],
    stiffness: Scalar | None,
    start: Float[Array, "V 3"],
) -> _Problem:
    positions = corners(rest, tets)
    edges = positions[:, 1:] - positions[:, :1]
    a, b, c = edges[:, 0], edges[:, 1], edges[:, 2]
    normals = jnp.stack([cross(b, c), cross(c, a), cross(a, b)], axis=1)
    six_volumes = jnp.sum(a * normals[:, 0], axis=-1)
    valid = six_volumes > 0  # others have no rest shape to return to
    gradients = normals / jnp.where(valid, six_volumes, 1)[:, None, None]
    volumes = jnp.where(valid, six_volumes, 0)
    total = jnp.sum(volumes)
    shares = volumes / jnp.where(total > 0, total, 1)

    all_four = jnp.concatenate([-jnp.sum(gradients, axis=1, keepdims=True), gradients], axis=1)
    each = shares[:, None] * jnp.sum(all_four**2, axis=-1)
    diagonal = jnp.zeros(len(rest), rest.dtype).at[tets].add(each)
    if stiffness is not None:
        diagonal = diagonal.at[handles.vertex_ids].add(stiffness)
        diagonal = diagonal.at[handles.point_corners].add(stiffness * handles.point_weights**2)
    # Scales steer the solver only; the minimum does not depend on them.
    diagonal = jax.lax.stop_gradient(diagonal)
    mean = jnp.mean(diagonal)
    mean = jnp.where(mean > 0, mean, 1)
    widths = jnp.sqrt(mean / jnp.where(diagonal > 0, diagonal, mean))[:, None]
    gain = jnp.sqrt(1 / (INITIAL_DAMPING * mean))
    return _Problem(tets, gradients, shares, handles, targets, stiffness, start, widths, gain)


def _stretch_and_miss(unknowns: Float[Array, "V 3"], problem: _Problem) -> tuple[Array, Array]:
    """What the energy measures: F of each tet, and how far soft handles are from their targets, scaled."""
    vertices = _positions(unknowns, problem)
    positions = corners(vertices, problem.tets)
    edges = positions[:, 1:] - positions[:, :1]
    # Elementwise: a float32 dot runs in reduced precision on accelerators.
    F = jnp.sum(edges[:, :, :, None] * problem.gradients[:, :, None, :], axis=1)
    if problem.stiffness is None:
        return F, jnp.zeros((0, 3), F.dtype)
    miss = _handle_points(problem.handles, vertices) - problem.targets
    return F, problem.gain * jnp.sqrt(problem.stiffness) * miss


def _residuals(unknowns: Float[Array, "V 3"], problem: _Problem) -> list[Array]:
    """What least squares sums up: (F - R) of each tet by the root of its share, and the handles' misses."""
    F, miss = _stretch_and_miss(unknowns, problem)
    used = problem.volume_shares > 0
    root = jnp.where(used, jnp.sqrt(jnp.where(used, problem.volume_shares, 1)), 0)
    return [problem.gain * root[:, None, None] * (F - nearest_rotation(F)), miss]


def _forces(unknowns: Float[Array, "V 3"], problem: _Problem) -> Float[Array, "V 3"]:
    """The gradient of half the sum of squares, zero at the minimum.

    R drops out of it: a change of R is a rotation, to which F - R is orthogonal. So implicit differentiation
    needs no second derivative of R, which eigenvectors do not give at rest, where all stretches are equal.
    """
    (F, miss), pull_back = jax.vjp(lambda y: _stretch_and_miss(y, problem), unknowns)
    shares = problem.gain**2 * problem.volume_shares[:, None, None]
    return pull_back((shares * (F - nearest_rotation(F)), miss))[0]


def _optimality(unknowns: Float[Array, "V 3"], _: Any, inputs: tuple) -> Float[Array, "V 3"]:
    """`_forces` as optimistix calls it."""
    return _forces(unknowns, inputs[3])


class _ForceAdjoint(optx.ImplicitAdjoint):
    """Implicit differentiation of `_forces` = 0, which optimistix would derive from the residuals."""

    def apply(self, primal_fn: Any, rewrite_fn: Any, inputs: Any, tags: Any) -> Any:
        """Ours in the place of `rewrite_fn`."""
        return super().apply(primal_fn, _optimality, inputs, tags)


def _positions(unknowns: Float[Array, "V 3"], problem: _Problem) -> Float[Array, "V 3"]:
    """The vertices that unknowns stand for; exact handles are met whatever the unknowns are."""
    moved = problem.start + problem.widths * unknowns
    if problem.stiffness is not None:
        return moved
    handles = problem.handles
    count = handles.vertex_ids.shape[0]
    moved = moved.at[handles.vertex_ids].set(problem.targets[:count])
    miss = problem.targets[count:] - _handle_points(handles, moved)[count:]
    pull = jnp.sum(handles.point_inverse[:, :, None] * miss[None], axis=1)
    # To the nearest vertices that meet the points; those that are handles themselves stay.
    free = jnp.ones(len(moved), moved.dtype).at[handles.vertex_ids].set(0)
    weights = handles.point_weights * free[handles.point_corners]
    return moved.at[handles.point_corners].add(weights[:, :, None] * pull[:, None])


def _handle_points(handles: Handles, vertices: Float[Array, "V 3"]) -> Float[Array, "H 3"]:
    """Where the handles are when the cage has these vertices."""
    points = interpolate(handles.point_weights, vertices[handles.point_corners])
    return jnp.concatenate([vertices[handles.vertex_ids], points])


@jax.jit
def _best_rigid(
    vertices: Float[Array, "V 3"], points: Float[Array, "H 3"], targets: Float[Array, "H 3"]
) -> Float[Array, "V 3"]:
    """The vertices under the rigid motion that brings points nearest to targets (least squares)."""
    center, goal = jnp.mean(points, axis=0), jnp.mean(targets, axis=0)
    before, after = points - center, targets - goal
    covariance = jnp.sum(after[:, :, None] * before[:, None, :], axis=0)
    size = jnp.sum(before**2) + jnp.sum(after**2)
    size = jnp.where(size > 0, size, 1)
    rotation = identity = jnp.eye(3, dtype=vertices.dtype)
    for _ in range(2):  # the second time it is drawn to the first one's answer: its error is squared
        rest = jnp.sum(covariance[:, None] * rotation[None], axis=-1) + TOWARDS_IDENTITY * size * identity
        rotation = jnp.sum(nearest_rotation(rest)[:, :, None] * rotation[None], axis=1)
    return goal + jnp.sum(rotation[None] * (vertices - center)[:, None, :], axis=-1)
