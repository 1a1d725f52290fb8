"""edit.compose and overlapping tets: a float64 loop over objects, sorted by depth, is the oracle."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from meshes import MESHES
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from nimpostor_jax.config import EncodingConfig
from nimpostor_jax.edit.compose import compose, object_tets
from nimpostor_jax.edit.deform import deform, deformation_report
from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.field import impostor as field
from nimpostor_jax.field.impostor import init_impostor
from nimpostor_jax.geometry.topology import build_tet_mesh, world_vertices
from nimpostor_jax.io.impostor_file import load_impostor, save_impostor
from nimpostor_jax.render.camera import image_pixels, pixel_rays
from nimpostor_jax.render.renderer import render_rays, render_samples

CONFIG = dataclasses.replace(
    scenes.exact(max_samples_per_ray=64),
    march=dataclasses.replace(scenes.RENDER.march, max_tets_per_ray=64, max_entries_per_ray=12),
)
render = jax.jit(render_rays, static_argnames="config")
sample = jax.jit(render_samples, static_argnames="config")


def rays_of(width=16, height=12, dtype="float32"):
    camera = scenes.camera(width, height, dtype=dtype)
    return pixel_rays(camera, image_pixels(height, width).reshape(-1, 2).astype(dtype))


def placed(seed, shift=0.3):
    """A similarity near the identity: objects overlap, and no two alike."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rng.normal(size=3)).as_matrix() * rng.uniform(0.7, 1.2)
    matrix[:3, 3] = rng.uniform(-shift, shift, 3)
    return matrix


def assert_same_picture(found, expected, atol):
    for name in ("color", "opacity"):
        assert_allclose(getattr(found, name), getattr(expected, name), atol=atol)


@pytest.mark.parametrize("integrate", ["color", "features"])
def test_one_impostor_composed_is_itself(integrate):
    made, rays = scenes.impostor("delaunay"), rays_of()
    config = dataclasses.replace(CONFIG, integrate=integrate)
    composed = compose([made])
    expected = render(made, rays, config)
    assert np.std(expected.opacity) > 0.05
    # The mesh's frame is computed anew, from float32 vertices.
    assert_same_picture(render(composed, rays, config), expected, 1e-5)


@jax.jit
def decoded(impostor, tets, lambdas, directions):
    """Densities and colours at points of an impostor."""
    features = field.features(impostor, tets, lambdas)
    views = field.encode_directions(impostor, directions)
    return field.density(impostor, tets, features), field.radiance(impostor, tets, features, views)


@pytest.mark.parametrize("count", [pytest.param(2, marks=pytest.mark.slow), 10])
def test_overlapping_objects_are_merged_by_depth(count, x64):
    """Against a float64 loop over all of a ray's samples by depth, each decoded by its own impostor."""
    kinds = ["blobs", "delaunay", "cube"]
    made = [scenes.impostor(kinds[i % 3], "float64", seed=i) for i in range(count)]
    composed = compose(made, [placed(i + 3) for i in range(count)])
    rays = rays_of(8, 6, "float64")
    march = dataclasses.replace(CONFIG.march, max_tets_per_ray=160, max_entries_per_ray=64)
    config = dataclasses.replace(CONFIG, march=march)
    output, samples = sample(composed, rays, config)
    assert not output.overflow.any()
    used = int(samples.num_used)
    tets, lambdas, t, owners = (
        np.asarray(x)[:used] for x in (samples.tet_ids, samples.lambdas, samples.t, samples.rays)
    )
    sigma, color = np.zeros(used), np.zeros((used, 3))
    first = 0
    for each in made:
        mine = (tets >= first) & (tets < first + len(each.mesh.tets))
        own = decoded(each, np.where(mine, tets - first, 0), lambdas, rays.directions[owners])
        sigma[mine], color[mine] = (np.asarray(x)[mine] for x in own)
        first += len(each.mesh.tets)
    expected, left = np.zeros((len(output.opacity), 3)), np.ones(len(output.opacity))
    for k in np.lexsort((t, owners)):
        alpha = -np.expm1(-sigma[k] * float(samples.deltas[k]))
        expected[owners[k]] += left[owners[k]] * alpha * color[k]
        left[owners[k]] *= 1 - alpha
    assert_allclose(output.color, expected, atol=1e-9)
    assert_allclose(output.opacity, 1 - left, atol=1e-9)
    objects = np.asarray(composed.mesh.object_ids)[tets]
    switches = np.sum((np.diff(objects) != 0) & (np.diff(owners) == 0))
    assert switches > 4 * count  # objects did overlap, and not just follow each other


@pytest.mark.slow
def test_optical_depths_of_overlapping_objects_add_up():
    """Constant densities: what lets light through is the product, up to steps that straddle two objects."""
    made = [scenes.constant_density(scenes.impostor("blobs", seed=i), i - 2.0) for i in range(3)]
    transforms = [placed(i) for i in range(3)]
    rays, config = rays_of(), dataclasses.replace(scenes.exact(step=0.05, max_samples_per_ray=512))
    config = dataclasses.replace(config, march=CONFIG.march)
    together = render(compose(made, transforms), rays, config).opacity
    alone = [render(compose([x], [m]), rays, config).opacity for x, m in zip(made, transforms, strict=True)]
    # half a step, 0.025, times a difference of densities of up to 0.9, a few times a ray
    assert_allclose(1 - together, np.prod([1 - np.asarray(x) for x in alone], axis=0), atol=0.02)
    assert np.std(together) > 0.1


