import numpy as np
import pytest
import trimesh

from nimpostor_jax.preprocess import tetrahedralize as module
from nimpostor_jax.preprocess.tetrahedralize import box_tets, run_ftetwild, tetrahedralize
from nimpostor_jax.preprocess.tighten import tighten
from nimpostor_jax.preprocess.validate import (
    check_tets,
    orient_tets,
    outside_points,
    quality_report,
    signed_volumes,
)


def ball_envelope(offset, step):
    return trimesh.creation.icosphere(subdivisions=4, radius=0.5 + offset)


DIAGONAL = 3.0**0.5


def test_ftetwild_gives_positive_tets_and_uses_every_vertex(capfd):
    surface = trimesh.creation.icosphere(subdivisions=3)
    vertices, tets = run_ftetwild(surface, epsilon=0.05)
    check_tets(vertices, tets)
    assert tets.dtype == np.int32 and vertices.dtype == np.float64
    assert set(np.unique(tets)) == set(range(len(vertices)))
    # The surface may move by the tolerance, 0.05 of a radius of 1.
    assert 0.8 < signed_volumes(vertices, tets).sum() / surface.volume < 1.15
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("target", [200, 900])
def test_target_count_is_met(target):
    lines = []
    vertices, tets = tetrahedralize(ball_envelope, target, DIAGONAL, 0.02, lines.append)
    check_tets(vertices, tets)
    assert abs(len(tets) / target - 1) <= 0.2
    assert 1 <= len(lines) <= module.MAX_CALLS
    # The envelope stands off by more than the tolerance, so that the ball itself is inside.
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    assert not outside_points(np.asarray(ball.vertices), vertices, tets).any()


def test_a_crash_of_ftetwild_is_an_attempt_without_result(monkeypatch, tmp_path):
    surface = trimesh.creation.icosphere(subdivisions=2)
    program = tmp_path / "program.py"
    monkeypatch.setattr(module, "_PROGRAM", program)
    program.write_text("import os; os.abort()")
    vertices, tets = run_ftetwild(surface, epsilon=0.05)
    assert vertices.shape == (0, 3) and tets.shape == (0, 4)
    program.write_text("import no_such_module_anywhere")
    with pytest.raises(RuntimeError, match="no_such_module_anywhere"):
        run_ftetwild(surface, epsilon=0.05)


def test_the_search_stops_at_the_largest_tolerance(monkeypatch):
    calls = fake_counts(monkeypatch, lambda eps: 90)
    with pytest.raises(ValueError, match=r"no cage with about 30 tets: .* has 90; ask for about"):
        tetrahedralize(ball_envelope, 30, DIAGONAL, 0.02, lambda _: None)
    assert len(calls) == 1


def fake_counts(monkeypatch, count_of_epsilon):
    """Replace fTetWild by rows of boxes whose number follows from the tolerance."""
    calls = []

    def fake(surface, epsilon, edge_length_factor):
        count = max(1, round(count_of_epsilon(epsilon / DIAGONAL) / 6))
        calls.append(epsilon)
        vertices, tets = box_tets(np.array([[0.0] * 3, [1.0] * 3]))
        shift = 2.0 * np.arange(count)[:, None, None] * [1.0, 0.0, 0.0]
        rows = tets[None] + 8 * np.arange(count)[:, None, None]
        return (vertices + shift).reshape(-1, 3), rows.reshape(-1, 4).astype(np.int32)

    monkeypatch.setattr(module, "run_ftetwild", fake)
    return calls


def test_search_copes_with_a_noisy_count(monkeypatch):
    noise = np.random.default_rng(3)
    # A weaker law than the search assumes, and the spread that fTetWild shows.
    calls = fake_counts(
        monkeypatch, lambda eps: 350 * (0.02 / eps) ** 0.9 * noise.uniform(0.85, 1.15)
    )
    for target in (150, 350, 1500):
        calls.clear()
        _, tets = tetrahedralize(ball_envelope, target, DIAGONAL, 0.02, lambda _: None)
        assert abs(len(tets) / target - 1) <= 0.2
        assert len(calls) <= module.MAX_CALLS


def test_a_result_off_target_is_said_and_one_far_off_is_an_error(monkeypatch):
    fake_counts(monkeypatch, lambda eps: 450)
    lines = []
    _, tets = tetrahedralize(ball_envelope, 350, DIAGONAL, 0.02, lines.append)
    assert len(tets) == 450
    assert "warning: 450 tets, +29% off the target of 350" in lines[-1]
    with pytest.raises(ValueError, match=r"no cage with about 100 tets: .* has 450"):
        tetrahedralize(ball_envelope, 100, DIAGONAL, 0.02, lambda _: None)


def test_no_usable_mesh_is_an_error(monkeypatch):
    nothing = (np.zeros((0, 3)), np.zeros((0, 4), np.int32))
    monkeypatch.setattr(module, "run_ftetwild", lambda *_: nothing)
    with pytest.raises(ValueError, match="no usable mesh"):
        tetrahedralize(ball_envelope, 100, DIAGONAL, 0.02, lambda _: None)


def test_the_smallest_cage_is_a_box():
    vertices, tets = tetrahedralize(ball_envelope, 6, DIAGONAL, 0.02)
    check_tets(vertices, tets)
    assert len(tets) == 6
    half = 0.5 + 0.02 * DIAGONAL
    np.testing.assert_allclose(np.ptp(vertices, axis=0), 2 * half, rtol=1e-12)
    np.testing.assert_allclose(signed_volumes(vertices, tets).sum(), (2 * half) ** 3, rtol=1e-12)


def test_tightening_keeps_the_points_and_loses_volume():
    loose = trimesh.creation.icosphere(subdivisions=3, radius=0.8)
    vertices, tets = run_ftetwild(loose, epsilon=0.06)
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.5)
    points = np.asarray(ball.vertices)
    assert not outside_points(points, vertices, tets).any()
    tight = tighten(vertices, tets, points)
    check_tets(tight, tets)
    assert not outside_points(points, tight, tets, tolerance=1e-8).any()
    before, after = quality_report(vertices, tets), quality_report(tight, tets)
    # The loose cage has about 4 times the ball's volume; a polyhedron of some 100 faces can get
    # within a few tenths of it.
    assert ball.volume < after.volume < 0.5 * before.volume
    assert after.num_overlapping_tets == 0
    np.testing.assert_array_equal(tight, tighten(vertices, tets, points))  # deterministic


def test_tets_on_one_side_of_a_face_are_not_sound():
    """As fTetWild's inverted ones are after they were turned around: it is to try again."""
    vertices, tets = box_tets(np.array([[0.0] * 3, [1.0] * 3]))
    assert module.is_sound(vertices, tets)
    inner = np.concatenate([vertices, [[0.5, 0.6, 0.7]]])
    beside = orient_tets(np.append(tets[0, :3], 8)[None], inner)
    assert not module.is_sound(inner, np.concatenate([tets[:1], beside]))
