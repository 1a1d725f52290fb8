"""render.baked and render.rasterize: textures on faces, marched and rasterized."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import scenes
from meshes import local_vertices
from numpy.testing import assert_allclose, assert_array_equal
from rays import as_rays, generic, missing
from scenes import exact, pushed_together
from scenes_baked import CHANNELS
from scenes_baked import baked as baked_scene

from nimpostor_jax.encoding.spherical_harmonics import spherical_harmonics
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.render import raster_frame
from nimpostor_jax.render.baked import lit_segments, render_baked_rays, shade_segments
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.frame import for_frames, frame_config, render_frame
from nimpostor_jax.render.raster_frame import rasterize_frame
from nimpostor_jax.render.segments import march_segments
from nimpostor_jax.types import TetMesh

COUNT = 16
MARCH = dataclasses.replace(exact().march, max_tets_per_ray=24, max_entries_per_ray=3)
CONFIG = dataclasses.replace(exact(), march=MARCH)
TABLES = ("depths", "opacities", "textures")
render = jax.jit(render_baked_rays, static_argnames="config")


def rays_at(impostor, kind=generic, seed=0):
    """World rays for a mesh."""
    origins, directions = kind(*local_vertices(impostor.mesh), np.random.default_rng(seed), COUNT)
    center, scale = np.asarray(impostor.mesh.center), float(impostor.mesh.scale)
    return as_rays((center + scale * origins, directions), impostor.mesh.vertices.dtype)


def texel_lookup(tables, tet, face, place, leave):
    """The numbers at a point of a face, by loops: three texels, four basis functions."""
    layout, values = tables.layout, np.asarray(tables.features, np.float64)
    n, start = int(layout.resolutions[tet, face]), int(layout.starts[tet, face])
    a, b, _ = (place[i] for i in FACES[face])
    scaled = n * np.array([a, a + b])
    low = np.clip(np.floor(scaled), 0, n - 1).astype(int)
    f = scaled - low
    order = [1, 0] if f[1] >= f[0] else [0, 1]
    node, total = low.copy(), 0
    ends = [1, *f[order], 0]
    for step in range(3):
        total = total + (ends[step] - ends[step + 1]) * values[start + node[1] * (node[1] + 1) // 2 + node[0]]
        if step < 2:
            node[order[step]] += 1
    return leave @ total.reshape(4, -1)


def tet_lookup(baked, tet, enter, leave):
    """What one ray sees in one tet: opacity, share of the way, channels times opacity."""
    face = int(np.argmin(enter))
    share = min(texel_lookup(baked.depths, tet, face, enter, leave).item(), 1)
    point = enter + share * (leave - enter)
    point[face] = 0
    (opacity,) = texel_lookup(baked.opacities, tet, face, point / point.sum(), leave)
    return opacity, share, opacity * texel_lookup(baked.textures, tet, face, point / point.sum(), leave)


def mlp(layers, x, chosen):
    for layer in layers[:-1]:
        x = np.maximum(x @ np.asarray(layer["weight"][chosen]) + np.asarray(layer["bias"][chosen]), 0)
    return x @ np.asarray(layers[-1]["weight"][chosen]) + np.asarray(layers[-1]["bias"][chosen])


@pytest.mark.parametrize(
    ("overlapping", "least", "num_sets", "depth"),
    [
        (False, 0.0, 1, (0.0, 1.0)),
        (True, 0.0, 1, (0.0, 1.0)),
        (False, 0.05, 2, (0.0, 1.0)),
        (True, 0.05, 2, (0.0, 1.0)),
        (False, 0.0, 1, (1.1, 2.0)),  # at the exit: the place is on the edge of two faces
    ],
)
def test_agrees_with_a_loop_over_tets(overlapping, least, num_sets, depth, x64):
    """Where tets overlap, what is seen first comes first. What contributes little is left out."""
    baked = baked_scene(dtype="float64", opacity=(0.05, 0.95), depth=depth, num_sets=num_sets)
    baked = pushed_together(baked) if overlapping else baked
    rays = rays_at(baked)
    output = render(baked, rays, dataclasses.replace(CONFIG, min_weight=least))
    vertices, tets = local_vertices(baked.mesh)
    center, scale = np.asarray(baked.mesh.center), float(baked.mesh.scale)
    left_out = 0
    for ray in range(COUNT):
        origin = (np.asarray(rays.origins[ray]) - center) / scale
        light, depth = 1.0, 0.0
        sums, weights = np.zeros((num_sets, CHANNELS)), np.zeros(num_sets)
        looked_up = []
        for low, high, tet, enter, leave in oracles.ray_segments(
            vertices, tets, origin, np.asarray(rays.directions[ray])
        ):
            seen, share, features = tet_lookup(baked, tet, enter, leave)
            looked_up.append((low + share * (high - low), seen, features, tet % num_sets))
        for t, seen, features, chosen in sorted(looked_up, key=lambda part: part[0]):
            if light * seen >= least:
                sums[chosen] += light * features
                weights[chosen] += light * seen
                depth += light * seen * t
            else:
                left_out += 1
            light *= 1 - seen
        view = np.asarray(spherical_harmonics(rays.directions[ray], baked.config.decoder.sh_degree))
        color, opacity = np.zeros(3), weights.sum()
        for chosen in np.flatnonzero(weights):
            inputs = np.append(sums[chosen] / weights[chosen], view)
            color += weights[chosen] / (1 + np.exp(-mlp(baked.decoders["appearance"], inputs, chosen)))
        # a few hundred float64 operations
        assert_allclose(output.opacity[ray], opacity, atol=1e-9)
        assert_allclose(output.color[ray], color, atol=1e-9)
        assert_allclose(output.depth[ray], depth / opacity * scale, atol=1e-8)
    assert np.std(output.opacity) > 0.01
    assert (left_out > COUNT) == (least > 0)


@pytest.mark.parametrize("overlapping", [False, True])
def test_segments_that_no_light_reaches_change_nothing(overlapping, x64):
    baked = baked_scene(dtype="float64", opacity=(0.3, 0.95))
    baked = pushed_together(baked) if overlapping else baked
    config = dataclasses.replace(CONFIG, min_weight=0.05)
    local = to_local(baked.mesh, rays_at(baked))
    segments = jax.jit(lambda rays: march_segments(baked.mesh, rays, config))(local)
    lit, _, count = jax.jit(lit_segments, static_argnames="least")(baked, segments, least=0.05)
    of_all, of_lit = (np.sum(np.asarray(each.tet_ids) >= 0) for each in (segments, lit))
    assert COUNT < count == of_lit < 0.8 * of_all
    shade = jax.jit(shade_segments, static_argnames="config")
    whole, part = (shade(baked, local, each, config=config) for each in (segments, lit))
    jax.tree.map(partial(assert_allclose, atol=1e-12), part, whole)  # sums of fewer terms, some of them 0
    assert np.std(whole.opacity) > 0.01


def test_no_rays_at_all():
    none = as_rays((np.zeros((0, 3)), np.zeros((0, 3))))
    assert render(baked_scene(), none, CONFIG).color.shape == (0, 3)


def test_rays_that_miss_are_exactly_transparent():
    baked = baked_scene()
    output = render(baked, rays_at(baked, missing), CONFIG)
    for value in (output.color, output.opacity, output.depth):
        assert_array_equal(value, np.zeros_like(value))


def test_gradients_agree_with_differences(x64, rng):
    """In texels everywhere; in vertices and depths while points stay in their texels."""
    baked = baked_scene("cube", "float64", opacity=(0.2, 0.6))
    rays, weights = rays_at(baked), jnp.asarray(rng.normal(size=(COUNT, 5)))

    def objective(parts):
        tables = {name: getattr(baked, name).replace(features=parts[name]) for name in TABLES}
        mesh = baked.mesh.replace(vertices=parts["vertices"])
        output = render_baked_rays(baked.replace(mesh=mesh, **tables), rays, CONFIG)
        shown = jnp.column_stack([output.color, output.opacity, output.depth])
        return jnp.sum(weights * shown)

    start = {name: getattr(baked, name).features for name in TABLES} | {"vertices": baked.mesh.vertices}
    value, slopes = jax.jit(objective), jax.jit(jax.grad(objective))(start)
    for name, slope in slopes.items():
        direction = jnp.asarray(rng.normal(size=slope.shape))
        along = partial(lambda x, name: value(start | {name: x}), name=name)
        expected = oracles.directional_difference(along, start[name], direction)
        found = float(jnp.sum(slope * direction))
        # 1e-16 of sums of order 10, divided by the step of 1e-6
        assert_allclose(found, expected, rtol=1e-5, atol=1e-8, err_msg=name)


@pytest.fixture(scope="module")
def frames():
    """The same camera's picture, marched and rasterized; not a multiple of the tile, and cut at the edge."""
    baked = baked_scene()
    camera = scenes.camera(50, 37, position=(8.0, 6.0, 5.0), target=(-0.9, 0.5, 0.8))
    config = frame_config(baked, camera, CONFIG)
    return baked, camera, config, render_frame(baked, camera, config), rasterize_frame(baked, camera, config)


