"""render.frame and render.capacity: whole images, buffer sizes from the scene, repair of overflow."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from meshes import local_vertices, tet_mesh
from numpy.testing import assert_allclose, assert_array_equal
from rays import as_rays, generic, missing
from scenes import RENDER, constant_density, exact

from nimpostor_jax import chunks
from nimpostor_jax.config import MarchConfig, SamplerConfig
from nimpostor_jax.edit.compose import compose
from nimpostor_jax.io.impostor_file import save_impostor
from nimpostor_jax.render import capacity, selection
from nimpostor_jax.render import frame as frames
from nimpostor_jax.render.camera import image_pixels, pixel_rays, to_local
from nimpostor_jax.render.capacity import fit_capacities, ray_entries
from nimpostor_jax.render.frame import for_frames, frame_config, refined, render_frame, to_image
from nimpostor_jax.render.occupancy import num_cells
from nimpostor_jax.render.renderer import render_rays
from nimpostor_jax.render.sampling import plan_samples, step_boundaries
from nimpostor_jax.render.segments import march_segments
from nimpostor_jax.render.traverse import march_tables, traverse
from nimpostor_jax.train.step import trainable

render = jax.jit(render_rays, static_argnames="config")


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    """Several chunks in a small image; each is split over both devices."""
    monkeypatch.setattr(frames, "CHUNK", 256)
    monkeypatch.setattr(frames, "REPAIR_CHUNK", 256)


@pytest.fixture(scope="module")
def scene():
    return scenes.impostor(), scenes.camera(44, 40)


def whole_image(impostor, camera, config):
    rays = pixel_rays(camera, image_pixels(camera.height, camera.width).reshape(-1, 2))
    output = render(impostor, rays, config)
    shape = (camera.height, camera.width)
    names = ("color", "opacity", "depth", "coarsened")
    return {name: np.asarray(getattr(output, name)).reshape(*shape, -1).squeeze() for name in names}


def check_equal(frame, expected):
    for name, value in expected.items():
        assert getattr(frame, name).shape == value.shape
        assert_allclose(getattr(frame, name), value, atol=1e-5)  # other programs, float32 depths of about 3


def test_a_frame_is_the_picture_of_its_rays(scene):
    assert len(jax.local_devices()) == 2
    impostor, camera = scene
    expected = whole_image(impostor, camera, RENDER)
    frame = render_frame(impostor, camera, RENDER)
    check_equal(frame, expected)
    covered = expected["opacity"] > 0
    assert 512 < covered.sum() < covered.size  # several chunks, and some background


@pytest.mark.parametrize("devices", [1, 2, 16])
def test_devices_share_what_does_not_fill_a_chunk(devices):
    size, chunk = 4, 32 * devices
    for count in (1, 7, chunk // 2, chunk):
        slots = frames.dealt(count, chunk, devices, size)
        assert len(np.unique(slots)) == count
        loads = np.bincount(slots // (chunk // devices), minlength=devices)
        assert np.ptp(loads) <= size and loads.max() <= -(-count // (devices * size)) * size
        # as many together as are dealt at a time: rays of a tile are marched together
        assert np.all(np.diff(slots.reshape(-1)[: count - count % size].reshape(-1, size), axis=1) == 1)


def test_half_a_chunk_is_spread_over_both_devices(scene, monkeypatch):
    monkeypatch.setattr(frames, "CHUNK", 1024)
    seen, rendered = [], frames._render_sharded

    def watched(impostor, tables, slabs, rays, entries, *rest):
        seen.append(np.sum(np.asarray(entries.holds)[:, 0].reshape(2, -1) >= 0, axis=1))
        return rendered(impostor, tables, slabs, rays, entries, *rest)

    monkeypatch.setattr(frames, "_render_sharded", watched)
    check_equal(render_frame(*scene, RENDER), whole_image(*scene, RENDER))
    (loads,) = seen
    assert loads.sum() < 1024 and np.ptp(loads) <= 256


def test_frames_have_finer_steps(scene):
    """Half of them here, and samples that weigh half; fitting buffers first does not halve them again."""
    impostor, camera = scene
    config = dataclasses.replace(RENDER, min_weight=0.02, frame_refinement=2.0)
    expected = whole_image(
        impostor,
        camera,
        dataclasses.replace(exact(step=0.25, max_samples_per_ray=32), min_weight=0.01),
    )
    check_equal(render_frame(impostor, camera, config), expected)
    check_equal(render_frame(impostor, camera, frame_config(impostor, camera, config)), expected)


def test_merged_levels_give_the_same_frame(scene):
    impostor, camera = scene
    merged = for_frames(impostor)
    assert merged.tables.chains == ((0, 1),)
    check_equal(render_frame(merged, camera, RENDER), whole_image(impostor, camera, RENDER))
    moved = jax.tree.map(lambda x: x, merged).replace(
        mesh=merged.mesh.replace(vertices=1.1 * merged.mesh.vertices)
    )
    expected = impostor.replace(mesh=impostor.mesh.replace(vertices=1.1 * impostor.mesh.vertices))
    check_equal(render_frame(moved, camera, RENDER), whole_image(expected, camera, RENDER))


def test_merged_levels_are_for_frames_only(scene, tmp_path):
    merged = for_frames(scene[0])
    assert for_frames(merged).tables.chains == merged.tables.chains
    saved = tmp_path / "impostor.npz"
    rays = pixel_rays(scene[1], image_pixels(4, 4).reshape(-1, 2))
    config = dataclasses.replace(RENDER, min_weight=1e-3)

    def brightness(vertices):
        moved = merged.replace(mesh=merged.mesh.replace(vertices=vertices))
        return render_rays(moved, rays, config).color.sum()

    with pytest.raises(ValueError, match="no derivatives"):
        jax.jit(jax.grad(brightness))(merged.mesh.vertices)
    for use in (trainable, lambda each: compose([each]), lambda each: save_impostor(saved, each)):
        with pytest.raises(ValueError, match="merged for frames"):
            use(merged)
    assert not list(tmp_path.iterdir())


def partly_occupied(impostor, share):
    parts = np.random.default_rng(0).random((len(impostor.mesh.tets), num_cells(4))) < share
    return impostor.replace(occupied=jax.numpy.asarray(parts))


def test_sorting_what_is_in_order_changes_nothing(scene):
    impostor, camera = scene
    rays = pixel_rays(camera, image_pixels(camera.height, camera.width).reshape(-1, 2))
    always = dataclasses.replace(RENDER, skip_sorting=False)
    expected, sorted_ = (render(impostor, rays, config) for config in (RENDER, always))
    assert_allclose(sorted_.color, expected.color, atol=1e-6)  # another program, fused otherwise
    # That it sorts: samples given out of order come back in order
    order = jnp.asarray([3, 1, 2, 0], jnp.int32)
    local = to_local(impostor.mesh, rays)
    march = jax.jit(lambda rays: march_segments(impostor.mesh, rays, RENDER))
    plan = plan_samples(march(local), RENDER.sampler, "barycentric")
    assert_array_equal(selection.in_order(plan, order, jnp.int32(4), RENDER), order)
    assert_array_equal(selection.in_order(plan, order, jnp.int32(4), always), jnp.sort(order))


def test_buffers_behind_the_occupancy_are_smaller(scene):
    impostor, camera = partly_occupied(scene[0], 0.3), scene[1]
    config = frame_config(impostor, camera, RENDER)
    assert config.sampler.occupied_per_ray < config.sampler.capacity_per_ray
    expected = whole_image(impostor, camera, RENDER)
    check_equal(render_frame(impostor, camera, config), expected)
    none = frame_config(impostor, camera, dataclasses.replace(RENDER, skip_empty=False))
    assert none.sampler.occupied_per_ray is None


def test_samples_that_do_not_fit_behind_the_occupancy_are_flagged(scene, monkeypatch):
    """Rays without a flag are as they were, and frames render the others again."""
    impostor, camera = partly_occupied(scene[0], 0.9), scene[1]
    rays = pixel_rays(camera, image_pixels(camera.height, camera.width).reshape(-1, 2))
    monkeypatch.setattr(chunks, "CPU_CHUNK", 64)  # buffers are whole chunks
    crowded = exact(occupied_per_ray=1)
    expected, output = render(impostor, rays, RENDER), render(impostor, rays, crowded)
    fits = ~np.asarray(output.overflow)
    assert 0 < fits.sum() < fits.size
    assert_allclose(output.color[fits], expected.color[fits], atol=1e-6)  # another program, fused otherwise
    assert np.any(np.abs(output.color - expected.color)[~fits] > 1e-3)
    check_equal(render_frame(impostor, camera, crowded), whole_image(impostor, camera, RENDER))


def test_steps_that_grow_are_refined_all_along():
    """Twice as many steps to wherever a ray ends."""
    sampler = SamplerConfig(step=0.02, cone_angle=0.01, max_samples_per_ray=64)
    config = dataclasses.replace(RENDER, sampler=sampler, frame_refinement=2.0)
    coarse, fine = (step_boundaries(c.sampler) for c in (config, refined(config)))
    for steps in range(8, 65, 8):
        # A step grows at its end, not on its way: that moves the end by less than a fine step.
        assert np.searchsorted(fine, coarse[steps]) == pytest.approx(2 * steps, abs=1)


def test_overflow_is_repaired(scene):
    impostor, camera = scene
    expected = whole_image(impostor, camera, RENDER)
    config = exact(capacity_per_ray=2)
    config = dataclasses.replace(config, march=MarchConfig(max_tets_per_ray=3, max_entries_per_ray=2))
    check_equal(render_frame(impostor, camera, config), expected)


@pytest.mark.parametrize("min_weight", [0.0, 5e-3])
def test_a_tolerance_is_met(scene, min_weight):
    """Against steps 32 times as fine as the config's: here that is converged."""
    impostor, camera = scene
    config = dataclasses.replace(RENDER, min_weight=min_weight)
    fine = exact(step=RENDER.sampler.step / 64, max_samples_per_ray=2048)
    expected = render_frame(impostor, camera, fine)
    errors = {}
    for tolerance in (None, 1 / 255):
        frame = render_frame(impostor, camera, config, tolerance)
        errors[tolerance] = np.max(np.abs(frame.color - expected.color), axis=-1)
        assert (frame.error is None) == (tolerance is None)
    assert errors[None].max() > 4 / 255  # the test could not fail otherwise
    assert np.mean(errors[1 / 255] <= 1 / 255) >= 0.999
    with pytest.raises(ValueError, match="tolerance must be > 0"):
        render_frame(impostor, camera, RENDER, 0.0)


