import numpy as np
import pytest
from posed_balls import pixel_rays, posed_balls

from nimpostor_jax.preprocess.tetrahedralize import box_tets
from nimpostor_jax.preprocess.validate import (
    aspect_ratios,
    boundary_faces,
    check_coverage,
    check_tets,
    dihedral_angles,
    missed_foreground,
    orient_tets,
    outside_points,
    overlapping_tets,
    quality_report,
    signed_volumes,
)

REGULAR = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
ONE = np.array([[0, 1, 2, 3]], np.int32)


def regular():
    return REGULAR, orient_tets(ONE, REGULAR)


def box(low=-0.5, high=0.5):
    return box_tets(np.array([[low] * 3, [high] * 3]))


def two(first, second):
    return (
        np.concatenate([first[0], second[0]]),
        np.concatenate([first[1], second[1] + len(first[0])]),
    )


def test_regular_tet_has_the_known_angles_and_aspect():
    vertices, tets = regular()
    # Six float64 operations each: 1e-12.
    np.testing.assert_allclose(dihedral_angles(vertices, tets), np.degrees(np.arccos(1 / 3)), 1e-12)
    np.testing.assert_allclose(aspect_ratios(vertices, tets), 1.0, rtol=1e-12)
    np.testing.assert_allclose(signed_volumes(vertices, tets), 8.0 / 3.0, rtol=1e-12)


def test_report_of_a_box():
    report = quality_report(*box())
    assert (report.num_vertices, report.num_tets, report.num_boundary_faces) == (8, 6, 12)
    assert (report.num_components, report.num_overlapping_tets) == (1, 0)
    np.testing.assert_allclose(report.volume, 1.0, rtol=1e-12)
    np.testing.assert_allclose([report.min_dihedral, report.max_dihedral], [45.0, 90.0], rtol=1e-9)
    text = str(report)
    assert "6 tets" in text and "45.0 to 90.0 degrees" in text and "0 overlapping" in text


def test_components_are_those_connected_across_faces():
    apart = two(box(), box(2.0, 3.0))
    assert quality_report(*apart).num_components == 2
    vertices, tets = regular()
    # Two tets that share an edge only.
    joined = np.concatenate([vertices, vertices[2:] + np.array([5.0, 0, 0])])
    tets = orient_tets(np.array([[0, 1, 2, 3], [0, 1, 4, 5]]), joined)
    assert quality_report(joined, tets).num_components == 2


@pytest.mark.parametrize("shift", [0.0, 0.3])
def test_overlapping_copies_are_found(shift):
    vertices, tets = box()
    copies = two((vertices, tets), (vertices + shift, tets))
    report = quality_report(*copies)
    assert report.num_overlapping_tets >= (12 if shift == 0.0 else 6)
    assert report.num_components == 2


def test_a_small_tet_inside_a_large_one_overlaps():
    vertices, tets = regular()
    nested = two((vertices, tets), (0.05 * vertices + [0.1, 0.2, 0.1], tets))
    assert overlapping_tets(*nested).all()


def test_touching_boxes_do_not_overlap():
    vertices, tets = box()
    assert not overlapping_tets(
        *two((vertices, tets), (vertices + np.array([1.0, 0, 0]), tets))
    ).any()


def test_boundary_faces_point_outward():
    vertices, tets = box()
    faces = boundary_faces(tets)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a)
    assert len(faces) == 12 and (outward > 0).all()


def test_orient_tets_turns_only_the_inverted():
    vertices, tets = box()
    mixed = tets.copy()
    mixed[[1, 4]] = mixed[[1, 4]][:, [1, 0, 2, 3]]
    oriented = orient_tets(mixed, vertices)
    assert (signed_volumes(vertices, oriented) > 0).all()
    np.testing.assert_array_equal(oriented[[0, 2, 3, 5]], tets[[0, 2, 3, 5]])


def _broken(kind):
    vertices, tets = box()
    vertices, tets = vertices.copy(), tets.copy()
    if kind == "nan":
        vertices[3, 1] = np.nan
    elif kind == "range":
        tets[2, 0] = 8
    elif kind == "negative":
        tets[2, 0] = -1
    elif kind == "inverted":
        tets[4] = tets[4, [1, 0, 2, 3]]
    elif kind == "degenerate":
        tets[5, 0] = tets[5, 1]
    elif kind == "triple":
        tets = np.concatenate([tets, tets[:1], tets[:1]])
    elif kind == "float":
        tets = tets.astype(float)
    elif kind == "empty":
        tets = tets[:0]
    return vertices, tets


@pytest.mark.parametrize(
    "kind, message",
    [
        ("nan", r"1 non-finite vertices \(first: 3\)"),
        ("range", r"1 tets with indices outside 0..7 \(first: 2\)"),
        ("negative", r"1 tets with indices outside 0..7 \(first: 2\)"),
        ("inverted", r"1 inverted tets .*\(first: 4\); call orient_tets"),
        ("degenerate", r"1 degenerate tets .*\(first: 5\)"),
        ("triple", r"tet \d+: its face \(.*\) belongs to more than two tets"),
        ("float", r"tets must be integers"),
        ("empty", r"no tets"),
    ],
)
def test_broken_meshes_are_refused_by_name(kind, message):
    with pytest.raises(ValueError, match=r"^a\.npz: .*" + message):
        check_tets(*_broken(kind), "a.npz")


def test_sound_meshes_pass_at_any_scale():
    vertices, tets = box()
    for scale in (1e-6, 1.0, 1e6):
        check_tets(scale * vertices, tets)


def test_outside_points():
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    np.testing.assert_array_equal(
        outside_points(points, *box()), (np.abs(points) > 0.5).any(axis=1)
    )


def test_missed_rays_are_those_of_a_slab_test():
    masks, poses, focal, principal = posed_balls([((0, 0, 0), 0.8)], count=6, side=48)
    coverage = missed_foreground(*box(), masks, poses, focal, principal)
    for i in range(6):
        origin, directions = pixel_rays(poses[i], focal[i], principal[i], 48)
        with np.errstate(divide="ignore"):
            crossings = (np.array([-0.5, 0.5])[:, None, None, None] - origin) / directions
        enter, leave = crossings.min(axis=0).max(axis=-1), crossings.max(axis=0).min(axis=-1)
        expected = ((masks[i] > 0) & (enter > leave)).sum()
        assert coverage.foreground[i] == (masks[i] > 0).sum()
        # Embree works in float32: a ray that grazes an edge may fall on either side.
        assert abs(coverage.missed[i] - expected) <= 2
    assert 0.1 < coverage.missed_share < 0.9


def test_a_cage_of_another_object_is_refused_with_the_worst_view():
    masks, *cameras = posed_balls([((0, 0, 0), 0.8)], count=6, side=32)
    masks[2, :4] = 0.01  # faint alpha at the border of one view
    vertices, tets = box()
    good = missed_foreground(2.0 * vertices, tets, masks, *cameras)
    assert good.missed.sum() == good.missed[2] > 0 and good.worst_view == 2
    with pytest.raises(ValueError, match=r"x.npz: .* worst view: 2 \(c\).*CageConfig.margin"):
        check_coverage(good, 0.0, list("abcdef"), "x.npz")
    check_coverage(good, 0.5)
    elsewhere = missed_foreground(vertices + 30.0, tets, masks, *cameras)
    assert elsewhere.missed_share == 1.0
    with pytest.raises(ValueError, match="another object"):
        check_coverage(elsewhere, 0.5)