def assert_same_picture(one, other):
    """Equal but for pixels that see an edge: one in a thousand may look past it on the other side."""
    for name in ("color", "opacity", "depth"):
        a, b = getattr(one, name), getattr(other, name)
        off = np.abs(a - b) > 1e-4 * max(1, np.abs(a).max())  # sums of float32 in another order
        assert np.mean(off) < 2e-3, name
        assert a.max() > 0.3


def test_rasterized_and_marched_pictures_are_the_same(frames):
    _, _, _, marched, rasterized = frames
    assert rasterized.color.shape == (37, 50, 3)
    assert_same_picture(marched, rasterized)


def test_the_order_of_tets_does_not_matter(frames):
    baked, camera, config, _, rasterized = frames
    order = np.random.default_rng(1).permutation(len(baked.mesh.tets))
    layout, mesh = baked.textures.layout, baked.mesh
    moved = layout.replace(starts=layout.starts[order], resolutions=layout.resolutions[order])
    shuffled = baked.replace(
        mesh=TetMesh(**{**mesh.__dict__, "tets": mesh.tets[order], "object_ids": mesh.object_ids[order]}),
        depths=baked.depths.replace(layout=moved),
        opacities=baked.opacities.replace(layout=moved),
        textures=baked.textures.replace(layout=moved),
    )
    again = rasterize_frame(shuffled, camera, config)
    for name in ("color", "opacity", "depth"):
        assert_allclose(getattr(again, name), getattr(rasterized, name), atol=1e-5)