def test_what_cannot_be_repaired_is_an_error_and_no_picture(scene, monkeypatch):
    monkeypatch.setattr(frames, "MAX_GROWTH", 1)
    impostor, camera = scene
    config = dataclasses.replace(RENDER, march=MarchConfig(max_tets_per_ray=1, max_entries_per_ray=1))
    with pytest.raises(RuntimeError, match="more than 2 tets or 2 entries; raise MarchConfig"):
        render_frame(impostor, camera, config)


def test_a_camera_that_sees_nothing_gives_an_empty_frame(scene):
    impostor, _ = scene
    away = scenes.camera(8, 8, position=(9.0, 9.0, 9.0), target=(20.0, 20.0, 20.0))
    # lines count as hits, whichever way they are followed: look past the cage instead
    aside = away.replace(camera_to_world=scenes.look_at((9.0, 0.0, 0.0), (9.0, 30.0, 1.0)))
    for camera in (away, aside):
        frame = render_frame(impostor, camera, RENDER)
        assert_array_equal(frame.opacity, np.zeros((8, 8)))
        assert_array_equal(to_image(frame, 1.0), np.ones((8, 8, 3)))
    assert frame_config(impostor, aside, RENDER) == RENDER


def test_frame_config_fits_and_spares(scene):
    impostor, camera = scene
    generous = dataclasses.replace(RENDER, march=MarchConfig(max_tets_per_ray=64, max_entries_per_ray=2))
    config = frame_config(impostor, camera, generous)
    assert config.march.max_tets_per_ray < 64
    assert config.sampler.capacity_per_ray <= config.sampler.max_samples_per_ray <= 16
    check_equal(render_frame(impostor, camera, config), whole_image(impostor, camera, RENDER))


