"""What the measuring scripts compute by themselves: the stress test's oracle, the Pareto front, peers."""

import importlib.util
import sys
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


@pytest.fixture
def peers(monkeypatch):
    """The modules `peers` and `peers_match`."""
    monkeypatch.syspath_prepend(EXPERIMENTS)
    return importlib.import_module("peers"), importlib.import_module("peers_match")


SMALL_WORK = dict(repeats=1, points=256, slow_points=64, rays=256, slow_rays=64, checked_rays=64, batches=())
SMALL_TABLES = dict(encoded=256, num_levels=4, log2_table=10)


@pytest.mark.parametrize(
    "name",
    ["locate_vs_scipy", "locate_vs_vtk", "encode_fwd_vs_drjit", "encode_bwd_vs_drjit", "encode_fwd_vs_torch"],
)
def test_peers_agree_or_are_absent(name, peers):
    peers, match = peers
    cage = script("stress").kuhn_grid(2)
    work = match.Work(**SMALL_WORK, **SMALL_TABLES, cage=lambda: (cage[0].astype(np.float64), cage[1]))
    (row,) = peers.compare_all(work, [name])
    assert row["name"] == name
    if "absent" in row:
        assert "drjit" in row["absent"] or "Dr.Jit" in row["absent"] or "torch" in row["absent"]
    else:
        assert row["ratio"] == pytest.approx(row["ours_ms"] / row["peer_ms"])
        assert row["ours_threads"] >= 1 and row["peer_threads"] >= 1 and row["compile_s"] >= 0
        assert row["agree"] > 0.9  # of points near faces, some are theirs and some ours


def test_a_peer_that_is_not_installed_is_reported(peers, monkeypatch):
    peers, match = peers
    monkeypatch.setitem(sys.modules, "drjit", None)  # as if it were not installed
    rows = list(peers.compare_all(match.Work(**SMALL_WORK, **SMALL_TABLES), ["vs_drjit"]))
    assert len(rows) == 6
    assert all("drjit" in row["absent"] and "ratio" not in row for row in rows)


def test_sides_are_timed_in_turns(peers):
    _, match = peers
    calls = []
    sides = match.Match(lambda: calls.append("ours"), lambda: calls.append("peer"))
    row = match.compare("turns", lambda work: sides, match.Work(repeats=3))
    assert calls == ["ours", "peer"] * 4  # the first compiles
    assert row["name"] == "turns" and row["ratio"] > 0


def test_float64_chords_add_up(peers):
    cage = script("stress").kuhn_grid(2)
    geometry = importlib.import_module("peers_geometry")
    low, high = cage[0].min(axis=0), cage[0].max(axis=0)
    middle = 0.3 * low + 0.7 * high + np.array([0.01, 0.02, 0.03])  # in no face
    origins = np.stack([middle - 5 * np.eye(3)[0], middle + 50])
    directions = np.stack([np.eye(3)[0], np.eye(3)[1]])
    lengths = geometry.chords(*cage, origins, directions)
    np.testing.assert_allclose(lengths, [high[0] - low[0], 0], atol=1e-12)
