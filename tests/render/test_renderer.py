"""render.renderer: the picture as a function of scene, camera and parameters, and its gradients."""

import dataclasses
import functools

import chex
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import scenes
from meshes import local_vertices
from numpy.testing import assert_allclose, assert_array_equal
from rays import as_rays, generic, missing
from scenes import RENDER, constant_density, exact

from nimpostor_jax.encoding.spherical_harmonics import spherical_harmonics
from nimpostor_jax.field import impostor as field
from nimpostor_jax.render.camera import image_pixels, pixel_rays, to_local
from nimpostor_jax.render.renderer import decode_integrated, ray_output, render_rays

COUNT = 16
render = jax.jit(render_rays, static_argnames="config")


def rays_at(impostor, kind=generic, seed=0):
    """World rays for a mesh, NumPy."""
    mesh = impostor.mesh
    origins, directions = kind(*local_vertices(mesh), np.random.default_rng(seed), COUNT)
    return np.asarray(mesh.center) + float(mesh.scale) * origins, directions


def logistic(x):
    return 1 / (1 + np.exp(-x))


def mlp(layers, x):
    for layer in layers[:-1]:
        x = np.maximum(x @ np.asarray(layer["weight"][0]) + np.asarray(layer["bias"][0]), 0)
    return x @ np.asarray(layers[-1]["weight"][0]) + np.asarray(layers[-1]["bias"][0])


def render_loop(impostor, config, origin, direction):
    """One ray in plain loops: brute-force segments, equal barycentric steps, the oracles' field.

    Colours are decoded at each sample, or once from the mean feature (Eq. 10), as the config says.
    """
    vertices, tets = local_vertices(impostor.mesh)
    segments = oracles.ray_segments(vertices, tets, origin, direction)
    extents = np.array([np.abs(s[4] - s[3]).sum() for s in segments])
    if not len(segments):
        return np.zeros(3), 0.0, 0.0
    count = int(np.ceil(extents.sum() / config.sampler.step))
    delta, ends = extents.sum() / count, np.cumsum(extents)
    sigmas, colors, points, ts = [], [], [], []
    view = np.asarray(spherical_harmonics(jnp.asarray(direction), impostor.config.decoder.sh_degree))
    for i in range(count):
        position = (i + 0.5) * delta
        k = int(np.searchsorted(ends, position, side="right"))
        share = (position - (ends[k] - extents[k])) / extents[k]
        low, high, tet, enter, leave = segments[k]
        point = oracles.encode(
            impostor.tables.features,
            impostor.tables.layout,
            impostor.config.encoding,
            tet,
            enter + share * (leave - enter),
        )
        sigmas.append(np.exp(mlp(impostor.decoders["density"], point)[0]))
        points.append(point)
        colors.append(logistic(mlp(impostor.decoders["appearance"], np.append(point, view))))
        ts.append(low + share * (high - low))
    weights = oracles.composite(sigmas, np.full(count, delta))
    opacity = weights.sum()
    color = weights @ np.array(colors)
    if config.integrate == "features":
        mean = weights @ np.array(points) / opacity
        color = opacity * logistic(mlp(impostor.decoders["appearance"], np.append(mean, view)))
    return color, opacity, weights @ np.array(ts) / opacity * float(impostor.mesh.scale)


@pytest.mark.parametrize("integrate", ["color", "features"])
def test_agrees_with_a_loop_over_samples(integrate, x64):
    impostor = scenes.impostor("blobs", "float64")
    config = dataclasses.replace(
        exact(max_samples_per_ray=64, integrate=integrate),
        march=dataclasses.replace(RENDER.march, max_tets_per_ray=24, max_entries_per_ray=3),
    )
    rays = rays_at(impostor)
    output = render(impostor, as_rays(rays, "float64"), config)
    local = to_local(impostor.mesh, as_rays(rays, "float64"))
    assert not np.any(output.overflow | output.coarsened)
    for ray in range(COUNT):
        color, opacity, depth = render_loop(
            impostor, config, np.asarray(local.origins[ray]), np.asarray(local.directions[ray])
        )
        assert_allclose(output.opacity[ray], opacity, atol=1e-9)  # a few hundred float64 operations
        assert_allclose(output.color[ray], color, atol=1e-9)
        assert_allclose(output.depth[ray], depth, atol=1e-8)
    assert np.std(output.opacity) > 0.05


