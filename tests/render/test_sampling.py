"""render.sampling: placement, measures, packing."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from meshes import local_vertices, tet_mesh
from numpy.testing import assert_allclose, assert_array_equal
from rays import as_rays, by_ray, generic, missing

from nimpostor_jax.config import EncodingConfig, MarchConfig, RenderConfig, SamplerConfig
from nimpostor_jax.render.sampling import (
    place_samples,
    plan_samples,
    segment_measure,
    step_boundaries,
    with_step,
)
from nimpostor_jax.render.segments import locate_segments
from nimpostor_jax.render.traverse import march_tables, traverse
from nimpostor_jax.types import TetSegments

COUNT = 12
MEASURES = ["barycentric", "alpha", "euclidean"]
CONFIG = SamplerConfig(step=0.5, max_samples_per_ray=64)


@functools.cache
def scene(name="nonconvex"):
    """A mesh, its rays (every third misses) and their segments."""
    mesh, rng = tet_mesh(name), np.random.default_rng(4)
    vertices, tets = local_vertices(mesh)
    origins, directions = generic(vertices, tets, rng, COUNT)
    origins[::3], directions[::3] = missing(vertices, tets, rng, COUNT // 3)
    rays = as_rays((origins, directions))
    march = MarchConfig(max_tets_per_ray=24, max_entries_per_ray=4)
    crossings = jax.jit(traverse, static_argnames="config")(march_tables(mesh), rays, march)
    return mesh, (origins, directions), jax.jit(locate_segments)(mesh, rays, crossings)


def sample_all(segments, config, density_measure, jitter=None):
    plan = plan_samples(segments, config, density_measure, jitter)
    return place_samples(plan, jnp.arange(len(plan.owners)), plan.num_used)


sample = jax.jit(sample_all, static_argnames=("config", "density_measure"))


def ray_measure(segments, measure):
    """Each ray's extent."""
    extents = np.asarray(segment_measure(segments, measure))
    return np.bincount(segments.rays, extents, minlength=len(segments.overflow))


def segments_of(*rays, slots=4):
    """Segments written by hand: for each ray a list of (tet or -1, t_enter, t_exit); coordinates follow t."""
    shape = (len(rays), slots)
    ids, enter, exit_ = np.full(shape, -1), np.zeros(shape), np.zeros(shape)
    lambdas = np.zeros((2, *shape, 4))
    for r, ray in enumerate(rays):
        for k, (tet, low, high) in enumerate(ray):
            ids[r, k] = tet
            if tet >= 0:
                enter[r, k], exit_[r, k] = low, high
                lambdas[0, r, k, 0] = lambdas[1, r, k, 1] = 1
    return TetSegments(
        rays=jnp.repeat(jnp.arange(len(rays), dtype=jnp.int32), slots),
        tet_ids=jnp.asarray(ids.ravel(), jnp.int32),
        t_enter=jnp.asarray(enter.ravel(), jnp.float32),
        t_exit=jnp.asarray(exit_.ravel(), jnp.float32),
        lambda_enter=jnp.asarray(lambdas[0].reshape(-1, 4), jnp.float32),
        lambda_exit=jnp.asarray(lambdas[1].reshape(-1, 4), jnp.float32),
        overflow=jnp.zeros(len(rays), bool),
        disordered=jnp.zeros(len(rays), bool),
    )


def used(samples):
    """The used slots, as a tree of NumPy arrays [N, ...]."""
    count = int(samples.num_used)
    names = ("tet_ids", "lambdas", "t", "deltas", "rays")
    return {name: np.asarray(getattr(samples, name))[:count] for name in names}


def per_ray(samples):
    """How many samples each ray has."""
    return np.bincount(used(samples)["rays"], minlength=len(samples.overflow))


@pytest.mark.parametrize("jittered", [False, True])
@pytest.mark.parametrize("measure", MEASURES)
def test_samples_lie_where_they_say(measure, jittered):
    mesh, (origins, directions), segments = scene()
    jitter = jnp.asarray(np.random.default_rng(1).uniform(size=COUNT), jnp.float32) if jittered else None
    config = dataclasses.replace(CONFIG, measure=measure, step=0.1 if measure == "euclidean" else 0.5)
    samples = sample(segments, config, measure, jitter)
    points = used(samples)
    vertices, tets = local_vertices(mesh)
    assert len(points["t"]) > 3 * COUNT
    assert_allclose(points["lambdas"].sum(axis=1), 1, atol=1e-5)
    assert np.all(points["lambdas"] >= -1e-6)
    positions = np.einsum("ni,nix->nx", points["lambdas"], vertices[tets[points["tet_ids"]]])
    expected = origins[points["rays"]] + points["t"][:, None] * directions[points["rays"]]
    assert_allclose(positions, expected, atol=1e-5)  # float32, rays of length 5
    for ray in range(COUNT):
        along = points["t"][points["rays"] == ray]
        assert np.all(np.diff(along) > 0)


