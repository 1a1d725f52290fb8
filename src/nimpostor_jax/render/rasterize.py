"""Rasterization of tets: which of them each pixel sees, front to back, without walking through the mesh.

Tets are sorted into the image tiles that their bounding rectangles meet. In a tile, six edge tests a tet and
pixel say whether and through which faces the pixel looks through the tet: the edges are the same bits in all
tets around them, so that neither pixels nor tets are lost between two. Depth peeling then takes the nearest
tet of each pixel, layer by layer; the order in which tets are stored does not matter.

The result are `Crossings`, as of `traverse`: overlapping and disconnected tets make no difference.

Axes: V vertices, T tets, P pairs of tile and tet, C tets of a tile, K layers, R = tiles * TILE^2 pixels.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.chunks import running
from nimpostor_jax.geometry.intersect import face_weights, project, ray_frame
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.render.camera import TILE, pixel_rays, to_local
from nimpostor_jax.render.segments import ENTRY_TRIANGLES
from nimpostor_jax.render.traverse import CODES_PER_TET, EXIT_TRIANGLES, Crossings
from nimpostor_jax.types import Camera, Rays, TetMesh

EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


def _exit_codes() -> np.ndarray:
    """The code of a tet (see `traverse`) that is entered by one face and left by another, [4, 4]."""
    codes = np.zeros((4, 4), np.int32)
    for entered in range(4):
        for slot, left in enumerate(FACES[entered]):
            codes[entered, left] = 9 * entered + slot
    return codes


EXIT_CODES = _exit_codes()


@struct.dataclass
class Screen:
    """The mesh as a camera sees it."""

    positions: Float[Array, "V 2"]  # in pixels, y up
    nearness: Float[Array, " V"]  # 1 / depth along the camera's axis; affine on the screen


@struct.dataclass
class TileLists:
    """The tets in each image tile, tile after tile."""

    tets: Int[Array, " P"]
    starts: Int[Array, " tiles+1"]
    num_pairs: Int[Array, ""]  # that there are; more than P: some are missing


def to_screen(mesh: TetMesh, camera: Camera) -> tuple[Screen, Float[Array, " V"]]:
    """Projected vertices, and their depths in the mesh's own frame (not positive: behind the camera)."""
    origin = (camera.camera_to_world[:3, 3] - mesh.center) / mesh.scale
    offset = mesh.vertices - origin
    axes = camera.camera_to_world[:3, :3]
    x, y, z = (jnp.sum(offset * axes[:, i], axis=1) for i in range(3))
    nearness = 1 / jnp.where(z < 0, -z, 1)
    positions = jnp.stack([x, y], axis=1) * nearness[:, None] * camera.focal
    return Screen(positions=positions, nearness=nearness), -z


