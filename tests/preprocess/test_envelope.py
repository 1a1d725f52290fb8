import numpy as np
import pytest
import trimesh

from nimpostor_jax.preprocess.envelope import (
    envelope_from_grid,
    envelope_from_surface,
    voxelize_surface,
)
from nimpostor_jax.preprocess.surface import check_surface, load_surface, self_intersections
from nimpostor_jax.preprocess.visual_hull import OccupancyGrid


def ball_grid(radius=0.5, voxel_size=0.05):
    axis = np.arange(-14, 15) * voxel_size
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    return OccupancyGrid(x**2 + y**2 + z**2 < radius**2, np.full(3, axis[0]), voxel_size)


def assert_closed_and_outward(surface):
    check_surface(surface)
    assert surface.is_winding_consistent
    assert surface.volume > 0


@pytest.mark.parametrize("step", [None, 0.12])
def test_envelope_of_a_ball_lies_at_the_offset(step):
    grid = ball_grid()
    surface = envelope_from_grid(grid, 0.15, step)
    assert_closed_and_outward(surface)
    radii = np.linalg.norm(surface.vertices, axis=1)
    # The outermost voxel centres lie up to a voxel (0.05) inside the ball; linear interpolation of
    # distances on the coarse grid (0.12) cuts up to 0.12**2 / (8 * 0.15) = 0.012.
    assert radii.min() > 0.5 - 0.05 + 0.15 - 0.013
    assert radii.max() < 0.5 + 0.15 + 0.013


def test_small_offset_still_contains_the_voxels():
    grid = ball_grid()
    surface = envelope_from_grid(grid, 1e-6)
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3) * grid.voxel_size
    points = (grid.centers[:, None] + corners).reshape(-1, 3)
    assert surface.contains(points[::7]).all()


def test_separate_parts_and_thin_ones_are_enclosed():
    occupied = np.zeros((40, 20, 20), bool)
    occupied[4:8, 4:8, 4:8] = occupied[30, 10, 2:18] = True
    surface = envelope_from_grid(OccupancyGrid(occupied, np.zeros(3), 1.0), 2.0, 1.6)
    assert_closed_and_outward(surface)
    assert surface.body_count == 2
    assert surface.contains(np.argwhere(occupied).astype(float)).all()


def test_closed_parts_may_touch_along_edges(tmp_path):
    """Boxes side by side have four triangles at the edges where they touch; inside is still inside."""
    boxes = [trimesh.creation.box(bounds=[[0, 0, z], [1, 1, z + 1]]) for z in (0.0, 1.0)]
    trimesh.util.concatenate(boxes).export(tmp_path / "boxes.stl")
    surface = load_surface(tmp_path / "boxes.stl")
    assert len(surface.vertices) == 12
    grid = voxelize_surface(surface, resolution=32, allow_self_intersections=True)
    assert grid.occupied.shape == (16, 16, 32) and grid.occupied.all()
    hole = trimesh.Trimesh(surface.vertices, surface.faces[:-1], process=False)
    with pytest.raises(ValueError, match=r"not closed: \d+ boundary edges"):
        check_surface(hole)


def test_walls_of_two_sides_close_nothing():
    """A cup, each of whose triangles is there from within, too."""
    box = trimesh.creation.box()
    lid = np.isclose(box.triangles_center[:, 2], 0.5)
    walls = box.faces[~lid]
    cup = trimesh.Trimesh(box.vertices, np.concatenate([walls, walls[:, ::-1]]), process=False)
    with pytest.raises(ValueError, match=r"not closed: all of its triangles are there twice"):
        check_surface(cup)
    beside = trimesh.util.concatenate([cup, trimesh.creation.box(bounds=[[2, 0, 0], [3, 1, 1]])])
    check_surface(beside)  # a closed part, and what has no inside


