"""What the measuring scripts compute by themselves: the stress test's oracle, fits, fronts, peers."""

import importlib
import importlib.util
import json
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nimpostor_jax.config import CageConfig, MarchConfig
from nimpostor_jax.preprocess.tetrahedralize import box_tets
from nimpostor_jax.preprocess.visual_hull import OccupancyGrid

EXPERIMENTS = Path(__file__).resolve().parents[1] / "experiments"


@pytest.fixture(autouse=True)
def beside_each_other(monkeypatch):
    """Scripts import their neighbours, as they do when they are run."""
    monkeypatch.syspath_prepend(str(EXPERIMENTS))


@pytest.fixture
def marched(x64, rng):
    """The stress script, and rays that it finds in order on a small grid."""
    stress, meshes = (importlib.import_module(name) for name in ("stress", "stress_meshes"))
    case = meshes.Case(meshes.kuhn_grid(2, 2, 2), chunk=64)
    mesh = meshes.build(case, "float32")
    rays, lines = stress.draw_rays(case, mesh, "random", rng)
    march = MarchConfig(max_tets_per_ray=32, max_entries_per_ray=4)
    _, segments, _ = stress.march_rays(mesh, rays, jnp.float32(stress.BEHIND), march)
    return stress, stress.solid_of(mesh), lines, segments, mesh


def errors_of(stress, solid, lines, segments):
    return stress.chord_errors(solid, lines, np.array(stress.lengths(segments)), 1e-4)


def test_the_oracle_agrees_with_the_march(marched):
    stress, solid, lines, segments, mesh = marched
    assert np.abs(errors_of(stress, solid, lines, segments)).max() < 1e-4
    assert not np.any(stress.overlapping(segments, 1e-4))
    assert stress.count_nonfinite(segments) == 0
    errors = stress.color_errors(mesh, solid, segments, lines, 1e-4)
    assert len(errors) > 40
    assert errors.max() < 1e-4


def test_a_lost_a_doubled_and_a_broken_segment_are_noticed(marched):
    stress, solid, lines, segments, mesh = marched
    length = np.asarray(segments.t_exit - segments.t_enter)
    longest = np.argmax(length)
    ray = int(segments.rays[longest])
    lost = segments.replace(t_exit=segments.t_exit.at[longest].set(segments.t_enter[longest]))
    assert errors_of(stress, solid, lines, lost)[ray] == pytest.approx(-length[longest], abs=1e-3)
    halved = segments.replace(t_exit=(segments.t_enter + segments.t_exit) / 2)
    assert stress.color_errors(mesh, solid, halved, lines, 1e-4).max() > 0.01
    longer = segments.replace(t_exit=segments.t_exit.at[longest].add(0.1))
    assert errors_of(stress, solid, lines, longer)[ray] > 0.09
    columns = ("rays", "tet_ids", "t_enter", "t_exit", "lambda_enter", "lambda_exit")
    twice = segments.replace(**{name: jnp.repeat(getattr(segments, name), 2, axis=0) for name in columns})
    assert stress.overlapping(twice, 1e-4)[ray]
    broken = segments.replace(t_enter=segments.t_enter.at[0].set(jnp.nan))
    assert stress.count_nonfinite(broken) == 1


def test_a_ray_in_a_boundary_face_may_count_as_inside_or_outside(marched):
    stress, solid, lines, _, mesh = marched
    top = float(jnp.max(mesh.vertices))
    face = stress.take(lines, np.zeros(1, int)).replace(
        origins=jnp.array([[0.1, -3.0, top]]), directions=jnp.array([[0.0, 1.0, 0.0]])
    )
    low, high = stress.chord_range(stress.pieces(solid, face))
    assert low == 0
    assert high == pytest.approx(2 * top, abs=1e-3)


