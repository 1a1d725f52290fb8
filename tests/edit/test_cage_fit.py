"""Deformation by handles: what rigid motions, exact and soft handles, gradients and bad input do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from meshes import MESHES, grid

from nimpostor_jax.config import EncodingConfig, ImpostorConfig
from nimpostor_jax.edit.cage_fit import _solve, fit_cage, make_handles
from nimpostor_jax.edit.deform import drag
from nimpostor_jax.field.impostor import init_impostor
from nimpostor_jax.geometry.topology import build_tet_mesh, world_vertices

ROTATION = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
SHIFT = np.array([3.0, -2.0, 1.0])
COLUMN = grid(np.ones((1, 1, 3), bool))  # 16 vertices, 18 tets, z from 0 to 3


# A solve takes seconds to compile, and soft handles are another program.
EXACT_AND_SOFT = pytest.mark.parametrize("stiffness", [None, pytest.param(20.0, marks=pytest.mark.slow)])


def impostor_of(cage, dtype="float32"):
    config = ImpostorConfig(encoding=EncodingConfig(num_levels=1, log2_tet_table=3))
    return init_impostor(jax.random.key(0), build_tet_mesh(*cage, dtype=dtype), config)


@pytest.fixture(scope="module")
def column():
    return impostor_of(COLUMN)


def ends(cage=COLUMN):
    """Vertices of the two ends of the column."""
    z = cage[0][:, 2]
    return np.flatnonzero((z == z.min()) | (z == z.max()))


def strain_energy(rest, tets, moved):
    """The documented energy in NumPy, by SVD: squared distance of singular values from 1."""

    def edges(v):
        return np.swapaxes(v[tets[:, 1:]] - v[tets[:, :1]], 1, 2)

    F = edges(moved) @ np.linalg.inv(edges(rest))
    volumes = np.linalg.det(edges(rest))
    stretches = np.linalg.svd(F, compute_uv=False)
    stretches[:, 2] *= np.sign(np.linalg.det(F))
    return np.sum(volumes * np.sum((stretches - 1) ** 2, axis=1)) / volumes.sum()


@pytest.mark.parametrize("name", ["one_tet", "delaunay"])
def test_a_rigid_motion_of_the_handles_moves_everything(name):
    impostor = impostor_of(MESHES[name]())
    rest = world_vertices(impostor.mesh)
    inside = rest[np.asarray(impostor.mesh.tets)[0]].mean(axis=0)
    handles = make_handles(impostor.mesh, vertices=[0, 1, 3], points=[inside])
    at_rest = np.stack([*rest[[0, 1, 3]], inside])
    moved, status = fit_cage(impostor, handles, at_rest @ ROTATION.T + SHIFT)
    # float32: a hundred roundings of coordinates up to 6 (the best rigid start is nearly exact by itself).
    np.testing.assert_allclose(world_vertices(moved.mesh), rest @ ROTATION.T + SHIFT, atol=5e-5)
    assert status.converged and status.num_inverted == 0 and status.energy < 1e-8
    assert moved.tables is impostor.tables


def test_targets_at_rest_change_nothing(column):
    handles = make_handles(column.mesh, vertices=ends())
    moved, status = fit_cage(column, handles, world_vertices(column.mesh)[ends()])
    # To the mesh's frame and back: a few float32 roundings of coordinates up to 3.
    np.testing.assert_allclose(world_vertices(moved.mesh), world_vertices(column.mesh), atol=2e-6)
    assert status.converged


def test_gradients_at_rest(column):
    """Where all stretches are equal a second derivative of the rotation would not exist."""
    handles = make_handles(column.mesh, vertices=ends())
    rest = jnp.asarray(world_vertices(column.mesh)[ends()], jnp.float32)

    def total(targets):
        return jnp.sum(column.mesh.scale * fit_cage(column, handles, targets)[0].mesh.vertices, axis=0)

    gradient = jax.jacrev(total)(rest)
    # A translation of all targets moves all 16 vertices by as much; conjugate gradients stop at 1e-5.
    np.testing.assert_allclose(jnp.sum(gradient, axis=1), 16 * np.eye(3), atol=2e-3)


def test_two_handles_and_one_move_without_strain(column):
    """Rotations that one or two handles leave open are decided without NaN and without strain."""
    rest = world_vertices(column.mesh)
    length = np.linalg.norm(rest[15] - rest[0])
    for ids, targets in (([0], [[5, 5, 5]]), ([0, 15], [[0, 0, 0], [length, 0, 0]])):
        handles = make_handles(column.mesh, vertices=ids)
        moved, status = fit_cage(column, handles, np.array(targets, float))
        assert status.converged and status.energy < 1e-8  # squared strains of 1e-4: rounding and the stop
        np.testing.assert_allclose(world_vertices(moved.mesh)[ids], targets, atol=1e-5)  # float32, size 5


@EXACT_AND_SOFT
def test_the_result_is_a_minimum(x64, stiffness):
    """No small change of free vertices lowers the energy, which an SVD computes here."""
    impostor = impostor_of(COLUMN, "float64")
    mesh = impostor.mesh
    rest, tets, scale = world_vertices(mesh), np.asarray(mesh.tets), float(mesh.scale)
    ids = ends()
    targets = rest[ids] + np.where(rest[ids, 2:] > 1, [0.7, 0.0, 0.2], 0.0)
    moved, status = fit_cage(impostor, make_handles(mesh, vertices=ids), targets, stiffness=stiffness)
    found = world_vertices(moved.mesh)

    def objective(vertices):
        pull = 0.0 if stiffness is None else stiffness * np.sum((vertices[ids] - targets) ** 2) / scale**2
        return strain_energy(rest, tets, vertices) + pull

    # Two formulas in float64; the frame's centre and scale round at 1e-16 of coordinates.
    np.testing.assert_allclose(status.energy, strain_energy(rest, tets, found), rtol=1e-9)
    rng = np.random.default_rng(0)
    for _ in range(20):
        change = 1e-4 * rng.normal(size=rest.shape)
        if stiffness is None:
            change[ids] = 0
        # Quadratic growth alone: 1e-8 times the curvature; a slope above 1e-5 would show.
        assert objective(found + change) > objective(found)
        assert objective(found - change) > objective(found)


@EXACT_AND_SOFT
def test_gradients_match_finite_differences(x64, stiffness):
    impostor = impostor_of(COLUMN, "float64")
    rest = world_vertices(impostor.mesh)
    middle = rest[np.asarray(impostor.mesh.tets)[8]].mean(axis=0)
    handles = make_handles(impostor.mesh, vertices=ends(), points=[middle])
    at_rest = np.concatenate([rest[ends()], [middle]])
    targets = jnp.asarray(at_rest + np.random.default_rng(1).normal(size=at_rest.shape) * 0.1)
    probe = jnp.asarray(np.random.default_rng(2).normal(size=rest.shape))

    def height(targets, rest_vertices):
        mesh = impostor.mesh.replace(vertices=rest_vertices)
        moved, _ = fit_cage(impostor.replace(mesh=mesh), handles, targets, stiffness=stiffness)
        return jnp.sum(probe * moved.mesh.vertices)

    arguments = targets, impostor.mesh.vertices
    gradients = jax.grad(height, argnums=(0, 1))(*arguments)
    for which, gradient in enumerate(gradients):
        direction = jnp.asarray(np.random.default_rng(3).normal(size=gradient.shape))
        step = 1e-4
        ends_of_step = [list(arguments), list(arguments)]
        ends_of_step[0][which] += step * direction
        ends_of_step[1][which] -= step * direction
        numeric = (height(*ends_of_step[0]) - height(*ends_of_step[1])) / (2 * step)
        # Differences: 1e-8 of curvature, and what the solver leaves (1e-9) over the step.
        np.testing.assert_allclose(jnp.sum(gradient * direction), numeric, rtol=1e-4)


def test_soft_handles_become_exact(column):
    ids = ends()
    rest = world_vertices(column.mesh)[ids]
    targets = rest + np.where(rest[:, 2:] > 1, [1.0, 0.0, 0.0], 0.0)
    handles = make_handles(column.mesh, vertices=ids)
    exact, status = fit_cage(column, handles, targets)
    np.testing.assert_allclose(world_vertices(exact.mesh)[ids], targets, atol=2e-6)  # float32, size 3
    errors = []
    for stiffness in (1.0, 100.0, 10000.0):
        soft, status = fit_cage(column, handles, targets, stiffness=stiffness)
        errors.append(float(status.handle_error))
    # Like 1 / stiffness.
    assert errors[0] > 0.02 and errors[1] < errors[0] / 20 and errors[2] < errors[1] / 20
    # The miss at 10,000, and the solver's stop.
    np.testing.assert_allclose(world_vertices(soft.mesh), world_vertices(exact.mesh), atol=1e-3)


def test_points_within_tets_are_met(column):
    rest = world_vertices(column.mesh)
    lambdas = np.array([[0.1, 0.2, 0.3, 0.4]])
    tet = np.asarray(column.mesh.tets)[17]
    points = [[0.5, 0.4, 0.2]]
    handles = make_handles(column.mesh, vertices=[0], points=points, tets=[17], lambdas=lambdas)
    assert len(handles) == 3
    targets = np.array([rest[0], lambdas[0] @ rest[tet] + [0.3, 0, 0.1], [0.5, 0.5, 0.3]])
    moved, status = fit_cage(column, handles, targets)
    np.testing.assert_allclose(lambdas[0] @ world_vertices(moved.mesh)[tet], targets[1], atol=2e-6)  # float32
    assert status.converged and status.handle_error < 2e-6


def test_forced_inversion_is_data(column):
    """One end pushed through the other: inverted tets are counted, and everything is finite."""
    rest = world_vertices(column.mesh)
    ids = ends()
    targets = rest[ids] + np.where(rest[ids, 2:] > 1, [0.0, 0.0, -6.0], 0.0)
    handles = make_handles(column.mesh, vertices=ids)
    moved, status = fit_cage(column, handles, targets)
    assert np.isfinite(world_vertices(moved.mesh)).all() and status.num_inverted > 0
    assert status.handle_error < 1e-5

    def size(targets):
        return jnp.sum(fit_cage(column, handles, targets)[0].mesh.vertices ** 2)

    flat = jnp.asarray(targets * [1.0, 1.0, 0.0], jnp.float32)  # both ends in one plane
    moved, _ = fit_cage(column, handles, flat)
    assert np.isfinite(world_vertices(moved.mesh)).all() and np.isfinite(jax.grad(size)(flat)).all()


def test_inverted_start_recovers(column):
    """The energy pushes inverted tets back: a start that is turned inside out ends where rest does."""
    rest = world_vertices(column.mesh)
    handles = make_handles(column.mesh, vertices=ends())
    start = rest.copy()
    middle = np.setdiff1d(np.arange(len(rest)), ends())
    start[middle, 2] = 3 - start[middle, 2]
    moved, status = fit_cage(column, handles, rest[ends()], start=start)
    assert status.num_inverted == 0 and status.converged
    np.testing.assert_allclose(world_vertices(moved.mesh), rest, atol=1e-4)  # the solver's stop, size 3


def test_under_jit_without_compiling_again(column):
    handles = make_handles(column.mesh, vertices=ends())
    rest = jnp.asarray(world_vertices(column.mesh)[ends()], jnp.float32)
    traces = []

    @jax.jit
    def fitted(targets):
        traces.append(1)
        moved, status = fit_cage(column, handles, targets)
        return moved.mesh.vertices, status

    before = fitted(rest)[1]
    vertices, status = fitted(rest + 1)
    assert len(traces) == 1 and before.converged and status.converged
    fit_cage(column, handles, rest)
    count = _solve._cache_size()
    outside = fit_cage(column, handles, rest + 1)[0].mesh.vertices
    assert _solve._cache_size() == count
    np.testing.assert_allclose(outside, vertices, atol=1e-5)  # the same steps, other roundings
    vertices, status = fitted(rest.at[2, 0].set(jnp.nan))
    assert not status.converged and np.isfinite(vertices).all()
    assert len(traces) == 1


def test_too_few_steps_are_not_called_converged(column):
    handles = make_handles(column.mesh, vertices=ends())
    rest = world_vertices(column.mesh)[ends()]
    targets = rest + np.where(rest[:, 2:] > 1, [1.0, 1.0, 0.0], 0.0)
    _, status = fit_cage(column, handles, targets, max_steps=2)
    assert not status.converged and status.num_steps == 2 and status.residual > 1e-4


def test_errors_name_the_first(column):
    mesh = column.mesh
    for message, arguments in {
        "no handles": {},
        "vertex 16 does not exist; there are 16": {"vertices": [3, 16]},
        "vertex 3 is a handle twice": {"vertices": [3, 1, 3]},
        "vertex ids must be integers": {"vertices": [0.5]},
        "tet -1 does not exist": {"tets": [-1], "lambdas": [[1, 0, 0, 0]]},
        "1 tets and 0 rows": {"tets": [1]},
        "material point 1 do not sum to 1": {"tets": [0, 1], "lambdas": [[1, 0, 0, 0], [1, 1, 0, 0]]},
        r"1 of 2 handle points are not inside the cage; first: point 1 at \[9": {
            "points": [[0.5, 0.4, 0.2], [9, 9, 9]]
        },
        "point 0 at .nan": {"points": [[np.nan, 0, 0]]},
    }.items():
        with pytest.raises(ValueError, match=message):
            make_handles(mesh, **arguments)
    handles = make_handles(mesh, vertices=[0, 5])
    targets = np.zeros((2, 3))
    with pytest.raises(ValueError, match=r"targets must have shape \(2, 3\), got \(3, 3\)"):
        fit_cage(column, handles, np.zeros((3, 3)))
    with pytest.raises(ValueError, match="1 of 2 targets are not finite; first: number 1"):
        fit_cage(column, handles, np.array([[0, 0, 0], [0, np.inf, 0]]))
    with pytest.raises(ValueError, match="stiffness must be > 0"):
        fit_cage(column, handles, targets, stiffness=-1.0)
    with pytest.raises(ValueError, match=r"start must have shape \(16, 3\)"):
        fit_cage(column, handles, targets, start=targets)


# Handles with falloff


def test_drag_moves_the_centre_and_nothing_outside():
    center, shift = np.array([0.3, -0.2, 0.1]), np.array([0.1, 0.2, 0.0])
    move = drag(center, 1.0, shift, np.array([0.0, 0.0, np.pi / 2]))
    points = jnp.asarray(center + np.array([[0, 0, 0], [1.0, 0, 0], [0, 5, 0], [0, 0, 0.5]]))
    moved = np.asarray(move(points))
    np.testing.assert_allclose(moved[0], center + shift, atol=1e-6)  # float32
    np.testing.assert_array_equal(moved[1:3], points[1:3])
    # On the axis the rotation does nothing, and (1 - 1/4)^3 of the translation is left.
    np.testing.assert_allclose(moved[3], center + np.array([0, 0, 0.5]) + 0.75**3 * shift, atol=1e-6)


def test_drag_turns_by_the_weight():
    move = drag(np.zeros(3), 1.0, np.zeros(3), np.array([0.0, 0.0, 1.2]))
    angle = 1.2 * 0.75**3
    np.testing.assert_allclose(  # float32
        move(jnp.array([[0.5, 0.0, 0.0]])), [[0.5 * np.cos(angle), 0.5 * np.sin(angle), 0.0]], atol=1e-6
    )


def test_drag_is_differentiable_at_the_identity():
    def moved(translation, turn):
        return drag(jnp.zeros(3), 1.0, translation, turn)(jnp.array([[0.5, 0.0, 0.0]]))[0]

    by_shift, by_turn = jax.jacobian(moved, argnums=(0, 1))(jnp.zeros(3), jnp.zeros(3))
    weight = 0.75**3  # exact derivatives, float32
    np.testing.assert_allclose(by_shift, weight * np.eye(3), atol=1e-6)
    np.testing.assert_allclose(by_turn, weight * np.array([[0, 0, 0], [0, 0, 0.5], [0, -0.5, 0]]), atol=1e-6)
    with pytest.raises(ValueError, match="radius must be > 0"):
        drag(np.zeros(3), 0.0, np.zeros(3), np.zeros(3))
    with pytest.raises(ValueError, match="translation must be finite"):
        drag(np.zeros(3), 1.0, np.full(3, np.nan), np.zeros(3))
