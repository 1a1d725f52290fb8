"""Fitting face textures to what rays through a field gather in single tets (Sec. 3.4).

Axes: R rays, N packed segments, M samples, C features, K channels, D decoder sets,
U tets of the cage that is baked.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.chunks import map_used
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.encoding.face_grid import texels_around
from nimpostor_jax.field.decoder import apply_layers, num_decoder_sets
from nimpostor_jax.render.baked import BASIS, places_seen
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.composite import sample_weights, sum_by_ray, transmittance
from nimpostor_jax.render.sampling import place_samples, plan_samples
from nimpostor_jax.render.segments import in_cells, march_segments
from nimpostor_jax.render.selection import present_samples, sample_densities, visible_samples
from nimpostor_jax.train.step import RayBatch
from nimpostor_jax.types import FaceLayout, HashTables, NeuralImpostor, TetSegments

RIDGE = 1e-3  # of a texel's evidence, against dependence on the direction
FACE_EVIDENCE = 0.05  # rays that a face's mean counts for in each of its texels
PAIRS = np.triu_indices(BASIS)
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

    products: Float[Array, "texels 10"]  # of basis functions, of each pair once (`PAIRS`)
    sums: Float[Array, "texels 4 channels"]  # of basis functions and channels
    lost: Int[Array, ""]  # rays that did not fit into the buffers


def no_moments(num_texels: int, num_channels: int) -> Moments:
    """Before the first ray."""
    return Moments(
        products=jnp.zeros((num_texels, len(PAIRS[0]))),
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
    basis = segments.lambda_exit
    products, sums = moments.products, moments.sums
    for weight, entries in zip(*texels_around(layout, tet_ids, places), strict=True):
        weighted = (weight * mass)[:, None] * basis
        products = products.at[entries].add(weighted[:, PAIRS[0]] * basis[:, PAIRS[1]])
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
    blocks = [slice(start, start + SOLVED) for start in range(0, len(sums), SOLVED)]
    # The basis' functions add up to 1.
    once = np.where(PAIRS[0] == PAIRS[1], 1.0, 2.0)
    mass = np.concatenate([products[block] @ once for block in blocks])
    num_faces = int(face_of_texel.max()) + 1
    face_mass = np.bincount(face_of_texel, mass, num_faces)
    face_mean = np.zeros((num_faces, sums.shape[2]))
    for channel in range(sums.shape[2]):
        total = sums[:, :, channel].sum(axis=1, dtype=np.float64)
        face_mean[:, channel] = np.bincount(face_of_texel, total, num_faces)
    face_mean /= np.maximum(face_mass, 1e-9)[:, None]
    solved = np.empty_like(sums)
    for block in blocks:
        mean = sums[block].sum(axis=1, dtype=np.float64) + FACE_EVIDENCE * face_mean[face_of_texel[block]]
        mean /= (mass[block] + FACE_EVIDENCE)[:, None]
        system = np.empty((len(mean), BASIS, BASIS))
        system[:, PAIRS[0], PAIRS[1]] = system[:, PAIRS[1], PAIRS[0]] = products[block]
        rest = sums[block] - system.sum(axis=2)[:, :, None] * mean[:, None, :]
        system += (RIDGE * mass[block] + FACE_EVIDENCE)[:, None, None] * np.eye(BASIS)
        solved[block] = mean[:, None, :] + np.linalg.solve(system, rest)
    return solved