def test_too_few_layers_are_found_out_and_repaired(frames):
    baked, camera, config, _, rasterized = frames
    march = dataclasses.replace(config.march, max_tets_per_ray=2, capacity_per_ray=None)
    again = rasterize_frame(baked, camera, dataclasses.replace(config, march=march))
    assert_allclose(again.color, rasterized.color, atol=1e-5)


def test_a_camera_within_the_cage_is_refused(frames):
    baked, _, config, _, _ = frames
    inside = scenes.camera(50, 37, position=(-0.9, 0.5, 0.8), target=(0.9, 0.5, 0.4))
    with pytest.raises(ValueError, match=r"not in front of the camera; first: .*use render_frame"):
        rasterize_frame(baked, inside, config)


def test_inverted_tets_are_refused(frames):
    """A walk passes what they cover once, a rasterizer would three times."""
    baked, camera, config, _, _ = frames
    tet = baked.mesh.tets[5]
    through = 2 * jnp.mean(baked.mesh.vertices[tet[1:]], axis=0) - baked.mesh.vertices[tet[0]]
    moved = baked.replace(mesh=baked.mesh.replace(vertices=baked.mesh.vertices.at[tet[0]].set(through)))
    with pytest.raises(ValueError, match=r"\d+ tets are inverted; first: \d+; use render_frame"):
        rasterize_frame(moved, camera, config)


def test_more_tets_in_a_tile_than_memory_is_for_are_refused(frames, monkeypatch):
    baked, camera, config, _, _ = frames
    monkeypatch.setattr(raster_frame, "MAX_TETS_PER_TILE", 8)
    with pytest.raises(ValueError, match="tets meet in one tile of 16 x 16 pixels, more than 8; render more"):
        rasterize_frame(baked, camera, config)


def test_copies_on_all_devices_are_not_made_again(frames):
    baked, camera, config, marched, _ = frames
    ready = for_frames(baked)
    assert len(ready.textures.features.sharding.device_set) == len(jax.local_devices()) > 1
    assert_array_equal(render_frame(ready, camera, config).color, marched.color)