def test_self_overlap_after_a_deformation_is_merged():
    """Two blobs of one object, pushed into each other."""
    made = scenes.impostor("blobs")
    world = world_vertices(made.mesh)
    middle = np.median(world[:, 0])
    squeezed = deform(made, lambda x: x.at[:, 0].add(jnp.where(x[:, 0] > middle, -0.4, 0.4)))
    _, samples = sample(squeezed, rays_of(), CONFIG)
    used = int(samples.num_used)
    owners, t = np.asarray(samples.rays)[:used], np.asarray(samples.t)[:used]
    assert np.all((np.diff(t) >= 0) | (np.diff(owners) > 0))


def test_nesting_and_saving_change_nothing(tmp_path):
    made = [scenes.impostor(name, seed=i) for i, name in enumerate(["blobs", "delaunay", "cube"])]
    flat = compose(made, [placed(i) for i in range(3)])
    pair = compose(made[1:], [placed(1), placed(2)])
    nested = compose([made[0], pair], [placed(0), None])
    rays = rays_of()
    assert_array_equal(np.unique(nested.mesh.object_ids), [0, 1, 2])
    expected = render(flat, rays, CONFIG)
    assert_same_picture(render(nested, rays, CONFIG), expected, 2e-5)  # two frames, each rounded
    save_impostor(tmp_path / "flat.npz", flat)
    assert_array_equal(render(load_impostor(tmp_path / "flat.npz"), rays, CONFIG).color, expected.color)


@pytest.mark.parametrize(
    "layout, interpolation",
    [
        ("per_simplex", "simplex"),
        pytest.param("per_tet", "simplex", marks=pytest.mark.slow),
        pytest.param("per_simplex", "grid", marks=pytest.mark.slow),
    ],
)
def test_levels_and_table_sizes_may_differ(layout, interpolation):
    """A level dense in one and hashed in the other, and one that the other does not have."""

    def made(name, levels, log2, seed):
        encoding = EncodingConfig(
            num_levels=levels, growth=2.0, log2_tet_table=log2, layout=layout, interpolation=interpolation
        )
        config = dataclasses.replace(scenes.FIELD, encoding=encoding)
        impostor = init_impostor(jax.random.key(seed), build_tet_mesh(*MESHES[name]()), config)
        rng = np.random.default_rng(seed)
        features = jnp.asarray(rng.normal(size=impostor.tables.features.shape), jnp.float32)
        decoders = jax.tree.map(
            lambda x: jnp.asarray(0.7 * rng.normal(size=x.shape), x.dtype), impostor.decoders
        )
        tables = dataclasses.replace(impostor.tables, features=features)
        return dataclasses.replace(impostor, tables=tables, decoders=decoders)

    pair = made("blobs", 5, 9, 0), made("cube", 3, 4, 1)
    far = np.eye(4)
    far[0, 3] = 50.0  # out of sight: each is seen alone
    rays = rays_of()
    for i, each in enumerate(pair):
        for order in (1, -1):
            transforms = [None if k == i else far for k in range(2)]
            composed = compose(pair[::order], transforms[::order])
            assert composed.tables.layout.num_mixed > 0
            expected = render(each, rays, CONFIG)
            assert np.std(expected.color) > 0.01
            # The frame spans both: coordinates have the precision of the far one.
            assert_same_picture(render(composed, rays, CONFIG), expected, 2e-3)


def test_objects_are_found():
    composed = compose([scenes.impostor("cube"), scenes.impostor("blobs")])
    assert len(object_tets(composed, 0)) == len(scenes.impostor("cube").mesh.tets)
    with pytest.raises(ValueError, match=r"no object 2; objects: \[0, 1\]"):
        object_tets(composed, 2)


@pytest.mark.parametrize(
    "transforms, message",
    [
        ([None], "1 transforms for 2"),
        ([None, np.diag([1, 1, -1, 1])], "transform 1 mirrors"),
        ([np.full((4, 4), np.nan), None], "transform 0 must be"),
    ],
)
def test_bad_transforms_are_named(transforms, message):
    with pytest.raises(ValueError, match=message):
        compose([scenes.impostor("cube")] * 2, transforms)


def test_configs_that_cannot_be_mixed_are_named():
    made = scenes.impostor("cube")
    decoder = dataclasses.replace(made.config.decoder, sh_degree=1)
    other = dataclasses.replace(made, config=dataclasses.replace(made.config, decoder=decoder))
    with pytest.raises(ValueError, match="decoder sh_degree"):
        compose([made, other])


def test_inverted_tets_of_a_deformation_go_on_as_they_are():
    """They are the deformation's: what is made of its result neither refuses nor mends them."""
    made = scenes.impostor("delaunay")
    chosen = np.bincount(np.asarray(made.mesh.tets).reshape(-1)).argmax()
    pushed = deform(made, lambda points: points.at[chosen].add(2.0))
    count = deformation_report(pushed).num_inverted
    assert count > 0
    whole = compose([pushed, scenes.impostor("cube")])
    assert deformation_report(whole).num_inverted == count
    assert deformation_report(subdivide(pushed)).num_inverted == 8 * count