@pytest.mark.parametrize("name", ["pancake", "foil", "slivers", "huge", "far_away", "scrambled", "collapsed"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_little_stress(name, dtype, x64, rng):
    """Every kind of ray through every awkward mesh; all are padded to one size and compile once."""
    stress, meshes = (importlib.import_module(name) for name in ("stress", "stress_meshes"))
    case = meshes.MESHES[name](np.random.default_rng(0))._replace(chunk=128)
    row = stress.stress(case, dtype, 1, 0)
    assert row["rays"] == 128 * len(meshes.RAYS)
    assert row["lost"] == row["doubled"] == row["nonfinite"] == row["overflow"] == 0
    assert row["max_chord_error"] <= stress.TOLERANCE[dtype]
    assert row["color_error"] <= stress.TOLERANCE[dtype]


def test_exponents_are_slopes_of_logarithms():
    scaling = importlib.import_module("scaling")
    rows = [{"sweep": "cage", "tets": n, "ns_per_ray": 5 * n**0.3, "peak_memory_gib": 1.0, "build_s": n}
            for n in (6, 300, 3000, 30000)]  # fmt: skip
    fits = scaling.exponents([{"pixels": 1, **row} for row in rows])
    assert fits["cage: ns_per_ray by tets"] == pytest.approx(0.3)
    assert fits["cage: build_s by tets"] == pytest.approx(1)
    assert np.isnan(fits["image: ms by pixels"])


def test_scaling_measures_a_small_cage():
    row = importlib.import_module("scaling").time_march("cage", 2, 32, 1024, 1)
    assert row["tets"] == 48 and row["rays"] == 1024
    assert row["ms"] > 0 and row["peak_memory_gib"] > 0
    assert 1 < row["segments_per_ray"] < 24


def test_the_front_holds_what_nothing_beats():
    pareto = importlib.import_module("pareto")
    rows = [{"ms": ms, "mean_error": error} for ms, error in [(1, 9), (2, 5), (3, 5), (4, 1), (5, 2)]]
    pareto.mark_front(rows)
    assert [row["front"] for row in rows] == [True, True, False, True, False]


@pytest.fixture
def peers(monkeypatch):
    """The modules `peers` and `peers_match`."""
    monkeypatch.syspath_prepend(EXPERIMENTS)
    return importlib.import_module("peers"), importlib.import_module("peers_match")


SMALL_WORK = dict(
    repeats=1,
    min_seconds=0.0,
    points=256,
    slow_points=64,
    rays=256,
    slow_rays=64,
    checked_rays=64,
    batches=(),
)
SMALL_TABLES = dict(encoded=256, num_levels=4, log2_table=10)


@pytest.mark.parametrize(
    "name",
    ["locate_vs_scipy", "locate_vs_vtk", "encode_fwd_vs_drjit", "encode_bwd_vs_drjit", "encode_fwd_vs_torch"],
)
def test_peers_agree_or_are_absent(name, peers):
    peers, match = peers
    cage = importlib.import_module("stress_meshes").kuhn_grid(2, 2, 2)
    work = match.Work(**SMALL_WORK, **SMALL_TABLES, cage=lambda: (cage[0].astype(np.float64), cage[1]))
    (row,) = peers.compare_all(work, [name])
    assert row["name"] == name
    if "absent" in row and ("drjit" in row["absent"] or "torch" in row["absent"]):
        pytest.skip(row["absent"])
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
    row = match.compare("turns", lambda work: sides, match.Work(repeats=3, min_seconds=0.0))
    warmed = ["ours"] * 2 + ["peer"] * 2  # an untimed call before each that is timed
    assert calls == ["ours", "peer"] + warmed * 3  # the first compiles
    assert row["name"] == "turns" and row["ratio"] > 0


def test_small_batches_hold_tiles_like_those_of_large_ones(peers):
    """Of a few tiles drawn at random, most might miss the cage."""
    _, match = peers
    vertices, tets = importlib.import_module("stress_meshes").kuhn_grid(2, 2, 2)
    cage, geometry = (vertices.astype(np.float64), tets), importlib.import_module("peers_geometry")
    work = match.Work(**SMALL_WORK | dict(batches=(1 << 14,)), cage=lambda: cage)
    batches = [partial(geometry.traverse_batch, count, 1) for count in (1 << 11, 1 << 14)]
    rows = [match.compare("batch", batch, work) for batch in batches]
    small, large = (row["segments"] / row["rays"] for row in rows)
    assert small == pytest.approx(large, rel=0.1) and large > 1
    assert not any(row["lost"] for row in rows)


def test_float64_chords_add_up(peers):
    cage = importlib.import_module("stress_meshes").kuhn_grid(2, 2, 2)
    geometry = importlib.import_module("peers_geometry")
    low, high = cage[0].min(axis=0), cage[0].max(axis=0)
    middle = 0.3 * low + 0.7 * high + np.array([0.01, 0.02, 0.03])  # in no face
    origins = np.stack([middle - 5 * np.eye(3)[0], middle + 50])
    directions = np.stack([np.eye(3)[0], np.eye(3)[1]])
    lengths = geometry.chords(*cage, origins, directions)
    np.testing.assert_allclose(lengths, [high[0] - low[0], 0], atol=1e-12)


def test_step_times_are_medians_of_whole_lines(monkeypatch, tmp_path):
    """The first line counts one step only, and compiles."""
    monkeypatch.syspath_prepend(EXPERIMENTS)
    versions = importlib.import_module("compare_versions")
    lines = [(1, 9.0), (50, 10.0), (100, 15.0), (150, 21.0), (200, 100.0)]
    log = tmp_path / "log.csv"
    log.write_text("step,seconds\n" + "".join(f"{step},{seconds}\n" for step, seconds in lines))
    assert versions.step_ms(log) == pytest.approx(6e3 / 50)


def test_compiling_is_clocked_and_running_is_not():
    clock = importlib.import_module("compile_clock").CompileClock()
    function = jax.jit(lambda x: jnp.sin(x) @ x)
    function(jnp.ones((7, 7)))
    compiled = clock.seconds
    assert compiled > 0
    function(jnp.ones((7, 7))).block_until_ready()
    assert clock.seconds == compiled


def test_a_loose_cage_draws_more_rays_so_that_as_many_show_the_object():
    """The four middle pixels of 16 x 16: all rays hit the large box, and those four alone the small one."""
    figure10 = importlib.import_module("figure10")
    masks = np.zeros((2, 16, 16), np.float32)
    masks[:, 7:9, 7:9] = 1
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 2, 3] = 20
    cameras = {"camera_to_world": poses, "focal": np.full((2, 2), 20.0), "principal": np.full((2, 2), 8.0)}
    views = SimpleNamespace(masks=masks, **cameras)
    for half_size, expected in [(10.0, 6400), (1.0, 128)]:  # 100 times 256 / 4, and 100, in steps of 64
        cage = box_tets(np.array([[-half_size] * 3, [half_size] * 3]))
        assert figure10.rays_per_batch(cage, views, 100) == expected


def test_a_refused_baking_costs_its_own_row_alone(monkeypatch, tmp_path):
    table2, ladder = (importlib.import_module(name) for name in ("table2", "ladder"))

    def train(method, config, scene, cage, workdir):
        row = {"method": method, "scene": Path(scene).name, "psnr": 30.0, "steps": 1, "rays_per_batch": 1}
        return ladder.Trained(SimpleNamespace(test=None), None, row)

    def bake(source, workdir):
        if source.row["scene"] == "furry":
            raise ValueError("3310 MB")
        return None, {**source.row, "method": "Baked"}

    for name, stand_in in [
        ("cage_of", lambda *_: None),
        ("train_or_reuse", train),
        ("bake_or_reuse", bake),
        ("write_picture", lambda *_: None),
        ("use_all_cores", lambda: None),
    ]:
        monkeypatch.setattr(table2, name, stand_in)
    methods = ["NGP-Bounded", "FeatInt"]
    with pytest.raises(ValueError, match=r"1 of the baked rows .*furry at 24: 3310 MB"):
        table2.main(["--scene", "furry", "smooth", f"--out={tmp_path}", "--quick", "--methods", *methods])
    rows = json.loads((tmp_path / "table2.json").read_text())["rows"]
    assert [row["method"] for row in rows] == [*methods, *methods, "Baked"]


def test_a_runs_claim_knows_the_held_out_pictures(tmp_path):
    ladder = importlib.import_module("ladder")
    ladder._claim(tmp_path, "a = 1\n", np.zeros(3), np.ones(2))
    ladder._claim(tmp_path, "a = 1\n", np.zeros(3), np.ones(2))
    with pytest.raises(ValueError, match="its cage, pictures or field"):
        ladder._claim(tmp_path, "a = 1\n", np.zeros(3), np.zeros(2))
    views = SimpleNamespace(images=1, backgrounds=2, camera_to_world=3, focal=4, principal=5)
    assert sorted(ladder._content(views)) == [1, 2, 3, 4, 5]


def test_proxies_lie_as_far_off_the_object_as_asked_for(monkeypatch):
    """However the hull lies in its array of voxels."""
    figure10 = importlib.import_module("figure10")
    occupied = np.zeros((16, 16, 16), bool)
    occupied[5:15, 3:9, 1:5] = True
    hull = OccupancyGrid(occupied, np.array([1.0, 2, 3]), 0.1)
    monkeypatch.setattr(figure10, "visual_hull", lambda *_, **__: hull)
    views = SimpleNamespace(masks=None, camera_to_world=None, focal=None, principal=None, names=None)
    vertices, tets = figure10.proxy_cage("box", views, CageConfig(margin=0.05))
    # Held are the centres of the voxels, half of one within the bounds.
    gap = 0.05 * np.linalg.norm(np.diff(hull.bounds, axis=0)) - 0.05
    expected = hull.bounds + gap * np.array([[-1], [1]])
    np.testing.assert_allclose([vertices.min(axis=0), vertices.max(axis=0)], expected, atol=1e-9)
    assert len(tets) == 6
