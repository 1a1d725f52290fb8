"""Fitting face textures to a field: what rays gather in single tets, then whole pictures (Sec. 3.4).

Axes: R rays, N packed segments, M samples, C features, K channels, D decoder sets,
U tets of the cage that is baked.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.chunks import map_used
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.encoding.face_grid import ONE_LEVEL, FaceGrid
from nimpostor_jax.field.decoder import apply_layers, num_decoder_sets
from nimpostor_jax.render.baked import BASIS, places_seen, render_baked_rays
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.composite import blend_background, sample_weights, sum_by_ray, transmittance
from nimpostor_jax.render.sampling import place_samples, plan_samples
from nimpostor_jax.render.segments import in_cells, march_segments
from nimpostor_jax.render.selection import present_samples, sample_densities, visible_samples
from nimpostor_jax.train.losses import photometric
from nimpostor_jax.train.row_adam import RowMoments, no_row_moments, update_rows
from nimpostor_jax.train.step import Parameters, RayBatch, make_optimizer
from nimpostor_jax.types import BakedImpostor, FaceLayout, HashTables, NeuralImpostor, TetSegments

TABLES = ("depths", "opacities", "textures")
RIDGE = 1e-3  # of a texel's evidence, against dependence on the direction
FACE_EVIDENCE = 0.05  # rays that a face's mean counts for in each of its texels
SOLVED = 1 << 16  # texels at a time


@struct.dataclass
class Gathered:
    """What rays gather on their way through the tets."""

    segments: TetSegments
    light: Float[Array, " N"]  # that reaches the segment; 0 in empty slots, and of rays that do not fit
    opacity: Float[Array, " N"]
    share: Float[Array, " N"]  # of the segment at which it is seen, on average
    features: Float[Array, "N C"]  # their mean, or that of the channels made of them
    lost: Int[Array, ""]  # rays that did not fit into the buffers


def gather_by_tet(
    impostor: NeuralImpostor, batch: RayBatch, config: RenderConfig, layers: list | None = None
) -> Gathered:
    """Sample the field along a batch of rays, and sum within each tet of the mesh (Eq. 10).

    Summed are the features, or what `layers` (`decoder.principal_channels`) make of them.
    """
    local = to_local(impostor.mesh, batch.rays)
    segments = march_segments(impostor.mesh, local, config, entries=batch.entries)
    in_field = in_cells(segments, impostor.embedding)
    plan = plan_samples(in_field, config.sampler, config.density_measure, batch.jitter)
    plan, chosen, count = present_samples(impostor, plan, config)
    chosen, features, count = visible_samples(impostor, plan, chosen, count, config, None)
    disordered = jnp.any(segments.disordered)
    chosen, features = _by_segment(plan.owners, chosen, features, count, disordered)
    samples, owners = place_samples(plan, chosen, count), plan.owners[chosen]
    sigmas = sample_densities(impostor, samples.tet_ids, features, count)
    depths = jnp.where(jnp.arange(owners.size) < count, sigmas * samples.deltas, 0)
    if layers is not None:
        items = (features, impostor.decoder_index[samples.tet_ids])
        features = map_used(_through, layers, items, count)
    lengths = segments.t_exit - segments.t_enter
    share = (samples.t - segments.t_enter[owners]) / jnp.where(lengths > 0, lengths, 1)[owners]
    values = jnp.column_stack([features, jnp.ones_like(share), share])
    num_segments = segments.rays.size
    sums = sum_by_ray(sample_weights(depths, owners, count), values, owners, num_segments, count)
    by_tet = jax.ops.segment_sum(depths, owners, num_segments, indices_are_sorted=True)
    lost = segments.overflow | samples.overflow
    reached = (segments.tet_ids >= 0) & ~lost[segments.rays]
    light = jnp.where(reached, _light(by_tet, segments, disordered), 0)
    opacity = sums[:, -2]
    means = sums / jnp.where(opacity > 0, opacity, 1)[:, None]
    return Gathered(
        segments=segments,
        light=light,
        opacity=opacity,
        share=means[:, -1],
        features=means[:, :-2],
        lost=jnp.sum(lost, dtype=jnp.int32),
    )


def _by_segment(
    owners: Int[Array, " M"],
    chosen: Int[Array, " M"],
    features: Float[Array, "M C"],
    count: Int[Array, ""],
    disordered: Bool[Array, ""],
) -> tuple[Int[Array, " M"], Float[Array, "M C"]]:
    """Samples segment by segment, as they are but where tets overlap: sums within tets ask for that."""
    order = jnp.arange(chosen.size, dtype=jnp.int32)

    def sort() -> tuple[Int[Array, " M"], Float[Array, "M C"]]:
        keys = jnp.where(order < count, owners[chosen], jnp.iinfo(owners.dtype).max)
        places = jax.lax.sort((keys, order), num_keys=1)[1]
        return chosen[places], features[places]

    return jax.lax.cond(disordered, sort, lambda: (chosen, features))


def _light(
    optical_depth: Float[Array, " N"], segments: TetSegments, disordered: Bool[Array, ""]
) -> Float[Array, " N"]:
    """Light that reaches each segment; where tets overlap, they count as in the order of their beginnings."""
    order = jnp.arange(optical_depth.size, dtype=jnp.int32)

    def sorted_light() -> Float[Array, " N"]:
        rays, _, places = jax.lax.sort((segments.rays, segments.t_enter, order), num_keys=2)
        return jnp.zeros_like(optical_depth).at[places].set(transmittance(optical_depth[places], rays))

    return jax.lax.cond(disordered, sorted_light, lambda: transmittance(optical_depth, segments.rays))


def _through(layers: list, part: tuple) -> Float[Array, "chunk K"]:
    return apply_layers(layers, *part)


@struct.dataclass
class Seen:
    """What a mesh shows of a field, as sums over rays."""

    light: Float[Array, " U"]  # that reaches each tet
    taken: Float[Array, " U"]  # by it
    products: Float[Array, "D C C"]  # of what tets show, features with features, by decoder set
    lost: Int[Array, ""]  # rays that did not fit into the buffers


def nothing_seen(impostor: NeuralImpostor) -> Seen:
    """Before the first ray."""
    by_tet, features = jnp.zeros(len(impostor.mesh.tets)), impostor.config.encoding.feature_dim
    products = jnp.zeros((num_decoder_sets(impostor.decoders), features, features))
    return Seen(light=by_tet, taken=by_tet, products=products, lost=jnp.zeros((), jnp.int32))


def add_seen(seen: Seen, impostor: NeuralImpostor, batch: RayBatch, config: RenderConfig) -> Seen:
    """Add what a batch of rays sees."""
    gathered = gather_by_tet(impostor, batch, config)
    tets, taken = jnp.maximum(gathered.segments.tet_ids, 0), gathered.light * gathered.opacity
    cells = tets if impostor.embedding is None else impostor.embedding.cells[tets]
    mine = impostor.decoder_index[cells] == jnp.arange(seen.products.shape[0])[:, None]
    features = gathered.features
    return Seen(
        light=seen.light.at[tets].add(gathered.light),
        taken=seen.taken.at[tets].add(taken),
        products=seen.products + jnp.einsum("dn,nc,nk->dck", mine * taken, features, features),
        lost=seen.lost + gathered.lost,
    )


@struct.dataclass
class Moments:
    """Weighted sums over rays for each texel's least squares."""

    products: Float[Array, "texels 4 4"]  # of basis functions
    sums: Float[Array, "texels 4 channels"]  # of basis functions and channels
    lost: Int[Array, ""]  # rays that did not fit into the buffers