@pytest.mark.parametrize("cone", [0.0, 0.3])
@pytest.mark.parametrize("measure", MEASURES)
def test_intervals_sum_to_the_rays_measure(measure, cone):
    _, _, segments = scene()
    config = dataclasses.replace(CONFIG, measure=measure, cone_angle=cone)
    samples = sample(segments, config, measure)
    points = used(samples)
    total = np.bincount(points["rays"], points["deltas"], minlength=COUNT)
    assert_allclose(total, ray_measure(segments, measure), rtol=1e-5)
    assert np.all(points["deltas"] > 0)


def test_measures_match_the_oracle():
    mesh, rays, segments = scene()
    for ray, (origin, direction) in enumerate(zip(*rays, strict=True)):
        expected = oracles.ray_segments(*local_vertices(mesh), origin, direction)
        bary = sum(np.abs(s[4] - s[3]).sum() for s in expected)
        length = sum(s[1] - s[0] for s in expected)
        assert_allclose(ray_measure(segments, "barycentric")[ray], bary, atol=1e-4)
        assert_allclose(ray_measure(segments, "euclidean")[ray], length, atol=1e-4)
        mine = np.asarray(segments.rays) == ray
        assert ray_measure(segments, "alpha")[ray] == np.sum(np.asarray(segments.tet_ids)[mine] >= 0)


def test_a_mixed_density_measure_converges_to_the_rays_measure():
    """Eq. 8 with barycentric steps: each interval is scaled by its sample's tet."""
    _, _, segments = scene()
    config = dataclasses.replace(CONFIG, step=0.02, max_samples_per_ray=2000)
    points = used(sample(segments, config, "euclidean"))
    total = np.bincount(points["rays"], points["deltas"], minlength=COUNT)
    # steps that straddle two tets are attributed to one: an error of the order of the step per tet
    assert_allclose(total, ray_measure(segments, "euclidean"), rtol=0.02)


def test_equal_steps_no_longer_than_asked_for_and_samples_in_their_middle():
    segments = segments_of([(5, 1.0, 2.5)], [(2, 0.0, 2.0)])
    points = used(sample(segments, dataclasses.replace(CONFIG, measure="euclidean"), "euclidean"))
    assert_allclose(points["deltas"], [0.5] * 7, atol=1e-6)
    assert_allclose(points["t"], [1.25, 1.75, 2.25, 0.25, 0.75, 1.25, 1.75], atol=1e-6)
    assert_array_equal(points["tet_ids"], [5, 5, 5, 2, 2, 2, 2])
    points = used(
        sample(segments_of([(0, 0.0, 1.2)]), dataclasses.replace(CONFIG, measure="euclidean"), "euclidean")
    )
    assert_allclose(points["deltas"], [0.4] * 3, atol=1e-6)


def test_cone_steps_follow_equation_4():
    step, theta = 0.25, 0.5
    boundaries = step_boundaries(SamplerConfig(step=step, cone_angle=theta, max_samples_per_ray=4))
    travelled, expected = 0.0, [0.0]
    for _ in range(4):
        travelled += step
        expected.append(travelled)
        step += theta * travelled
    assert_allclose(boundaries, expected)
    config = SamplerConfig(step=0.25, cone_angle=0.5, max_samples_per_ray=16, measure="euclidean")
    deltas = used(sample(segments_of([(0, 0.0, 3.0)]), config, "euclidean"))["deltas"]
    sizes = np.diff(step_boundaries(config))[: len(deltas)]
    assert_allclose(deltas / deltas[0], sizes / sizes[0], rtol=1e-5)


@pytest.mark.parametrize("measure, tet", [("barycentric", 2.0), ("alpha", 1.0)])
def test_without_a_step_it_crosses_two_cells_of_the_finest_level(measure, tet):
    config = RenderConfig(sampler=SamplerConfig(measure=measure))
    for resolution, cells in ((32, 2), (8, 2), (4, 1), (1, 0.25)):  # at least four steps a tet
        step = with_step(config, EncodingConfig(num_levels=1, base_resolution=resolution)).sampler.step
        assert step == cells * tet / resolution


