"""Edits one after another: remeshed, bent, bitten, composed, saved, loaded, rendered."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import scenes
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from test_remesh import CONFIG, QUICK, one_vertex_moved, picture, quiet

from nimpostor_jax.edit.boolean import difference
from nimpostor_jax.edit.compose import compose
from nimpostor_jax.edit.deform import bend, deform
from nimpostor_jax.edit.remesh import transfer
from nimpostor_jax.field import impostor as field
from nimpostor_jax.field.solids import is_kept, to_cells
from nimpostor_jax.geometry.topology import world_vertices
from nimpostor_jax.io.impostor_file import load_impostor, save_impostor
from nimpostor_jax.preprocess.patterns import solid_from_surface


@pytest.mark.slow
def test_remesh_then_deform_then_boolean_then_compose_saved_loaded_rendered(tmp_path, rng):
    made = scenes.impostor("delaunay")
    vertices, tets, _ = one_vertex_moved(made)
    config = dataclasses.replace(QUICK, max_lost_share=1.0, feature_steps=2, render_steps=2)
    remeshed = transfer(made, vertices, tets, CONFIG, config, quiet)
    bent = deform(remeshed, bend(0.4))
    places = world_vertices(bent.mesh)
    center, radius = places.mean(axis=0), 0.25 * np.ptp(places, axis=0).max()
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius).apply_translation(center)
    bitten = difference(bent, solid_from_surface(ball))
    aside = np.eye(4)
    aside[:3, 3] = 0.3, -0.2, 0.1
    whole = compose([bitten, scenes.impostor("cube", seed=1)], [None, aside])

    # The first object's tets come first. There, the field is what remeshing made of it, wherever it is ...
    count = 500
    chosen = jnp.asarray(rng.integers(len(tets), size=count), jnp.int32)
    lambdas = jnp.asarray(rng.dirichlet(np.ones(4), count), jnp.float32)
    values = []
    for impostor in (remeshed, whole):
        cells, places = to_cells(impostor.embedding, chosen, lambdas)
        values.append(field.density(impostor, cells, field.features(impostor, cells, places)))
    assert_allclose(values[1], values[0], rtol=1e-5)  # hashes are the same, sums of other lengths
    # ... and what is gone is what lies in the ball, where the bent tets are.
    corners = world_vertices(bent.mesh)[np.asarray(bent.mesh.tets)[chosen]]
    distance = np.linalg.norm(np.einsum("mi,mix->mx", lambdas, corners) - center, axis=1)
    sure = np.abs(distance - radius) > 0.04 * radius  # cells of the pattern's grid
    kept = np.asarray(is_kept(whole, chosen, lambdas))
    assert_array_equal(kept[sure], distance[sure] > radius)
    assert 20 < np.sum(~kept) < count / 2

    save_impostor(tmp_path / "chain.npz", whole)
    before, after = picture(whole), picture(load_impostor(tmp_path / "chain.npz"))
    assert_array_equal(after, before)
    unbitten = compose([bent, scenes.impostor("cube", seed=1)], [None, aside])
    assert np.abs(before - picture(unbitten)).max() > 0.05