def test_only_frames_of_integrated_features_do_not_look_for_visible_samples(scene):
    """No sample has a colour there that could be spared. In haze like this one all samples are visible."""
    impostor, camera = constant_density(partly_occupied(scene[0], 1.0), -4.0), scene[1]
    for empty in (True, False):
        config = exact(step=0.1, max_samples_per_ray=64, min_weight=1e-3, skip_empty=empty)
        assert frame_config(impostor, camera, config).min_weight == 1e-3
        integrated = dataclasses.replace(config, integrate="features")
        assert frame_config(impostor, camera, integrated).min_weight == 0


def test_another_view_keeps_its_samples(scene):
    """Buffers are those of the view that they were measured on; how many samples a ray may have is not."""
    impostor, camera = scene
    sampler = dataclasses.replace(RENDER.sampler, max_samples_per_ray=4096)  # more than any ray needs
    config = dataclasses.replace(RENDER, sampler=sampler)
    sized = frame_config(impostor, camera, config).sampler
    assert sized.max_samples_per_ray == refined(config).sampler.max_samples_per_ray
    assert sized.capacity_per_ray < 200  # measured


def test_to_image_blends_and_clips():
    frame = frames.Frame(
        color=np.array([[[0.2, 0.1, 0.0], [2.0, 0.0, 0.0]]]),
        opacity=np.array([[0.5, 1.0]]),
        depth=np.zeros((1, 2)),
        coarsened=np.zeros((1, 2), bool),
    )
    assert_allclose(to_image(frame, np.array([1.0, 0.0, 0.5])), [[[0.7, 0.1, 0.25], [1, 0, 0]]])