def test_a_step_of_its_own_is_kept_and_one_that_is_not_known_is_asked_for():
    own = RenderConfig(sampler=SamplerConfig(step=0.3, measure="euclidean"))
    assert with_step(own, EncodingConfig()) is own
    for sampler, layout in ((SamplerConfig(measure="euclidean"), "per_tet"), (SamplerConfig(), "box")):
        with pytest.raises(ValueError, match=r"SamplerConfig\.step must be given"):
            with_step(RenderConfig(sampler=sampler), EncodingConfig(layout=layout))
    with pytest.raises(ValueError, match="with_step"):
        step_boundaries(SamplerConfig())


def test_wide_cones_stay_finite():
    """Their later steps are longer than float32 can say; no ray is, and slots without samples neither."""
    _, _, segments = scene()
    config = SamplerConfig(step=0.5, cone_angle=0.2, max_samples_per_ray=256)
    assert step_boundaries(config)[-1] > np.finfo(np.float32).max
    samples = sample(segments, config, "barycentric")
    assert 0 < samples.num_used < len(samples.t)
    for leaf in jax.tree.leaves(samples):
        assert np.all(np.isfinite(leaf))


def test_long_rays_are_coarsened_and_say_so():
    config = SamplerConfig(measure="euclidean", step=0.5, max_samples_per_ray=4)
    samples = sample(segments_of([(0, 0.0, 2.0)], [(0, 0.0, 2.5)], []), config, "euclidean")
    assert_array_equal(samples.coarsened, [False, True, False])
    assert_array_equal(per_ray(samples), [4, 4, 0])
    assert_allclose(used(samples)["deltas"], [0.5] * 4 + [0.625] * 4, atol=1e-6)
    assert not np.any(samples.overflow)


def test_a_full_buffer_is_reported_and_keeps_the_first_samples():
    segments = segments_of(*[[(r, 0.0, 2.0)] for r in range(4)])  # 4 samples each, room for 12
    config = SamplerConfig(measure="euclidean", step=0.5, max_samples_per_ray=8, capacity_per_ray=3)
    samples = sample(segments, config, "euclidean")
    assert_array_equal(per_ray(samples), [4, 4, 4, 0])
    assert_array_equal(samples.overflow, [False, False, False, True])
    config = dataclasses.replace(config, capacity_per_ray=2)
    samples = sample(segments_of([(0, 0.0, 1.5)], [(1, 0.0, 2.0)]), config, "euclidean")
    assert_array_equal(per_ray(samples), [3, 1])
    assert_array_equal(samples.overflow, [False, True])
    assert_allclose(used(samples)["t"], [0.25, 0.75, 1.25, 0.25], atol=1e-6)


@pytest.mark.parametrize("gap", [0, 1])
def test_empty_slots_anywhere_are_skipped(gap):
    segments = segments_of([(-1, 0, 0)] * gap + [(3, 0.0, 1.0), (-1, 0, 0), (7, 4.0, 5.0)])
    points = used(sample(segments, dataclasses.replace(CONFIG, measure="euclidean"), "euclidean"))
    assert_array_equal(points["tet_ids"], [3, 3, 7, 7])
    assert_allclose(points["t"], [0.25, 0.75, 4.25, 4.75], atol=1e-6)


def test_jitter_at_its_largest_stays_in_the_ray(rng):
    """Rounding must not push the last sample behind the last tet, into an empty slot."""
    rays = []
    for _ in range(400):
        cuts = np.cumsum(rng.uniform(0.01, 0.3, 4))
        rays.append([(9, low, high) for low, high in itertools.pairwise(cuts)])
    segments = segments_of(*rays, slots=16)
    largest = np.nextafter(np.float32(1), np.float32(0))
    for step in (3.0, 0.7):
        config = SamplerConfig(measure="euclidean", step=step, max_samples_per_ray=16)
        # the n-th sample of a ray is shifted by n golden ratios: bring some late ones to the end as well
        for slot in (0, 2):
            jitter = jnp.full(400, (largest - 0.6180339887498949 * slot) % 1, jnp.float32)
            points = used(sample(segments, config, "euclidean", jitter))
            assert_array_equal(points["tet_ids"], 9)
            assert_allclose(points["lambdas"].sum(axis=1), 1, atol=1e-6)