def test_without_a_step_the_fields_cells_say_how_long_it_is():
    impostor = scenes.impostor()
    assert max(impostor.config.encoding.resolutions) == 3  # two cells are more than the most of a step, 1/2
    rays = as_rays(rays_at(impostor))
    fitted = render(impostor, rays, exact(step=None))
    assert jax.tree.all(jax.tree.map(np.array_equal, fitted, render(impostor, rays, exact(step=0.5))))


def test_rays_that_miss_are_exactly_transparent():
    impostor = scenes.impostor()
    output = render(impostor, as_rays(rays_at(impostor, missing)), RENDER)
    for value in (output.color, output.opacity, output.depth):
        assert_array_equal(value, np.zeros_like(value))


@pytest.mark.parametrize("measure", ["barycentric", "euclidean"])
def test_constant_density_has_the_analytic_opacity(measure, x64):
    """1 - exp(-sigma * measure of the ray): Eq. 9's barycentric distance or Eq. 8's length."""
    bias = -0.4
    impostor = constant_density(scenes.impostor(dtype="float64"), bias)
    rays = rays_at(impostor)
    # Equal measures for steps and density: intervals sum to the ray's measure exactly.
    output = render(impostor, as_rays(rays, "float64"), exact(measure=measure, density_measure=measure))
    for ray in range(COUNT):
        origin = (rays[0][ray] - np.asarray(impostor.mesh.center)) / float(impostor.mesh.scale)
        segments = oracles.ray_segments(*local_vertices(impostor.mesh), origin, rays[1][ray])
        if measure == "barycentric":
            total = sum(np.abs(s[4] - s[3]).sum() for s in segments)
        else:
            total = sum(s[1] - s[0] for s in segments)
        assert_allclose(output.opacity[ray], -np.expm1(-np.exp(bias) * total), atol=1e-10)


def test_integrated_features_are_decoded_once_for_each_decoder_set(x64):
    """With constant colours, a ray's is their mean by weight, whichever way it is integrated."""
    impostor = scenes.impostor("blobs", "float64")
    decoders = jax.tree.map(lambda x: jnp.concatenate([x, x]), impostor.decoders)
    last = jax.tree.map(jnp.zeros_like, decoders["appearance"][-1])
    last["bias"] += jnp.array([[0.5, -1.0, 2.0], [-2.0, 0.3, 0.0]])
    decoders["appearance"] = [*decoders["appearance"][:-1], last]
    index = jnp.arange(len(impostor.mesh.tets), dtype=jnp.int32) % 2
    mixed = impostor.replace(decoders=decoders, decoder_index=index)
    rays = as_rays(rays_at(mixed), "float64")
    outputs = [render(mixed, rays, exact(integrate=way)) for way in ("color", "features")]
    assert_allclose(outputs[0].color, outputs[1].color, atol=1e-12)
    assert np.std(np.asarray(outputs[0].color) / np.asarray(outputs[0].opacity)[:, None], axis=0).min() > 0.01


@pytest.mark.parametrize("weight", [1e-3, 1e-20, 1e-37, 0.0])
def test_next_to_no_weight_has_a_finite_slope(weight):
    """Decoding the mean of features, and depths, divide by it; what it adds to the picture is nothing."""
    made = scenes.impostor("cube")
    mean = jnp.asarray(np.random.default_rng(0).normal(size=made.config.encoding.feature_dim + 2))
    encoded = field.encode_directions(made, jnp.array([[0.6, 0.0, 0.8]]))

    def seen(weight):
        sums = (weight * mean.at[-2].set(1.0))[None]
        output = ray_output(
            decode_integrated(made.decoders, sums, encoded), jnp.float32(1), jnp.zeros(1, bool), None
        )
        return jnp.sum(output.color) + jnp.sum(output.depth)

    value, slope = jax.value_and_grad(seen)(jnp.float32(weight))
    assert np.isfinite(value) and np.isfinite(slope)


def flatten(tree):
    """A pytree of float arrays as one vector, and the way back."""
    return jax.flatten_util.ravel_pytree(tree)