def no_moments(num_texels: int, num_channels: int) -> Moments:
    """Before the first ray."""
    return Moments(
        products=jnp.zeros((num_texels, BASIS, BASIS)),
        sums=jnp.zeros((num_texels, BASIS, num_channels)),
        lost=jnp.zeros((), jnp.int32),
    )


def add_depths(
    moments: Moments,
    impostor: NeuralImpostor,
    layout: FaceLayout,
    batch: RayBatch,
    config: RenderConfig,
) -> Moments:
    """Add where on their way through the tets a batch of rays sees something, by the point of entry."""
    gathered = gather_by_tet(impostor, batch, config)
    mass = gathered.light * gathered.opacity
    return _add(moments, layout, gathered, gathered.segments.lambda_enter, mass, gathered.share[:, None])


def add_contents(
    moments: tuple[Moments, Moments],
    impostor: NeuralImpostor,
    layers: list,
    depths: HashTables,
    batch: RayBatch,
    config: RenderConfig,
) -> tuple[Moments, Moments]:
    """Add opacity, and channels by opacity, by the point where `depths` says that they are seen."""
    gathered = gather_by_tet(impostor, batch, config, layers)
    segments = gathered.segments
    used = dataclasses.replace(segments, tet_ids=jnp.maximum(segments.tet_ids, 0))
    places, _ = places_seen(depths, used, jnp.int32(segments.rays.size))
    layout: FaceLayout = depths.layout  # type: ignore[assignment]
    add = partial(_add, layout=layout, gathered=gathered, places=places)
    mass = gathered.light
    return (
        add(moments[0], mass=mass, channels=gathered.opacity[:, None]),
        add(moments[1], mass=mass * gathered.opacity, channels=gathered.features),
    )


