"""Fitting face textures to a field: what rays gather in single tets, then whole pictures (Sec. 3.4).

Axes: R rays, N packed segments, M samples, K basis functions, C features.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int

from nimpostor_jax.chunks import map_used
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.encoding.face_grid import ONE_LEVEL, FaceGrid
from nimpostor_jax.field import impostor as field
from nimpostor_jax.render.baked import render_baked_rays
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.composite import blend_background, sample_weights, sum_by_ray, transmittance
from nimpostor_jax.render.renderer import occupied_samples, visible_samples
from nimpostor_jax.render.sampling import place_samples, plan_samples
from nimpostor_jax.render.segments import locate_segments
from nimpostor_jax.render.traverse import march_tables, traverse
from nimpostor_jax.train.losses import photometric
from nimpostor_jax.train.step import Parameters, RayBatch
from nimpostor_jax.types import BakedImpostor, FaceLayout, NeuralImpostor, TetMesh, TetSegments

RIDGE = 0.03  # of a texel's evidence, against dependence on the direction
FACE_EVIDENCE = 0.05  # rays that a face's mean counts for in each of its texels


@struct.dataclass
class Moments:
    """Weighted sums over rays for each texel's least squares."""

    products: Float[Array, "texels K K"]  # of basis functions
    sums: Float[Array, "texels K C+2"]  # of basis functions and channels


@struct.dataclass
class FineCage:
    """The cage that is baked: its tets lie within those of the impostor's cage."""

    mesh: TetMesh
    parents: Int[Array, " U"]
    lambdas: Float[Array, "U 4 4"]  # of its tets' corners, in their parents


def visible_opacity(
    found: Float[Array, "U 2"],
    impostor: NeuralImpostor,
    cage: FineCage,
    batch: RayBatch,
    config: RenderConfig,
) -> Float[Array, "U 2"]:
    """Add, by tet, the light that reaches it along a batch of rays, and what it takes of that."""
    segments, channels, light = gather_by_tet(impostor, cage, batch, config)
    values = jnp.stack([light, light * channels[:, 0]], axis=1)
    return found.at[jnp.maximum(segments.tet_ids, 0)].add(values)


def no_moments(num_texels: int, num_basis: int, num_channels: int) -> Moments:
    """Before the first ray."""
    return Moments(
        products=jnp.zeros((num_texels, num_basis, num_basis)),
        sums=jnp.zeros((num_texels, num_basis, num_channels)),
    )


def add_moments(
    moments: Moments,
    impostor: NeuralImpostor,
    cage: FineCage,
    layout: FaceLayout,
    batch: RayBatch,
    config: RenderConfig,
) -> Moments:
    """Add what a batch of rays gathers in each tet, weighted by the light that reaches the tet."""
    segments, channels, light = gather_by_tet(impostor, cage, batch, config)
    light *= layout.resolutions[jnp.maximum(segments.tet_ids, 0), 0] > 0
    grid = FaceGrid(ONE_LEVEL, layout)
    one = jnp.int32(1)
    tet_ids = jnp.maximum(segments.tet_ids, 0)
    points = grid.prepare(tet_ids, segments.lambda_enter)
    weights, nodes = grid.corners(one, points.coordinates)
    num_basis = moments.products.shape[1]
    basis = jnp.ones_like(light)[:, None] if num_basis == 1 else segments.lambda_exit
    products, sums = moments.products, moments.sums
    for weight, node in zip(weights, nodes, strict=True):
        entries = grid.dense_address(one, one, points, node)
        mass = (weight * light)[:, None] * basis
        products = products.at[entries].add(mass[:, :, None] * basis[:, None, :])
        sums = sums.at[entries].add(mass[:, :, None] * channels[:, None, :])
    return Moments(products=products, sums=sums)


