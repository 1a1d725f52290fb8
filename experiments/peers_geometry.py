"""Point location, traversal and frames beside SciPy, VTK, Open3D and Embree (see `peers_match.py`)."""

import ctypes
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P
from peers_match import (
    CORES,
    SPLIT,
    Absent,
    Match,
    Row,
    Work,
    cage_of,
    frame_rays,
    front_camera,
    random_rays,
    spread,
)

from nimpostor_jax.config import ImpostorConfig, RenderConfig, SamplerConfig
from nimpostor_jax.field.impostor import init_impostor
from nimpostor_jax.geometry.locate import find_tets, locate_tables
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.geometry.topology import build_tet_mesh, world_vertices
from nimpostor_jax.preprocess.embree import EmbreeQuery, EmbreeSegments
from nimpostor_jax.preprocess.validate import orient_tets
from nimpostor_jax.render.camera import TILE, to_local
from nimpostor_jax.render.capacity import fit_capacities
from nimpostor_jax.render.frame import Frame, for_frames, frame_config, render_frame
from nimpostor_jax.render.traverse import Crossings, march_tables, traverse
from nimpostor_jax.types import Camera, NeuralImpostor, Rays, TetMesh

STEPS = RenderConfig(sampler=SamplerConfig(step=0.125))  # of a field that is not trained for any pixels
CROSSINGS = Crossings(codes=P(None, *SPLIT), ends=(P(None, *SPLIT),) * 6, overflow=SPLIT)
LOST = 1e-4  # of the ball's radius: a ray that is shorter or longer by more has lost or doubled a segment
ROUNDING = 1e-6  # how far float32 moves a ray that starts a few radii away

# ---- point location ----------------------------------------------------------------------------------------


def locate_vs_scipy(work: Work) -> Match:
    """`Delaunay.find_simplex` on its own mesh: it walks from each point to the next, on one thread."""
    from scipy.spatial import Delaunay

    rng = np.random.default_rng(0)
    cloud = Delaunay(rng.uniform(-1, 1, (250, 3)))
    volumes = np.linalg.det(cloud.points[cloud.simplices[:, 1:]] - cloud.points[cloud.simplices[:, :1]])
    if np.any(volumes == 0):
        raise Absent("a flat tet in the Delaunay mesh")
    mesh = build_tet_mesh(cloud.points, orient_tets(cloud.simplices, cloud.points))
    points = rng.uniform(-1, 1, (work.points, 3)).astype(np.float32)
    queries = points.astype(np.float64)
    return Match(
        ours=_locating(mesh, points),
        peer=lambda: cloud.find_simplex(queries),
        describe=lambda ours, peer: _same_tets(mesh, ours, peer),
        peer_threads=1,
    )


def locate_vs_vtk(work: Work) -> Match:
    """VTK's cell locator, through PyVista's `find_containing_cell`: a loop over points, on one thread."""
    import pyvista
    import vtk

    vertices, tets, mesh = cage_of(work)
    grid = pyvista.UnstructuredGrid({vtk.VTK_TETRA: tets}, vertices)
    points = np.random.default_rng(0).uniform(-1, 1, (work.slow_points, 3)).astype(np.float32)
    queries = points.astype(np.float64)
    return Match(
        ours=_locating(mesh, points),
        peer=lambda: grid.find_containing_cell(queries),
        describe=lambda ours, peer: _same_tets(mesh, ours, peer),
        peer_threads=1,
    )


def _locating(mesh: TetMesh, points: np.ndarray) -> Callable[[], jax.Array]:
    tables = jax.jit(locate_tables)(mesh)
    return spread(find_tets, tables, (points - np.asarray(mesh.center)) / np.asarray(mesh.scale))


def _same_tets(mesh: TetMesh, ours: jax.Array, peer: np.ndarray) -> Row:
    return {"tets": len(mesh.tets), "points": len(peer), "agree": float(np.mean(np.asarray(ours) == peer))}