GRADIENT_TARGETS = {
    "tables": lambda i, x: i.replace(tables=i.tables.replace(features=x)),
    "decoders": lambda i, x: i.replace(decoders=x),
    "vertices": lambda i, x: i.replace(mesh=i.mesh.replace(vertices=x)),
}


@functools.cache
def gradient_scene(integrate="color"):
    impostor = scenes.impostor(dtype="float64")
    camera = scenes.camera(4, 3, dtype="float64")
    mix = jnp.asarray(np.random.default_rng(2).normal(size=(12, 5)))

    def objective(impostor, matrix):
        rays = pixel_rays(camera.replace(camera_to_world=matrix), image_pixels(3, 4).reshape(-1, 2))
        output = render_rays(impostor, rays, exact(step=0.7, integrate=integrate))
        return jnp.sum(mix * jnp.column_stack([output.color, output.opacity, output.depth]))

    return impostor, camera, jax.jit(objective), jax.jit(jax.grad(objective, argnums=(0, 1), allow_int=True))


def check_directions(function, x, gradient, count=3):
    flat, unflatten = flatten(x)
    rng = np.random.default_rng(5)
    slope = flatten(gradient)[0]
    assert np.linalg.norm(slope) > 1e-3
    for _ in range(count):
        direction = jnp.asarray(rng.normal(size=flat.shape))
        expected = oracles.directional_difference(lambda v: function(unflatten(v)), flat, direction, 1e-6)
        # step^2 times third derivatives of order 100, and 1e-16 / 1e-6
        assert_allclose(jnp.vdot(slope, direction), expected, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("integrate", ["color", "features"])
@pytest.mark.parametrize("target", GRADIENT_TARGETS)
def test_gradients_match_finite_differences(target, integrate, x64):
    impostor, camera, objective, gradient = gradient_scene(integrate)
    by_impostor, _ = gradient(impostor, camera.camera_to_world)
    parts = {
        "tables": (impostor.tables.features, by_impostor.tables.features),
        "decoders": (impostor.decoders, by_impostor.decoders),
        "vertices": (impostor.mesh.vertices, by_impostor.mesh.vertices),
    }
    put = GRADIENT_TARGETS[target]
    check_directions(lambda x: objective(put(impostor, x), camera.camera_to_world), *parts[target])


def test_camera_gradient_matches_finite_differences(x64):
    impostor, camera, objective, gradient = gradient_scene()
    _, by_matrix = gradient(impostor, camera.camera_to_world)
    check_directions(lambda m: objective(impostor, m), camera.camera_to_world, by_matrix)


def test_gradients_of_an_opaque_scene_are_finite(x64):
    impostor, camera, _, gradient = gradient_scene()
    opaque = constant_density(impostor, 39.0)
    by_impostor, by_matrix = gradient(opaque, camera.camera_to_world)
    assert np.all(np.isfinite(by_matrix))
    for leaf in jax.tree.leaves(by_impostor):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.all(np.isfinite(leaf))


def rotation():
    q, _ = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def test_a_rigid_motion_of_cage_and_camera_changes_nothing(x64):
    impostor, q, shift = scenes.impostor("blobs", "float64"), rotation(), np.array([3.0, -1.0, 0.5])
    config = dataclasses.replace(
        exact(max_samples_per_ray=64),
        march=dataclasses.replace(RENDER.march, max_tets_per_ray=24, max_entries_per_ray=3),
    )
    origins, directions = rays_at(impostor)
    mesh = impostor.mesh
    moved = impostor.replace(
        mesh=mesh.replace(
            vertices=mesh.vertices @ q.T, center=jnp.asarray(q @ np.asarray(mesh.center) + shift)
        )
    )
    before = render(impostor, as_rays((origins, directions), "float64"), config)
    after = render(moved, as_rays((origins @ q.T + shift, directions @ q.T), "float64"), config)
    assert_allclose(after.opacity, before.opacity, atol=1e-10)
    assert_allclose(after.depth, before.depth, atol=1e-9)
    assert np.ptp(before.opacity) > 0.1


@pytest.mark.parametrize("scale, offset", [(1e-3, 0.0), (1e3, 0.0), (1.0, 1e3), (1e3, 1e3)])
def test_size_and_place_of_the_scene_change_nothing(scale, offset, x64):
    def picture(scale, offset):
        impostor = scenes.impostor(dtype="float64", scale=scale, offset=offset)
        camera = scenes.camera(4, 4, dtype="float64")
        matrix = camera.camera_to_world.at[:3, 3].multiply(scale).at[:3, 3].add(offset)
        rays = pixel_rays(camera.replace(camera_to_world=matrix), image_pixels(4, 4).reshape(-1, 2))
        return render(impostor, rays, dataclasses.replace(RENDER, near=0.9 * scale))

    expected, found = picture(1.0, 0.0), picture(scale, offset)
    # an offset of 1e3 costs 1e3 * 2^-53 in every position
    assert_allclose(found.color, expected.color, atol=1e-9)
    assert_allclose(found.opacity, expected.opacity, atol=1e-9)
    assert_allclose(found.depth / scale, expected.depth, atol=1e-9)
    assert np.ptp(expected.opacity) > 0.1


@pytest.mark.parametrize("scale, offset", [(1e-3, 0.0), (1e3, 0.0), (1.0, 1e3)])
def test_float32_pictures_do_not_depend_on_size_and_place_either(scale, offset):
    def opacity(scale, offset):
        impostor = constant_density(scenes.impostor(scale=scale, offset=offset), 0.0)
        camera = scenes.camera(4, 4)
        matrix = camera.camera_to_world.at[:3, 3].multiply(scale).at[:3, 3].add(offset)
        rays = pixel_rays(camera.replace(camera_to_world=matrix), image_pixels(4, 4).reshape(-1, 2))
        return np.asarray(render(impostor, rays, RENDER).opacity)

    # float32 holds a camera at 1e3 to 3e-5 of the cage's size; near a vertex, opacity follows at that rate
    assert_allclose(opacity(scale, offset), opacity(1.0, 0.0), atol=2e-3 if offset else 1e-4)


def test_invisible_samples_may_be_left_out():
    impostor = constant_density(scenes.impostor(), 2.0)
    rays = as_rays(rays_at(impostor))
    expected = render(impostor, rays, RENDER)
    found = render(impostor, rays, dataclasses.replace(RENDER, min_weight=1e-4))
    # at most 16 samples of 1e-4 are missing
    assert_allclose(found.opacity, expected.opacity, atol=2e-3)
    assert_allclose(found.color, expected.color, atol=2e-3)


@pytest.mark.parametrize("min_weight", [0.0, 1e-4])
def test_no_rays_give_no_colours(min_weight):
    nothing, impostor = as_rays((np.zeros((0, 3)), np.zeros((0, 3)))), scenes.impostor()
    config = dataclasses.replace(RENDER, min_weight=min_weight)
    output = render(impostor, nothing, config)
    assert output.color.shape == (0, 3)
    assert output.overflow.shape == (0,)
    moved = jax.grad(lambda i: jnp.sum(render(i, nothing, config).color), allow_int=True)(impostor)
    assert not np.any(moved.mesh.vertices) and not np.any(moved.tables.features)


def test_overflow_and_coarsening_reach_the_output():
    impostor = scenes.impostor()
    rays = as_rays(rays_at(impostor))
    march = dataclasses.replace(RENDER.march, max_tets_per_ray=1)
    assert np.any(render(impostor, rays, dataclasses.replace(RENDER, march=march)).overflow)
    crowded = render(impostor, rays, exact(max_samples_per_ray=3, capacity_per_ray=2))
    assert np.any(crowded.overflow)
    assert np.any(crowded.coarsened)
    good = render(impostor, rays, RENDER)
    assert not np.any(good.overflow | good.coarsened)


def test_nothing_recompiles_when_values_change():
    impostor = scenes.impostor()
    counted = jax.jit(chex.assert_max_traces(render_rays, n=1), static_argnames="config")
    for turn in range(4):
        moved = impostor.replace(
            mesh=impostor.mesh.replace(vertices=impostor.mesh.vertices * (1 + 0.1 * turn)),
            decoders=jax.tree.map(lambda x, t=turn: x + t, impostor.decoders),
        )
        camera = scenes.camera(4, 4, position=(2.0 + turn, 1.0, 2.0))
        rays = pixel_rays(camera, image_pixels(4, 4).reshape(-1, 2))
        jax.block_until_ready(counted(moved, rays, exact()))
