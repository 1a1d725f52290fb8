"""What the measuring scripts compute by themselves: the stress test's oracle, and the Pareto front."""

import importlib.util
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from rays import as_rays

from nimpostor_jax.config import MarchConfig
from nimpostor_jax.preprocess.topology import build_tet_mesh

EXPERIMENTS = Path(__file__).resolve().parents[1] / "experiments"


def script(name):
    spec = importlib.util.spec_from_file_location(name, EXPERIMENTS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def marched(x64, rng):
    """The stress script, and rays that it finds in order on a small grid."""
    stress = script("stress")
    mesh = build_tet_mesh(*stress.kuhn_grid(2), dtype="float32")
    vertices, tets = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.tets)
    planes = stress.tet_planes(vertices, tets)
    rays = as_rays(stress.RAYS["random"](vertices, tets, rng, 64))
    segments = stress.march_rays(mesh, rays, MarchConfig(max_tets_per_ray=32, max_entries_per_ray=4))
    return stress, planes, rays, segments


def test_the_oracle_agrees_with_the_march(marched):
    stress, planes, rays, segments = marched
    assert np.abs(stress.chord_errors(planes, rays, segments, 1e-4)).max() < 1e-4
    assert not np.any(stress.overlapping(segments, 1e-4))
    assert stress.count_nonfinite(segments) == 0


def test_a_lost_a_doubled_and_a_broken_segment_are_noticed(marched):
    stress, planes, rays, segments = marched
    length = np.asarray(segments.t_exit - segments.t_enter)
    ray, slot = np.unravel_index(np.argmax(length), length.shape)
    lost = segments.replace(t_exit=segments.t_exit.at[ray, slot].set(segments.t_enter[ray, slot]))
    assert stress.chord_errors(planes, rays, lost, 1e-4)[ray] == pytest.approx(-length[ray, slot], abs=1e-3)
    earlier = segments.t_enter.at[ray, slot].add(-0.1) if slot else segments.t_enter
    longer = segments.replace(t_enter=earlier, t_exit=segments.t_exit.at[ray, slot].add(0.1))
    assert stress.chord_errors(planes, rays, longer, 1e-4)[ray] > 0.09
    assert stress.overlapping(longer, 1e-4)[ray]
    broken = segments.replace(t_enter=segments.t_enter.at[0, 0].set(jnp.nan))
    assert stress.count_nonfinite(broken) == 1


def test_a_ray_in_a_boundary_face_may_count_as_inside_or_outside(marched):
    stress, planes, _, _ = marched
    top = float(np.abs(np.asarray(planes)[:, :, 3]).max())
    origin, direction = np.array([[0.1, -3.0, top]]), np.array([[0.0, 1.0, 0.0]])
    low, high = stress.chord_range(planes, origin, direction, "float32")
    assert low == 0
    assert high == pytest.approx(2 * top, abs=1e-3)


def test_the_front_holds_what_nothing_beats():
    pareto = script("pareto")
    rows = [{"ms": ms, "mean_error": error} for ms, error in [(1, 9), (2, 5), (3, 5), (4, 1), (5, 2)]]
    pareto.mark_front(rows)
    assert [row["front"] for row in rows] == [True, True, False, True, False]