def sample_rays(mesh, kind, count=48):
    rays = kind(*local_vertices(mesh), np.random.default_rng(0), count)
    origins = np.asarray(mesh.center) + float(mesh.scale) * rays[0]
    return as_rays((origins, rays[1]))


def test_ray_entries_says_which_lines_meet_the_cage():
    mesh = tet_mesh("blobs")
    tables = march_tables(mesh)
    hit, missed = (
        ray_entries(mesh, tables, sample_rays(mesh, kind), RENDER.march).holds[:, 0] >= 0
        for kind in (generic, missing)
    )
    assert np.all(hit)
    assert not np.any(missed)


def test_fitted_buffers_hold_the_rays_they_were_measured_on():
    impostor = scenes.impostor("blobs")
    rays = sample_rays(impostor.mesh, generic)
    config = dataclasses.replace(
        exact(max_samples_per_ray=64), march=MarchConfig(max_tets_per_ray=16, max_entries_per_ray=2)
    )
    fitted = fit_capacities(impostor.mesh, march_tables(impostor.mesh), rays, config)
    output = render(impostor, rays, fitted)
    assert not np.any(output.overflow)
    assert not np.any(output.coarsened)
    assert fitted.sampler.capacity_per_ray < 64


@pytest.mark.parametrize("growth", [1, 2])
def test_growth_is_tried_to_its_end_and_then_an_error(growth, monkeypatch):
    """Slots of a quarter of the need have to be doubled twice; once does not suffice."""
    mesh = tet_mesh("delaunay")
    tables, rays = march_tables(mesh), sample_rays(mesh, generic)
    needed = int(
        np.max(np.sum(np.asarray(traverse(tables, to_local(mesh, rays), MarchConfig()).codes) >= 0, axis=0))
    )
    start = -(-needed // 4)
    config = dataclasses.replace(
        exact(max_samples_per_ray=64), march=MarchConfig(max_tets_per_ray=start, max_entries_per_ray=1)
    )
    monkeypatch.setattr(capacity, "MAX_GROWTH", growth)
    if growth == 2:
        assert fit_capacities(mesh, tables, rays, config).march.max_tets_per_ray >= needed
    else:
        with pytest.raises(ValueError, match=f"more than {2 * start} tets"):
            fit_capacities(mesh, tables, rays, config)


def test_rays_that_miss_need_no_more_than_the_least():
    mesh = tet_mesh("cube")
    fitted = fit_capacities(mesh, march_tables(mesh), sample_rays(mesh, missing), RENDER)
    assert fitted.sampler.capacity_per_ray >= 1


def test_a_process_may_render_in_float64_and_then_in_float32(scene):
    """As `experiments/pareto.py` does for its reference; what is cached serves both."""
    impostor, camera = scenes.impostor(), scenes.camera(20, 12)
    with jax.enable_x64(True):
        exact_camera = jax.tree.map(lambda x: x.astype("float64"), camera)
        exact_frame = render_frame(scenes.impostor(dtype="float64"), exact_camera, RENDER)
    frame = render_frame(impostor, camera, frame_config(impostor, camera, RENDER))
    assert exact_frame.color.dtype == np.float64 and frame.color.dtype == np.float32
    assert_allclose(frame.color, exact_frame.color, atol=1e-4)  # float32, and decoders with slopes of a few