def _add(
    moments: Moments,
    layout: FaceLayout,
    gathered: Gathered,
    places: Float[Array, "N 4"],
    mass: Float[Array, " N"],
    channels: Float[Array, "N channels"],
) -> Moments:
    segments = gathered.segments
    tet_ids = jnp.maximum(segments.tet_ids, 0)
    grid, level = FaceGrid(ONE_LEVEL, layout), jnp.int32(0)
    points = grid.prepare(tet_ids, places)
    basis = segments.lambda_exit
    products, sums = moments.products, moments.sums
    for weight, node in zip(*grid.corners(level, points.coordinates), strict=True):
        entries = grid.dense_address(level, level, points, node)
        weighted = (weight * mass)[:, None] * basis
        products = products.at[entries].add(weighted[:, :, None] * basis[:, None, :])
        sums = sums.at[entries].add(weighted[:, :, None] * channels[:, None, :])
    return Moments(products=products, sums=sums, lost=moments.lost + gathered.lost)


def solve_moments(
    moments: Moments, face_of_texel: Int[np.ndarray, " texels"]
) -> Float[np.ndarray, "texels 4 channels"]:
    """Each texel's coefficients. Host code, float64 in blocks of texels, since all need gigabytes.

    A texel that few rays have seen takes after the mean of its face, and all dependence on the direction is
    held back a little.
    """
    products, sums = np.asarray(moments.products), np.asarray(moments.sums)
    # The basis' functions add up to 1.
    mass, total = products.sum(axis=(1, 2), dtype=np.float64), sums.sum(axis=1, dtype=np.float64)
    num_faces = int(face_of_texel.max()) + 1
    face_mass = np.bincount(face_of_texel, mass, num_faces)
    face_total = np.stack([np.bincount(face_of_texel, column, num_faces) for column in total.T], axis=1)
    face_mean = face_total / np.maximum(face_mass, 1e-9)[:, None]
    solved = np.empty_like(sums)
    for start in range(0, len(sums), SOLVED):
        block = slice(start, start + SOLVED)
        mean = total[block] + FACE_EVIDENCE * face_mean[face_of_texel[block]]
        mean /= (mass[block] + FACE_EVIDENCE)[:, None]
        system = products[block].astype(np.float64)
        rest = sums[block] - system.sum(axis=2)[:, :, None] * mean[:, None, :]
        system += (RIDGE * mass[block] + FACE_EVIDENCE)[:, None, None] * np.eye(BASIS)
        solved[block] = mean[:, None, :] + np.linalg.solve(system, rest)
    return solved


def baked_parameters(baked: BakedImpostor) -> Parameters:
    """What refinement trains."""
    return {name: getattr(baked, name).features for name in TABLES} | {"decoders": baked.decoders}


def with_baked_parameters(baked: BakedImpostor, parameters: Parameters) -> BakedImpostor:
    """The baked impostor with its trained arrays replaced."""
    tables = {
        name: dataclasses.replace(getattr(baked, name), features=parameters[name]) for name in TABLES
    }
    return dataclasses.replace(baked, **tables, decoders=parameters["decoders"])


def baked_loss(
    parameters: Parameters, baked: BakedImpostor, batch: RayBatch, config: RenderConfig
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Photometric loss of a batch over its backgrounds, without rays that do not fit; and their share."""
    baked = with_baked_parameters(baked, parameters)
    output = render_baked_rays(baked, batch.rays, config, entries=batch.entries)
    color = blend_background(output.color, output.opacity, batch.background)
    target = blend_background(batch.target[:, :3], batch.target[:, 3], batch.background)
    return photometric(color, target, output.overflow), jnp.mean(output.overflow)


@struct.dataclass
class RefineState:
    """What a step of refinement changes."""

    parameters: Parameters
    moments: dict[str, RowMoments]  # of the tables, of whose texels a batch touches few
    decoders: optax.OptState


def init_refinement(baked: BakedImpostor) -> RefineState:
    """The state before the first step, of copies: steps may consume it."""
    parameters = jax.tree.map(jnp.copy, baked_parameters(baked))
    return RefineState(
        parameters=parameters,
        moments={name: no_row_moments(parameters[name]) for name in TABLES},
        decoders=make_optimizer().init(parameters["decoders"]),
    )


def refine_step(
    state: RefineState,
    baked: BakedImpostor,
    batch: RayBatch,
    rate: Float[Array, ""],
    decoder_rate: Float[Array, ""],
    *,
    config: RenderConfig,
) -> tuple[RefineState, Float[Array, " 2"]]:
    """One step of Adam on a batch, and `baked_loss` before it; pure."""
    value_and_grad = jax.value_and_grad(baked_loss, has_aux=True)
    found, gradients = value_and_grad(state.parameters, baked, batch, config)
    parameters, moments = {}, {}
    for name in TABLES:
        updated = update_rows(state.parameters[name], state.moments[name], gradients[name], rate)
        parameters[name], moments[name] = updated
    updates, decoders = make_optimizer().update(gradients["decoders"], state.decoders)
    parameters["decoders"] = jax.tree.map(
        lambda p, u: p - decoder_rate * u, state.parameters["decoders"], updates
    )
    return RefineState(parameters=parameters, moments=moments, decoders=decoders), jnp.stack(found)
