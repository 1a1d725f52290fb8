"""A coarse tet cage around an object, from posed images or from a closed surface (Sec. 5.1).

Occupancy grid, envelope, fTetWild, tightening, checks, report. World units, float64.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
import trimesh
from jaxtyping import Float

from nimpostor_jax.config import CageConfig
from nimpostor_jax.geometry.topology import Cage
from nimpostor_jax.preprocess import validate
from nimpostor_jax.preprocess.envelope import envelope_from_grid, voxelize_surface
from nimpostor_jax.preprocess.surface import load_surface
from nimpostor_jax.preprocess.tetrahedralize import BOX_TETS, Log, tetrahedralize
from nimpostor_jax.preprocess.tighten import tighten
from nimpostor_jax.preprocess.visual_hull import OccupancyGrid, visual_hull

_ATTEMPTS = 3
_MARGIN_GROWTH = 1.5
_TIGHT_SHARE = 0.25  # of the margin: what tightening leaves between the cage and the voxels
_MAX_REQUIRED = 20_000


_DEFAULT = CageConfig()


class PosedImages(Protocol):
    """What `cage_from_images` reads of `io.blender.PosedImages`."""

    @property
    def images(self) -> Float[np.ndarray, "N H W 4"]:
        """Premultiplied RGBA in [0, 1]."""

    @property
    def camera_to_world(self) -> Float[np.ndarray, "N 4 4"]:
        """Rigid transforms, OpenGL axes."""

    @property
    def focal(self) -> Float[np.ndarray, "N 2"]:
        """In pixels."""

    @property
    def principal(self) -> Float[np.ndarray, "N 2"]:
        """In pixels."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the images, for messages."""


def cage_from_images(views: PosedImages, config: CageConfig = _DEFAULT, log: Log = print) -> Cage:
    """Vertices [V, 3] float64 and tets [T, 4] int32 around the object that the images' alpha shows.

    With `config.shape` "box", those of its bounding box. Logs the calls, the report and the missed
    share. Enlarges the margin, twice at most, while rays miss.

    Raises:
        ValueError: an empty mask, masks that do not bound the object, a target far out of reach, or
            more than `config.max_missed_share` of the foreground rays missing the cage.
    """
    masks = np.asarray(views.images)[..., 3]
    cameras = (views.camera_to_world, views.focal, views.principal)
    grid = visual_hull(masks, *cameras, resolution=config.grid_resolution, names=views.names)
    log(f"visual hull of {len(masks)} images: {_describe(grid)}")

    def coverage(cage: Cage) -> validate.Coverage:
        return validate.missed_foreground(*cage, masks, *cameras)

    return _build(grid, config, coverage, views.names, "cage", log)


def cage_from_grid(grid: OccupancyGrid, config: CageConfig = _DEFAULT, log: Log = print) -> Cage:
    """Vertices [V, 3] float64 and tets [T, 4] int32 around the occupied voxels of a grid.

    Raises ValueError for an empty grid, a target far out of reach, or more than `config.max_missed_share` of
    the voxels' centres outside.
    """
    if not grid.occupied.any():
        raise ValueError(f"the occupancy grid {grid.occupied.shape} is empty: there is nothing to enclose")
    log(_describe(grid))
    centers = grid.centers

    def coverage(cage: Cage) -> validate.Coverage:
        outside = validate.outside_points(centers, *cage)
        return validate.Coverage(np.array([len(centers)]), np.array([int(outside.sum())]), "voxels")

    return _build(grid, config, coverage, None, "cage", log)


def cage_from_surface(
    surface: str | Path | trimesh.Trimesh,
    config: CageConfig = _DEFAULT,
    log: Log = print,
    allow_self_intersections: bool = False,
) -> Cage:
    """Vertices [V, 3] float64 and tets [T, 4] int32 around a closed surface mesh (file or trimesh).

    With `allow_self_intersections` the cage encloses whatever the surface cuts off from the
    outside.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: an empty, non-finite, open or self-intersecting surface, or as in
            `cage_from_images` (the surface's own points take the place of the rays).
    """
    source = "surface" if isinstance(surface, trimesh.Trimesh) else str(surface)
    mesh = surface if isinstance(surface, trimesh.Trimesh) else load_surface(surface)
    grid = voxelize_surface(mesh, config.grid_resolution, source, allow_self_intersections)
    log(f"{source}: {len(mesh.faces)} triangles, {_describe(grid)}")
    points = np.concatenate([mesh.vertices[np.unique(mesh.faces)], mesh.triangles_center])

    def coverage(cage: Cage) -> validate.Coverage:
        outside = validate.outside_points(points, *cage)
        return validate.Coverage(
            np.array([len(points)]), np.array([int(outside.sum())]), "surface points"
        )

    return _build(grid, config, coverage, None, f"cage of {source}", log)


def _build(
    grid: OccupancyGrid,
    config: CageConfig,
    coverage: Callable[[Cage], validate.Coverage],
    names: tuple[str, ...] | None,
    source: str,
    log: Log,
) -> Cage:
    """Envelope, tets, tightening, checks; again with a larger margin if something is cut off."""
    diagonal = float(np.linalg.norm(np.diff(grid.bounds, axis=0)))
    margin = config.margin
    for attempt in range(_ATTEMPTS):
        vertices, tets = tetrahedralize(
            lambda offset, step: envelope_from_grid(grid, offset, step),
            BOX_TETS if config.shape == "box" else config.target_tets,
            diagonal,
            margin,
            log,
        )
        if config.shape != "box":  # whose corners nothing holds in place
            vertices = tighten(vertices, tets, _required_points(grid, _TIGHT_SHARE * margin * diagonal))
        validate.check_tets(vertices, tets, source)
        report = validate.quality_report(vertices, tets)
        missed = coverage((vertices, tets))
        log(f"{report}; {missed}")
        if report.num_overlapping_tets == 0 and missed.missed_share <= config.max_missed_share:
            return vertices, tets
        if attempt + 1 < _ATTEMPTS:
            margin *= _MARGIN_GROWTH
            log(f"again with margin {margin:.4f}")
    validate.check_coverage(missed, config.max_missed_share, names, source)
    raise ValueError(
        f"{source}: {report.num_overlapping_tets} tets overlap others after {_ATTEMPTS} attempts; "
        "ask for more tets (CageConfig.target_tets)"
    )


def _required_points(grid: OccupancyGrid, clearance: float) -> Float[np.ndarray, "points 3"]:
    """Points a little outside the object that the cage keeps inside while it is tightened."""
    points = envelope_from_grid(grid, clearance).vertices
    # Marching cubes lists them in scan order, so that every k-th are spread over the surface.
    return np.asarray(points[:: math.ceil(len(points) / _MAX_REQUIRED)])


def _describe(grid: OccupancyGrid) -> str:
    (lower, upper), shape = np.round(grid.bounds, 3).tolist(), grid.occupied.shape
    return f"{int(grid.occupied.sum())} of {shape} voxels occupied, in {lower} to {upper}"