def tiles_of(camera: Camera) -> tuple[int, int]:
    """Tiles in a column and in a row of the image."""
    return -(-camera.height // TILE), -(-camera.width // TILE)


def bin_tets(mesh: TetMesh, screen: Screen, camera: Camera, capacity: int) -> TileLists:
    """Sort the tets into the tiles that their bounding rectangles meet, `capacity` pairs at most."""
    rows, columns = tiles_of(camera)
    corners = screen.positions[mesh.tets]
    x, y = camera.principal[0] + corners[..., 0], camera.principal[1] - corners[..., 1]
    left, right, top, bottom = (
        jnp.floor(f(v, axis=1) / TILE) for v in (x, y) for f in (jnp.min, jnp.max)
    )
    x0, x1 = (jnp.clip(x, low, high) for x, low, high in ((left, 0, columns), (right, -1, columns - 1)))
    y0, y1 = (jnp.clip(y, low, high) for y, low, high in ((top, 0, rows), (bottom, -1, rows - 1)))
    wide, high = (jnp.maximum(b - a + 1, 0).astype(jnp.int32) for a, b in ((x0, x1), (y0, y1)))
    counts = wide * high
    firsts = jnp.cumsum(counts) - counts
    # Tets with pairs mark their first; a running maximum spreads the marks, which ascend.
    marked = jnp.where(counts > 0, firsts, capacity)
    numbers = jnp.arange(counts.shape[0], dtype=jnp.int32)
    owners = running(jnp.maximum, jnp.zeros(capacity, jnp.int32).at[marked].set(numbers, mode="drop"), 0)
    order = jnp.arange(capacity, dtype=jnp.int32)
    place, width = order - firsts[owners], jnp.maximum(wide[owners], 1)
    tile = (y0[owners].astype(jnp.int32) + place // width) * columns
    tile += x0[owners].astype(jnp.int32) + place % width
    num_pairs = jnp.sum(counts)
    tile = jnp.where(order < num_pairs, tile, rows * columns)
    tile, tets = jax.lax.sort((tile, owners), num_keys=1)
    starts = jnp.searchsorted(tile, jnp.arange(rows * columns + 1))
    return TileLists(tets=tets, starts=starts.astype(jnp.int32), num_pairs=num_pairs)


def tile_rays(camera: Camera, tiles: Int[Array, " n"]) -> Rays:
    """World rays through the pixels of tiles, [n * TILE^2]; beyond the image's edges too."""
    pixels = _tile_pixels(camera, tiles) + 0.5
    return pixel_rays(camera, pixels.reshape(-1, 2))


def _tile_pixels(camera: Camera, tiles: Int[Array, " n"]) -> Float[Array, "n pixels 2"]:
    _, columns = tiles_of(camera)
    inside = jnp.stack(jnp.meshgrid(jnp.arange(TILE), jnp.arange(TILE), indexing="xy"), axis=-1)
    corner = TILE * jnp.stack([tiles % columns, tiles // columns], axis=-1)
    return (corner[:, None] + inside.reshape(1, -1, 2)).astype(camera.focal.dtype)


def rasterize(
    mesh: TetMesh,
    camera: Camera,
    screen: Screen,
    lists: TileLists,
    tiles: Int[Array, " n"],
    *,
    tets_per_tile: int,
    layers: int,
) -> Crossings:
    """The tets that the pixels of tiles look through, front to back; -1 as a tile fills up.

    `overflow` where a tile has more than `tets_per_tile` tets or a pixel more than `layers`. All vertices
    must lie in front of the camera.
    """
    rays = to_local(mesh, tile_rays(camera, jnp.maximum(tiles, 0)))
    pixels = _tile_pixels(camera, jnp.maximum(tiles, 0)) + 0.5
    pixels = jnp.stack([pixels[..., 0] - camera.principal[0], camera.principal[1] - pixels[..., 1]], axis=-1)

    def peel(tile: tuple[Array, Array]) -> tuple[Array, Array]:
        index, points = tile
        start, end = lists.starts[jnp.maximum(index, 0)], lists.starts[jnp.maximum(index, 0) + 1]
        places = start + jnp.arange(tets_per_tile, dtype=jnp.int32)
        used = (places < end) & (index >= 0)
        tets = lists.tets[jnp.minimum(places, lists.tets.size - 1)]
        nearness, codes = _through(mesh, screen, tets, points)
        nearness = jnp.where(used[:, None], nearness, 0)
        found, more = _peel(nearness, layers)
        picked = jnp.take_along_axis(codes + CODES_PER_TET * tets[:, None], jnp.maximum(found, 0), axis=0)
        return jnp.where(found >= 0, picked, -1), more | (end - start > tets_per_tile)

    codes, overflow = jax.lax.map(peel, (tiles, pixels))
    codes = jnp.moveaxis(codes, 0, 1).reshape(layers, -1)
    return Crossings(codes=codes, ends=_ends(mesh, rays, codes), overflow=overflow.reshape(-1))


def _through(
    mesh: TetMesh, screen: Screen, tets: Int[Array, " C"], points: Float[Array, "pixels 2"]
) -> tuple[Float[Array, "C pixels"], Int[Array, "C pixels"]]:
    """Nearness of the point where each pixel enters each tet (0: it does not), and the code of its faces."""
    corners = mesh.tets[tets]
    x, y = (screen.positions[corners, i][:, :, None] - points[:, i] for i in range(2))  # [C, 4, pixels]
    near = screen.nearness[corners]
    sides, areas = {}, {}
    for i, j in EDGES:
        forward, backward = x[:, i] * y[:, j], y[:, i] * x[:, j]
        tie = (y[:, i] > y[:, j]) | ((y[:, i] == y[:, j]) & (x[:, j] > x[:, i]))
        sides[i, j] = (forward > backward) | ((forward == backward) & tie)
        sides[j, i] = ~sides[i, j]
        areas[i, j] = forward - backward
        areas[j, i] = -areas[i, j]
    best, last = jnp.zeros_like(x[:, 0]), jnp.full(x[:, 0].shape, jnp.inf, x.dtype)
    first_face, last_face = (jnp.zeros(best.shape, jnp.int32) for _ in range(2))
    hit = jnp.zeros(best.shape, jnp.int32)
    for face, (a, b, c) in enumerate(FACES):
        around = [(b, c), (c, a), (a, b)]
        left = [sides[edge] for edge in around]
        passed = (left[0] == left[1]) & (left[1] == left[2])
        total = sum(areas[edge] for edge in around)
        weighted = (areas[e] * near[:, corner, None] for e, corner in zip(around, (a, b, c), strict=True))
        depth = sum(weighted) / jnp.where(total == 0, 1, total)
        depth = jnp.clip(depth, jnp.min(near, axis=1)[:, None], jnp.max(near, axis=1)[:, None])
        nearer, further = passed & (depth > best), passed & (depth <= last)
        best, first_face = jnp.where(nearer, depth, best), jnp.where(nearer, face, first_face)
        last, last_face = jnp.where(further, depth, last), jnp.where(further, face, last_face)
        hit += passed
    through = (hit == 2) & (first_face != last_face)
    codes = jnp.asarray(EXIT_CODES)[first_face, last_face]
    return jnp.where(through, best, 0), codes


def _peel(
    nearness: Float[Array, "C pixels"], layers: int
) -> tuple[Int[Array, "K pixels"], Bool[Array, " pixels"]]:
    """Indices by descending nearness, and whether more than K are above 0."""
    count, num_pixels = nearness.shape
    order = jnp.arange(count, dtype=jnp.int32)[:, None]

    def open_layers(carry: tuple) -> Bool[Array, ""]:
        layer, left, _ = carry
        return (layer < layers) & jnp.any(left > 0)

    def take_nearest(carry: tuple) -> tuple:
        layer, left, found = carry
        nearest = jnp.max(left, axis=0)
        index = jnp.min(jnp.where(left == nearest, order, count), axis=0)
        found = found.at[layer].set(jnp.where(nearest > 0, index, -1))
        return layer + 1, jnp.where(order == index, 0, left), found

    none = jnp.full((layers, num_pixels), -1, jnp.int32)
    _, left, found = jax.lax.while_loop(open_layers, take_nearest, (jnp.int32(0), nearness, none))
    return found, jnp.any(left > 0, axis=0)


def _ends(mesh: TetMesh, rays: Rays, codes: Int[Array, "K R"]) -> tuple[Float[Array, "K R"], ...]:
    """t and two weights at both ends of the crossings, as `traverse` records them."""
    vertices, rays = jax.lax.stop_gradient((mesh.vertices, rays))
    origin, direction = (tuple(x[:, i] for i in range(3)) for x in (rays.origins, rays.directions))
    axes = ray_frame(direction)
    tets, local = jnp.maximum(codes, 0) // CODES_PER_TET, jnp.maximum(codes, 0) % CODES_PER_TET
    ends = []
    for triangles in (ENTRY_TRIANGLES, EXIT_TRIANGLES):
        triangle = jnp.asarray(triangles)[local]
        corners = [vertices[mesh.tets[tets, triangle[..., j]]] for j in range(3)]
        a, b, c = (project(tuple(corner[..., i] for i in range(3)), origin, axes) for corner in corners)
        wa, wb, wc = face_weights(a, b, c)
        ends += [wa * a[2] + wb * b[2] + wc * c[2], wa, wb]
    return tuple(ends)