def test_jitter_moves_samples_within_their_steps_and_evenly(rng):
    segments = segments_of(*[[(0, 0.0, 2.0)]] * 500)
    config = SamplerConfig(measure="euclidean", step=0.5, max_samples_per_ray=4)
    jitter = jnp.asarray(rng.uniform(size=500), jnp.float32)
    share = used(sample(segments, config, "euclidean", jitter))["t"].reshape(500, 4) / 0.5 - np.arange(4)
    assert np.all((share >= 0) & (share <= 1))
    assert_allclose(share.mean(axis=0), 0.5, atol=0.05)  # 500 uniform draws: 0.013 standard deviation
    assert np.std(share[:, 3] - share[:, 0]) > 0.1  # strata of a ray are not shifted in lockstep


def test_jitter_does_not_depend_on_the_batch():
    _, _, segments = scene()
    jitter = jnp.linspace(0, 0.99, COUNT)
    whole = used(sample(segments, CONFIG, "barycentric", jitter))
    order = np.random.default_rng(0).permutation(COUNT)[: COUNT // 2]
    slots = len(segments.rays) // COUNT
    dense = jax.tree.map(lambda x: x[order], by_ray(segments))
    part = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]) if x.ndim > 1 else x, dense)
    part = part.replace(rays=jnp.repeat(jnp.arange(len(order)), slots))
    samples = used(sample(part, CONFIG, "barycentric", jitter[order]))
    for position, ray in enumerate(order):
        assert_array_equal(samples["t"][samples["rays"] == position], whole["t"][whole["rays"] == ray])


def test_rays_without_tets_have_no_samples():
    samples = sample(segments_of([], [(1, 0.0, 1.0)], []), CONFIG, "barycentric")
    assert_array_equal(per_ray(samples), [0, 4, 0])
    assert np.all(np.asarray(samples.deltas[4:]) == 0)


def test_some_of_the_samples_are_placed_as_all_of_them(rng):
    _, _, segments = scene()
    config = dataclasses.replace(CONFIG, capacity_per_ray=16, max_samples_per_ray=48)
    plan = plan_samples(segments, config, "barycentric")
    samples = sample(segments, config, "barycentric")
    count = int(plan.num_used)
    expected = np.flatnonzero(rng.uniform(size=count) < 0.4)
    chosen = jnp.asarray(np.resize(expected, len(plan.owners)), jnp.int32)
    selected = jax.jit(place_samples)(plan, chosen, len(expected))
    assert 0 < len(expected) < count < len(plan.owners)
    assert int(selected.num_used) == len(expected)
    for name, kept in used(selected).items():
        assert_allclose(kept, np.asarray(getattr(samples, name))[expected], rtol=1e-6)  # fused otherwise
    assert not np.any(np.asarray(selected.deltas)[len(expected) :])


@pytest.mark.parametrize("cone", [0.0, 0.3])
def test_samples_are_in_the_segment_that_holds_their_place(cone, rng):
    """Whatever the jitter: the place along the ray says which tet, not the order of the segments."""
    cuts = [0.0, *np.sort(rng.uniform(0, 3, 7)), 3.0]
    segments = segments_of([(k, *ends) for k, ends in enumerate(itertools.pairwise(cuts))], slots=8)
    config = dataclasses.replace(CONFIG, measure="euclidean", step=0.1, cone_angle=cone)
    for jitter in rng.uniform(size=(20, 1)).astype(np.float32):
        points = used(sample(segments, config, "euclidean", jnp.asarray(jitter)))
        assert_array_equal(points["tet_ids"], np.searchsorted(cuts, points["t"], side="right") - 1)


def test_positions_are_differentiable(x64, rng):
    """Through segments and steps, at fixed counts: jax.grad against central differences."""
    _, _, segments = scene()
    segments = jax.tree.map(lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, segments)
    mix = jnp.asarray(rng.normal(size=(COUNT * 64, 4)))
    nudge = jnp.asarray(rng.normal(size=segments.lambda_exit.shape))
    nonempty = segments.tet_ids[:, None] >= 0

    @jax.jit
    def function(x):
        moved = segments.replace(lambda_exit=segments.lambda_exit + jnp.where(nonempty, x * nudge, 0))
        samples = sample_all(moved, CONFIG, "barycentric")
        return jnp.sum(mix * samples.lambdas * samples.deltas[:, None]) + jnp.sum(mix[:, 0] * samples.t)

    expected = oracles.directional_difference(function, jnp.zeros(()), 1.0, 1e-6)
    # the step is too small for a sample to change its tet or a ray its number of samples
    assert_allclose(jax.grad(function)(jnp.zeros(())), expected, rtol=1e-6)