# ---- traversal ---------------------------------------------------------------------------------------------


def traverse_vs_open3d(work: Work) -> Match:
    """All hits of `RaycastingScene.list_intersections` on the cage's faces, sorted along rays; a frame."""
    side = max(TILE, int(np.sqrt(work.rays)))
    return _against_open3d(work, frame_rays(side))


def traverse_random_vs_open3d(work: Work) -> Match:
    """The same with rays of which no two are neighbours, as in a training batch."""
    return _against_open3d(work, random_rays(work.rays))


def traverse_vs_embree(work: Work) -> Match:
    """First hits by embreex, each ray started again behind its last hit (`preprocess/embree.py`)."""
    vertices, tets, mesh = cage_of(work)
    rays = random_rays(work.slow_rays)
    query = EmbreeQuery(vertices, tets)
    origins, directions = (np.asarray(x, np.float64) for x in (rays.origins, rays.directions))

    def describe(ours: Crossings, peer: EmbreeSegments) -> Row:
        segments = np.sum(np.asarray(ours.codes) >= 0, axis=0)
        same = segments == np.bincount(peer.rays, minlength=len(segments))
        return _march_facts(work, mesh, rays, ours) | {"agree": float(same.mean())}

    return Match(
        ours=_marching(mesh, rays),
        peer=lambda: query.segments(origins, directions),
        describe=describe,
        peer_threads=1,
    )


def traverse_ball_frame(work: Work) -> Match:
    """A whole frame's rays; a target without a peer."""
    mesh = cage_of(work)[2]
    rays = frame_rays(work.frame_size)
    return Match(_marching(mesh, rays), None, lambda ours, _: _march_facts(work, mesh, rays, ours))


def traverse_ball_frame_one_thread(work: Work) -> Match:
    """The same on one device."""
    mesh = cage_of(work)[2]
    rays = frame_rays(work.frame_size)
    march = _marching(mesh, rays, threads=1)
    return Match(march, None, lambda ours, _: _march_facts(work, mesh, rays, ours), ours_threads=1)


def traverse_batch(count: int, threads: int, work: Work) -> Match:
    """`count` rays a call: tiles of a large frame, evenly from those with few tets to those with many.

    Drawn at random, the few tiles of a small batch would have other segments than those of a large one.
    """
    mesh = cage_of(work)[2]
    rays = frame_rays(1 << ((max(work.batches) - 1).bit_length() + 1) // 2)
    tiles = jax.tree.map(lambda x: np.asarray(x).reshape(-1, TILE**2, 3), rays)
    crossed = np.asarray(_marching(mesh, rays)().codes >= 0).sum(axis=0).reshape(-1, TILE**2).sum(axis=1)
    places = (np.arange(count // TILE**2) + 0.5) * len(crossed) / (count // TILE**2)
    chosen = np.argsort(crossed, kind="stable")[places.astype(int)]
    chosen = np.concatenate([chosen[i::CORES] for i in range(CORES)])  # alike for each of the devices
    rays = jax.tree.map(lambda x: x[chosen].reshape(-1, 3), tiles)
    march = _marching(mesh, rays, threads)
    return Match(march, None, lambda ours, _: _march_facts(work, mesh, rays, ours), ours_threads=threads)


def _against_open3d(work: Work, rays: Rays) -> Match:
    _load_libusb()
    import open3d

    vertices, tets, mesh = cage_of(work)
    faces = np.unique(np.sort(tets[:, np.array(FACES)].reshape(-1, 3), axis=1), axis=0)
    scene = open3d.t.geometry.RaycastingScene(nthreads=CORES)
    tensor = open3d.core.Tensor
    scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))
    lines = tensor(np.concatenate([rays.origins, rays.directions], axis=1))
    exits = np.asarray(march_tables(mesh).next_holds) < 0

    def peer() -> np.ndarray:
        hits = scene.list_intersections(lines)
        ray = hits["ray_ids"].numpy()
        return ray[np.lexsort((hits["t_hit"].numpy(), ray))]

    def describe(ours: Crossings, peer: np.ndarray) -> Row:
        codes = np.asarray(ours.codes)
        faces_met = np.sum((codes >= 0) + ((codes >= 0) & exits[codes]).astype(int), axis=0)
        same = faces_met == np.bincount(peer.astype(np.int64), minlength=codes.shape[1])
        return _march_facts(work, mesh, rays, ours) | {"agree": float(same.mean())}

    return Match(_marching(mesh, rays), peer, describe)


def _load_libusb() -> None:
    """Open3D's extension links to libusb, which bare machines lack: offer it the one that is a package."""
    try:
        import libusb_package
    except ImportError:
        return  # the system may have it
    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)


