"""Memory: nothing is as large as rays x tets, in the jaxpr and in the compiled program."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from jax.extend.core import jaxprs_in_params
from meshes import grid, local_vertices
from rays import as_rays, generic
from scenes import FIELD

from nimpostor_jax.config import MarchConfig, RenderConfig, SamplerConfig
from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.field.impostor import init_impostor
from nimpostor_jax.geometry.topology import build_tet_mesh
from nimpostor_jax.render.capacity import fit_capacities
from nimpostor_jax.render.renderer import render_rays
from nimpostor_jax.render.traverse import march_tables, traverse

RAYS = 2048


@pytest.fixture(scope="module")
def large():
    """20,250 tets and a batch of rays."""
    mesh = build_tet_mesh(*grid(np.ones((15, 15, 15), bool)))
    directions = np.broadcast_to([0.0, 0.0, 1.0], (RAYS, 3))
    return mesh, as_rays((np.zeros((RAYS, 3)), directions))


def largest_intermediate(jaxpr):
    """Elements of the largest array that any equation makes, inner jaxprs included."""
    largest = 0
    for equation in jaxpr.eqns:
        for variable in equation.outvars:
            largest = max(largest, int(np.prod(getattr(variable.aval, "shape", ()))))
        for inner in jaxprs_in_params(equation.params):
            largest = max(largest, largest_intermediate(inner))
    return largest


def test_buffers_of_cut_tets_are_those_of_their_cells():
    """Steps are measured in cells: halving tets makes no more of them."""
    made = scenes.impostor("cube")
    rays = as_rays(generic(*local_vertices(made.mesh), np.random.default_rng(0), 64))
    rays = rays.replace(origins=made.mesh.center + made.mesh.scale * rays.origins)
    config = scenes.exact(max_samples_per_ray=512, step=0.1)
    fine = subdivide(made)
    sizes = [
        fit_capacities(m.mesh, march_tables(m.mesh), rays, config, embedding=m.embedding).sampler
        for m in (made, fine)
    ]
    assert sizes[0] == sizes[1] and sizes[0].capacity_per_ray < 512


def test_traversal_holds_rays_times_slots(large, optimized):
    mesh, rays = large
    config = MarchConfig(max_tets_per_ray=64, max_entries_per_ray=4, tile_size=512)
    tables = march_tables(mesh)
    num_tets = len(mesh.tets)
    traced = jax.make_jaxpr(traverse, static_argnums=2)(tables, rays, config)
    assert largest_intermediate(traced.jaxpr) <= max(7 * RAYS * 64, 36 * num_tets) < RAYS * num_tets / 10
    compiled = jax.jit(traverse, static_argnames="config").lower(tables, rays, config).compile()
    # one byte a pair of ray and tet would be 41 MB; codes and ends of all slots are 3.7 MB
    assert compiled.memory_analysis().temp_size_in_bytes < RAYS * num_tets / 2


def test_rendering_and_its_gradient_hold_no_rays_times_tets(large):
    mesh, rays = large
    config = RenderConfig(
        march=MarchConfig(max_tets_per_ray=64, max_entries_per_ray=4, tile_size=512),
        sampler=SamplerConfig(max_samples_per_ray=32),
    )
    impostor = init_impostor(jax.random.key(0), mesh, FIELD)

    def total(vertices, features):
        moved = impostor.replace(
            mesh=mesh.replace(vertices=vertices), tables=impostor.tables.replace(features=features)
        )
        return jnp.sum(render_rays(moved, rays, config).color)

    traced = jax.make_jaxpr(jax.grad(total, argnums=(0, 1)))(mesh.vertices, impostor.tables.features)
    assert largest_intermediate(traced.jaxpr) < RAYS * len(mesh.tets) / 4
