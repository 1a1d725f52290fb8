import meshio
import numpy as np
import pytest
import trimesh

from nimpostor_jax.io.mesh_files import load_surface, load_tets, save_tets
from nimpostor_jax.preprocess.tetrahedralize import box_tets
from nimpostor_jax.preprocess.validate import signed_volumes

SUFFIXES = [".npz", ".vtk", ".vtu", ".msh"]


@pytest.fixture
def cage():
    vertices, tets = box_tets(np.array([[-1.0, 0.0, 2.0], [1.0 / 3.0, np.pi, 5.0]]))
    return vertices, tets


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_round_trip_is_exact(tmp_path, cage, suffix):
    path = tmp_path / "new" / f"cage{suffix}"
    save_tets(path, *cage)
    vertices, tets = load_tets(path)
    assert vertices.dtype == np.float64 and tets.dtype == np.int32
    np.testing.assert_array_equal(vertices, cage[0])
    np.testing.assert_array_equal(tets, cage[1])
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_failed_write_leaves_the_old_file(tmp_path, cage, suffix, monkeypatch):
    path = tmp_path / f"cage{suffix}"
    save_tets(path, *cage)
    before = path.read_bytes()

    def broken(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez", broken)
    monkeypatch.setattr(meshio.Mesh, "write", broken)
    with pytest.raises(OSError, match="disk full"):
        save_tets(path, 2 * cage[0], cage[1])
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def test_inverted_tets_need_orient(tmp_path, cage):
    vertices, tets = cage
    np.savez(tmp_path / "flipped.npz", V=vertices, T=tets[:, [1, 0, 2, 3]])
    with pytest.raises(ValueError, match=r"flipped.npz: 6 inverted tets .*orient=True"):
        load_tets(tmp_path / "flipped.npz")
    loaded = load_tets(tmp_path / "flipped.npz", orient=True)
    assert (signed_volumes(*loaded) > 0).all()
    with pytest.raises(ValueError, match="inverted"):
        save_tets(tmp_path / "again.npz", vertices, tets[:, [1, 0, 2, 3]])
    assert not (tmp_path / "again.npz").exists()


def test_mixed_cells_keep_the_tets_and_surfaces_are_refused(tmp_path, cage):
    vertices, tets = cage
    triangles = ("triangle", tets[:, :3])
    meshio.Mesh(vertices, [triangles, ("tetra", tets[:4]), ("tetra", tets[4:])]).write(
        tmp_path / "mixed.vtu"
    )
    np.testing.assert_array_equal(load_tets(tmp_path / "mixed.vtu")[1], tets)
    meshio.Mesh(vertices, [triangles]).write(tmp_path / "skin.vtk")
    with pytest.raises(ValueError, match=r"skin.vtk: no tetra cells .*triangle"):
        load_tets(tmp_path / "skin.vtk")


def test_bad_files_say_what_is_there(tmp_path, cage):
    with pytest.raises(ValueError, match=r"unknown cage format '.obj'; use one of .npz"):
        load_tets(tmp_path / "cage.obj")
    with pytest.raises(ValueError, match="unknown cage format"):
        save_tets(tmp_path / "cage.txt", *cage)
    save_tets(tmp_path / "here.npz", *cage)
    with pytest.raises(FileNotFoundError, match=r"gone.npz: no such cage file.*here.npz"):
        load_tets(tmp_path / "gone.npz")
    np.savez(tmp_path / "keys.npz", V=cage[0], tets=cage[1])
    with pytest.raises(ValueError, match=r"keys.npz: no array 'T'; it has V, tets"):
        load_tets(tmp_path / "keys.npz")
    np.savez(tmp_path / "float.npz", V=cage[0], T=cage[1].astype(float))
    with pytest.raises(ValueError, match=r"float.npz: T must hold integers"):
        load_tets(tmp_path / "float.npz")
    np.savez(tmp_path / "text.npz", V=cage[0].astype(str), T=cage[1])
    with pytest.raises(ValueError, match=r"text.npz: V must hold numbers"):
        load_tets(tmp_path / "text.npz")
    np.savez(tmp_path / "wide.npz", V=cage[0], T=cage[1].astype(np.int64) + (1 << 32))
    with pytest.raises(ValueError, match=r"wide.npz: 6 tets with indices outside"):
        load_tets(tmp_path / "wide.npz")
    np.savez(tmp_path / "triangles.npz", V=cage[0], T=cage[1][:, :3])
    with pytest.raises(ValueError, match=r"triangles.npz: need .* tets \[m, 4\]"):
        load_tets(tmp_path / "triangles.npz", orient=True)
    whole = (tmp_path / "here.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"cut.npz: not an .npz archive"):
        load_tets(tmp_path / "cut.npz")
    for suffix in SUFFIXES:
        (tmp_path / f"garbage{suffix}").write_text("not a mesh\n")
        with pytest.raises(ValueError, match=f"garbage{suffix}: "):
            load_tets(tmp_path / f"garbage{suffix}")


def test_surface_vertices_are_merged_across_seams(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=1)
    loose = ball.triangles.reshape(-1, 3)
    lines = [f"v {x} {y} {z}" for x, y, z in loose.tolist()]
    lines += [f"f {3 * i + 1} {3 * i + 2} {3 * i + 3}" for i in range(len(ball.faces))]
    (tmp_path / "ball.obj").write_text("\n".join(lines))
    surface = load_surface(tmp_path / "ball.obj")
    assert len(surface.vertices) == len(ball.vertices) and surface.is_watertight


def test_unreadable_surfaces(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such surface file"):
        load_surface(tmp_path / "none.obj")
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(ValueError, match=r"points\.obj: "):
        load_surface(tmp_path / "points.obj")
    (tmp_path / "what.xyzzy").write_text("?")
    with pytest.raises(ValueError, match=r"what\.xyzzy: not a surface that trimesh can read"):
        load_surface(tmp_path / "what.xyzzy")