def gather_by_tet(
    impostor: NeuralImpostor, cage: FineCage, batch: RayBatch, config: RenderConfig
) -> tuple[TetSegments, Float[Array, "N C+2"], Float[Array, " N"]]:
    """Segments of the fine cage, the channels of each, and the light that reaches it (0 in empty slots)."""
    local = to_local(impostor.mesh, batch.rays)
    crossings = traverse(march_tables(cage.mesh), local, config.march, batch.entries)
    slots = config.march.capacity_per_ray or config.march.max_tets_per_ray
    near, capacity = config.near / impostor.mesh.scale, slots * batch.jitter.shape[0]
    segments = locate_segments(cage.mesh, local, crossings, near, capacity)
    tet_ids = jnp.maximum(segments.tet_ids, 0)
    enter, leave = (
        jnp.sum(x[:, :, None] * cage.lambdas[tet_ids], axis=1)
        for x in (segments.lambda_enter, segments.lambda_exit)
    )
    in_parents = segments.replace(  # type: ignore[attr-defined]
        tet_ids=jnp.where(segments.tet_ids >= 0, cage.parents[tet_ids], -1),
        lambda_enter=enter,
        lambda_exit=leave,
    )
    plan = plan_samples(in_parents, config.sampler, config.density_measure, batch.jitter)
    chosen, count = occupied_samples(impostor, plan, config)
    if config.min_weight > 0:
        chosen, features, count = visible_samples(impostor, plan, chosen, count, config, None)
        samples = place_samples(plan, chosen, count)
    else:
        samples = place_samples(plan, chosen, count)
        features = field.features(impostor, samples.tet_ids, samples.lambdas, count)
    owners = plan.owners[chosen]
    decoders = dataclasses.replace(impostor, mesh=None, tables=None, occupied=None)  # type: ignore[arg-type]
    sigmas = map_used(
        lambda shared, part: field.density(shared, *part), decoders, (samples.tet_ids, features), count
    )
    depths = jnp.where(jnp.arange(owners.size) < count, sigmas * samples.deltas, 0)
    lengths = segments.t_exit - segments.t_enter
    share = (samples.t - segments.t_enter[owners]) / jnp.where(lengths > 0, lengths, 1)[owners]
    values = jnp.column_stack([jnp.ones_like(share), share, features])
    num_segments = segments.rays.size
    channels = sum_by_ray(sample_weights(depths, owners, count), values, owners, num_segments, count)
    by_tet = jax.ops.segment_sum(depths, owners, num_segments, indices_are_sorted=True)
    light = jnp.where(segments.tet_ids >= 0, transmittance(by_tet, segments.rays), 0)
    return segments, channels, light


def solve_moments(
    moments: Moments, face_of_texel: np.ndarray
) -> Float[np.ndarray, "texels K*(C+2)"]:
    """Each texel's coefficients. Host code.

    A texel that few rays have seen takes after the mean of its face, and all dependence on the direction is
    held back a little.
    """
    products, sums = (np.asarray(x, np.float64) for x in (moments.products, moments.sums))
    num_texels, num_basis, num_channels = sums.shape
    mass, total = products.sum(axis=(1, 2)), sums.sum(axis=1)
    num_faces = int(face_of_texel.max()) + 1
    face_mass = np.bincount(face_of_texel, mass, num_faces)
    face_total = np.stack(
        [np.bincount(face_of_texel, total[:, c], num_faces) for c in range(num_channels)], axis=1
    )
    face_mean = face_total / np.maximum(face_mass, 1e-9)[:, None]
    mean = total + FACE_EVIDENCE * face_mean[face_of_texel]
    mean /= (mass + FACE_EVIDENCE)[:, None]
    coefficients = np.repeat(mean[:, None, :], num_basis, axis=1)
    if num_basis > 1:  # the basis' functions add up to 1: the mean is in each coefficient
        rest = sums - np.einsum("nkl,nlc->nkc", products, coefficients)
        ridge = (RIDGE * mass + FACE_EVIDENCE)[:, None, None] * np.eye(num_basis)
        coefficients += np.linalg.solve(products + ridge, rest)
    return coefficients.reshape(num_texels, -1)


def baked_loss(
    parameters: Parameters, baked: BakedImpostor, batch: RayBatch, config: RenderConfig
) -> Float[Array, ""]:
    """Photometric loss of a batch over its backgrounds."""
    textures = dataclasses.replace(baked.textures, features=parameters["features"])
    baked = dataclasses.replace(baked, textures=textures, decoders=parameters["decoders"])
    output = render_baked_rays(baked, batch.rays, config, entries=batch.entries)
    color = blend_background(output.color, output.opacity, batch.background)
    target = blend_background(batch.target[:, :3], batch.target[:, 3], batch.background)
    return photometric(color, target, output.overflow)


def refine_step(
    parameters: Parameters,
    optimizer_state: optax.OptState,
    baked: BakedImpostor,
    batch: RayBatch,
    rates: Any,
    *,
    config: RenderConfig,
    optimizer: optax.GradientTransformation,
) -> tuple[Parameters, optax.OptState, Float[Array, ""]]:
    """One step of Adam at learning rates for textures and decoders; pure."""
    loss, gradients = jax.value_and_grad(baked_loss)(parameters, baked, batch, config)
    updates, optimizer_state = optimizer.update(gradients, optimizer_state, parameters)
    parameters = {
        name: jax.tree.map(lambda p, u, r=rates[name]: p - r * u, parameters[name], updates[name])
        for name in parameters
    }
    return parameters, optimizer_state, loss