def _marching(mesh: TetMesh, rays: Rays, threads: int = CORES) -> Callable[[], Crossings]:
    tables = march_tables(mesh)
    count = len(rays.origins)
    probe = jax.tree.map(lambda x: x[:: max(1, count // 8192)], rays)
    config = fit_capacities(mesh, tables, probe, STEPS).march
    local = jax.jit(to_local)(mesh, rays)
    return spread(lambda shared, items: traverse(shared, items, config), tables, local, CROSSINGS, threads)


def _march_facts(work: Work, mesh: TetMesh, rays: Rays, found: Crossings) -> Row:
    """Counts, and how many of some rays are not as long inside the cage as float64 says."""
    step = max(1, len(rays.origins) // work.checked_rays)
    checked = np.arange(0, len(rays.origins), step)
    first, last = (np.asarray(found.ends[i][:, checked], np.float64) for i in (0, 3))
    used = np.asarray(found.codes[:, checked]) >= 0
    lengths = np.where(used, np.maximum(last - first, 0), 0).sum(axis=0)
    origins, directions = (np.asarray(x)[checked].astype(np.float64) for x in (rays.origins, rays.directions))
    lengths = float(mesh.scale) * lengths
    cage = world_vertices(mesh), np.asarray(mesh.tets)
    expected = chords(*cage, origins, directions)
    suspects = np.flatnonzero(np.abs(lengths - expected) > LOST)
    # A ray along a face near by: its length must lie between those of rays that rounding may have made of it.
    moves = ROUNDING * np.vstack([np.eye(3), -np.eye(3)])
    moved = [chords(*cage, origins[suspects] + move, directions[suspects]) for move in moves]
    low, high = np.min(moved, axis=0) - LOST, np.max(moved, axis=0) + LOST
    lost = (lengths[suspects] < low) | (lengths[suspects] > high)
    return {
        "tets": len(mesh.tets),
        "rays": len(rays.origins),
        "segments": int(jnp.sum(found.codes >= 0)),
        "overflow": int(jnp.sum(found.overflow)),
        "lost": int(np.sum(lost)),
        "checked_rays": len(checked),
    }


def chords(vertices: np.ndarray, tets: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Length of each line inside the tets, [R], in float64, from all tets' planes."""
    corners = vertices[tets]
    a, b, c = (corners[:, np.array(FACES)[:, i]] for i in range(3))  # outward counter-clockwise
    normals = np.cross(c - a, b - a)
    offsets = -np.sum(normals * a, axis=-1)
    lengths = []
    for group in np.array_split(np.arange(len(origins)), max(1, len(origins) // 64)):
        slope = np.einsum("tfx,rx->rtf", normals, directions[group])
        height = np.einsum("tfx,rx->rtf", normals, origins[group]) + offsets
        t = -height / np.where(slope == 0, 1, slope)
        outside = np.any((slope == 0) & (height < 0), axis=-1)
        low = np.max(np.where(slope > 0, t, -np.inf), axis=-1)
        high = np.min(np.where(slope < 0, t, np.inf), axis=-1)
        lengths.append(np.sum(np.where(outside, 0, np.maximum(high - low, 0)), axis=1))
    return np.concatenate(lengths)


# ---- frames ------------------------------------------------------------------------------------------------


def frame_vs_vtk(work: Work) -> Match:
    """An untrained impostor on the ball, against VTK's ray caster on one scalar at the same vertices."""
    mesh = cage_of(work)[2]
    impostor = init_impostor(jax.random.key(0), mesh, ImpostorConfig())
    return _against_vtk(impostor, front_camera(work.frame_size), STEPS)


def frame_trained_vs_vtk(work: Work) -> Match:
    """The same with a trained impostor and its cage."""
    if work.trained is None:
        raise Absent("no trained impostor: give --workdir and --data")
    return _against_vtk(*work.trained)


def _against_vtk(impostor: NeuralImpostor, camera: Camera, config: RenderConfig) -> Match:
    import pyvista
    import vtk

    mesh = impostor.mesh
    vertices, tets = world_vertices(mesh), np.asarray(mesh.tets)
    grid = pyvista.UnstructuredGrid({vtk.VTK_TETRA: tets}, vertices)
    grid.point_data["scalar"] = np.linalg.norm(np.asarray(mesh.vertices), axis=1)  # 0 to 1
    grid.set_active_scalars("scalar")
    window = _vtk_window(vtk, grid, camera)
    impostor = for_frames(impostor)
    sized = frame_config(impostor, camera, config)

    def peer() -> None:
        window.GetRenderers().GetFirstRenderer().GetActiveCamera().Modified()  # render again
        window.Render()

    def describe(ours: Frame, _: None) -> Row:
        grabber = vtk.vtkWindowToImageFilter()
        grabber.SetInput(window)
        grabber.Update()
        image = pyvista.wrap(grabber.GetOutput()).point_data.active_scalars
        seen = np.any(image.reshape(camera.height, camera.width, -1)[::-1] < 255, axis=-1)
        covered = ours.opacity > 0
        return {
            "tets": len(tets),
            "covered": float(covered.mean()),
            "agree": float(np.mean(seen == covered)),
        }

    return Match(lambda: render_frame(impostor, camera, sized), peer, describe)


def _vtk_window(vtk: Any, grid: Any, camera: Camera) -> Any:
    """A window off screen that casts a ray for each pixel through the grid's scalar, on white."""
    mapper = vtk.vtkUnstructuredGridVolumeRayCastMapper()
    mapper.SetInputData(grid)
    mapper.SetNumberOfThreads(CORES)
    mapper.AutoAdjustSampleDistancesOff()
    mapper.SetImageSampleDistance(1.0)
    opacity, color = vtk.vtkPiecewiseFunction(), vtk.vtkColorTransferFunction()
    opacity.AddPoint(0, 1.0)
    opacity.AddPoint(1, 0.2)
    color.AddRGBPoint(0, 0.8, 0.2, 0.1)
    color.AddRGBPoint(1, 0.1, 0.2, 0.8)
    volume = vtk.vtkVolume()
    volume.SetMapper(mapper)
    volume.GetProperty().SetScalarOpacity(opacity)
    volume.GetProperty().SetColor(color)
    volume.GetProperty().SetInterpolationTypeToLinear()
    renderer = vtk.vtkRenderer()
    renderer.AddVolume(volume)
    renderer.SetBackground(1, 1, 1)
    window = vtk.vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetSize(camera.width, camera.height)
    window.AddRenderer(renderer)
    pose = np.asarray(camera.camera_to_world, np.float64)
    view = renderer.GetActiveCamera()
    view.SetPosition(*pose[:3, 3])
    view.SetFocalPoint(*(pose[:3, 3] - pose[:3, 2]))
    view.SetViewUp(*pose[:3, 1])
    view.SetViewAngle(float(np.degrees(2 * np.arctan(camera.height / 2 / camera.focal[1]))))
    renderer.ResetCameraClippingRange()
    return window