def test_triangles_of_two_corners_are_dropped(tmp_path):
    """As quads at the poles of a sphere become."""
    angles = np.linspace(0, 2 * np.pi, 9)[:-1]
    heights = np.linspace(0, np.pi, 6)
    points = [[np.sin(h) * np.cos(a), np.sin(h) * np.sin(a), np.cos(h)] for h in heights for a in angles]
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points]
    for i in range(5):
        for j in range(8):
            k = (j + 1) % 8
            quad = (i, j), (i + 1, j), (i + 1, k), (i, k)
            lines.append("f " + " ".join(str(8 * row + column + 1) for row, column in quad))
    (tmp_path / "sphere.obj").write_text("\n".join(lines))
    surface = load_surface(tmp_path / "sphere.obj")
    assert len(surface.faces) == 2 * 8 * 4  # two at each of 3 rings of quads, one at each pole's
    check_surface(surface)


def test_voxels_of_a_surface_contain_it_and_its_inside():
    box = trimesh.creation.box(extents=(2.0, 1.0, 0.5))
    grid = voxelize_surface(box, resolution=32)
    # 2 x 1 x 0.5 in voxels of 1/16; the surface touches whole layers only.
    assert grid.occupied.shape == (32, 16, 8)
    assert grid.occupied.all()


def test_envelope_of_a_surface_contains_it():
    knot = trimesh.creation.torus(1.0, 0.2)
    surface = envelope_from_surface(knot, 0.05, resolution=64)
    assert_closed_and_outward(surface)
    assert surface.contains(knot.vertices).all()
    assert surface.euler_number == 0  # the hole of the torus is still there


def test_an_open_surface_is_refused_with_its_edges_counted():
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.update_faces(np.arange(len(ball.faces)) != 7)
    with pytest.raises(ValueError, match=r"bowl.obj: the surface is not closed: 3 boundary edges"):
        envelope_from_surface(ball, 0.1, source="bowl.obj")


def test_a_self_intersecting_surface_is_refused_unless_allowed():
    first = trimesh.creation.icosphere(subdivisions=2)
    second = first.copy()
    second.apply_translation([0.9, 0.1, 0.2])
    both = trimesh.util.concatenate([first, second])
    with pytest.raises(ValueError, match=r"two.obj: the surface intersects itself in \d+ pairs"):
        voxelize_surface(both, 32, "two.obj")
    grid = voxelize_surface(both, 32, "two.obj", allow_self_intersections=True)
    surface = envelope_from_grid(grid, 0.1)
    assert surface.body_count == 1
    assert surface.contains(both.vertices).all()


def test_self_intersections_are_those_of_a_brute_force_search():
    rng = np.random.default_rng(1)
    vertices = rng.normal(size=(90, 3))
    faces = np.arange(90).reshape(30, 3)
    found = {tuple(pair) for pair in self_intersections(vertices, faces).tolist()}

    def pierces(p, q, triangle):  # solves p + t (q - p) = a + u (b - a) + v (c - a)
        a, b, c = triangle
        t, u, v = np.linalg.solve(np.stack([p - q, b - a, c - a], axis=1), p - a)
        return 0 < t < 1 and u > 0 and v > 0 and u + v < 1

    corners = vertices[faces]
    expected = set()
    for i in range(30):
        for j in range(i + 1, 30):
            for one, other in ((i, j), (j, i)):
                for k in range(3):
                    if pierces(corners[one, k], corners[one, (k + 1) % 3], corners[other]):
                        expected.add((i, j))
    assert found == expected
    assert expected


def test_a_clean_surface_has_no_self_intersection():
    ball = trimesh.creation.icosphere(subdivisions=3)
    assert len(self_intersections(ball.vertices, ball.faces)) == 0


def test_empty_and_non_finite_input():
    with pytest.raises(ValueError, match=r"no.obj: the surface is empty"):
        check_surface(trimesh.Trimesh(), "no.obj")
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices = ball.vertices.copy()
    vertices[5, 1] = np.nan
    broken = trimesh.Trimesh(vertices, ball.faces, process=False, validate=False)
    with pytest.raises(ValueError, match=r"1 non-finite vertices \(first: 5\)"):
        check_surface(broken, "no.obj")
    with pytest.raises(ValueError, match="is empty"):
        envelope_from_grid(OccupancyGrid(np.zeros((4, 4, 4), bool), np.zeros(3), 1.0), 0.1)
