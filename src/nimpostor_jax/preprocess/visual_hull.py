"""Visual hull: an occupancy grid around the object, carved by the alpha masks of posed images.

Axes: N images, H rows, W columns, X x Y x Z voxels. Units: world units; image coordinates in
pixels, with pixel centres at half integers. Cameras have OpenGL axes (they look down -z, y up).

Carving is conservative, so that no foreground ray is lost: a voxel goes only if in some image its
whole footprint lies inside the frame and touches no foreground pixel. Every component is kept.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

# Half of the smallest step of an 8-bit alpha: any coverage at all counts as foreground.
FOREGROUND_ALPHA = 0.5 / 255

# Voxels a side while the bounding box is sought: many in the first box, which is mostly empty.
_SEARCH_RESOLUTIONS = (128, 48, 48)
# Of the images that must have a point in their frame: it cannot be told from empty space else.
_SEEN_SHARE = 0.5
_MAX_FIELD_SIDE = 512  # larger masks are pooled: their pixels are much finer than a voxel
_BLOCK = 8  # voxels a side of the blocks that are tested first
_CHUNK = 1 << 18  # cubes projected at once


@dataclasses.dataclass(frozen=True)
class OccupancyGrid:
    """Voxels of a hull; (i, j, k) is the cube around `origin + voxel_size * (i, j, k)`."""

    occupied: Bool[np.ndarray, "X Y Z"]
    origin: Float[np.ndarray, " 3"]  # centre of voxel (0, 0, 0)
    voxel_size: float

    @property
    def centers(self) -> Float[np.ndarray, "points 3"]:
        """Centres of the occupied voxels."""
        return self.origin + self.voxel_size * np.argwhere(self.occupied)

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Lower and upper corner of the box around the occupied cubes."""
        centers = self.centers
        half = 0.5 * self.voxel_size
        return np.stack([centers.min(axis=0) - half, centers.max(axis=0) + half])


@dataclasses.dataclass(frozen=True)
class _View:
    """One image, ready for look-ups."""

    # Pixels to the nearest foreground pixel, minus those to the nearest background pixel.
    distance: Float[np.ndarray, "H W"]
    world_to_camera: Float[np.ndarray, "3 4"]
    focal: Float[np.ndarray, " 2"]
    principal: Float[np.ndarray, " 2"]


def visual_hull(
    masks: Float[np.ndarray, "N H W"],
    camera_to_world: Float[np.ndarray, "N 4 4"],
    focal: Float[np.ndarray, "N 2"],
    principal: Float[np.ndarray, "N 2"],
    resolution: int = 128,
    names: Sequence[str] | None = None,
) -> OccupancyGrid:
    """Carve the visual hull of alpha masks in a box that is found from the masks and cameras.

    Args:
        masks: alpha in [0, 1]; everything above `FOREGROUND_ALPHA` is foreground.
        camera_to_world: rigid transforms, OpenGL axes.
        focal, principal: in pixels.
        resolution: voxels along the longest side of the box of the result.
        names: of the images, for messages.

    Raises:
        ValueError: wrong shapes or non-finite values, fewer than 2 images, an image without
            foreground, masks that do not bound the object, or masks and cameras that have no point
            in common.
    """
    check_views(masks, camera_to_world, focal, principal, names)
    views = [_view(*parts) for parts in zip(masks, camera_to_world, focal, principal, strict=True)]
    views = [views[i] for i in _spread_order(np.asarray(camera_to_world)[:, :3, 2])]
    lower, upper = _find_box(views, masks, camera_to_world, focal, principal)
    grid = _carve(views, lower, upper, resolution)
    if not grid.occupied.any():
        raise ValueError(_NO_HULL.format(len(views)))
    return grid


_NO_HULL = (
    "no point is foreground in all of the {} images: masks and cameras disagree; "
    "check the camera convention (camera-to-world, looking down -z, y up) and the focal length"
)


def check_views(
    masks: Float[np.ndarray, "N H W"],
    camera_to_world: Float[np.ndarray, "N 4 4"],
    focal: Float[np.ndarray, "N 2"],
    principal: Float[np.ndarray, "N 2"],
    names: Sequence[str] | None = None,
) -> None:
    """Raise ValueError, naming the image, at an empty mask or a camera that is not finite."""
    count = len(masks)
    if masks.ndim != 3 or count < 2:
        raise ValueError(f"a visual hull needs at least 2 masks [N, H, W], got shape {masks.shape}")
    shapes = {"camera_to_world": (count, 4, 4), "focal": (count, 2), "principal": (count, 2)}
    arrays = {"camera_to_world": camera_to_world, "focal": focal, "principal": principal}
    for key, shape in shapes.items():
        array = np.asarray(arrays[key])
        if array.shape != shape:
            raise ValueError(f"{key} must have shape {shape} for {count} masks, got {array.shape}")
        bad = np.flatnonzero(~np.isfinite(array).reshape(count, -1).all(axis=1))
        if bad.size:
            raise ValueError(f"{key} of image {view_label(bad[0], names)} is not finite")
    for i, mask in enumerate(masks):
        if not np.isfinite(mask).all():
            raise ValueError(f"the mask of image {view_label(i, names)} is not finite")
        if not (mask > FOREGROUND_ALPHA).any():
            raise ValueError(
                f"the mask of image {view_label(i, names)} is empty: no pixel has alpha above "
                f"{FOREGROUND_ALPHA:.4f}; drop the image or give one with an alpha channel"
            )
    opaque = [i for i, mask in enumerate(masks) if (mask > FOREGROUND_ALPHA).all()]
    if 2 * len(opaque) > count:
        raise ValueError(
            f"{len(opaque)} of {count} masks have no background (first: image "
            f"{view_label(opaque[0], names)}): they do not bound the object; give images with an "
            "alpha channel that is 0 off the object"
        )


def view_label(index: int, names: Sequence[str] | None) -> str:
    """An image's index, with its name where there is one."""
    return str(index) if names is None else f"{index} ({names[index]})"


def _view(
    mask: Float[np.ndarray, "H W"],
    camera_to_world: Float[np.ndarray, "4 4"],
    focal: Float[np.ndarray, " 2"],
    principal: Float[np.ndarray, " 2"],
) -> _View:
    """Distance field and projection of one image, max-pooled to at most `_MAX_FIELD_SIDE`."""
    foreground: np.ndarray = np.asarray(mask) > FOREGROUND_ALPHA
    factor = math.ceil(max(foreground.shape) / _MAX_FIELD_SIDE)
    if factor > 1:
        rows, columns = (-side % factor for side in foreground.shape)
        # Edge padding repeats the last pixels, so that the maximum in the last block stays what it
        # is.
        padded = np.pad(foreground, ((0, rows), (0, columns)), mode="edge")
        height, width = (side // factor for side in padded.shape)
        foreground = padded.reshape(height, factor, width, factor).max(axis=(1, 3))
    outside = ndimage.distance_transform_edt(~foreground)
    # Without a background pixel the transform is undefined; the frame then bounds the foreground.
    inside = np.float64(np.inf) if foreground.all() else ndimage.distance_transform_edt(foreground)
    return _View(
        distance=(outside - inside).astype(np.float32),
        world_to_camera=np.linalg.inv(np.asarray(camera_to_world, np.float64))[:3],
        focal=np.asarray(focal, np.float64) / factor,
        principal=np.asarray(principal, np.float64) / factor,
    )


def _spread_order(directions: Float[np.ndarray, "N 3"]) -> list[int]:
    """An order in which each image looks from far off the earlier ones: most voxels go early."""
    order = [0]
    nearest = directions @ directions[0]
    for _ in range(len(directions) - 1):
        order.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, directions @ directions[order[-1]])
        nearest[order] = np.inf
    return order


def _find_box(
    views: list[_View],
    masks: Float[np.ndarray, "N H W"],
    camera_to_world: Float[np.ndarray, "N 4 4"],
    focal: Float[np.ndarray, "N 2"],
    principal: Float[np.ndarray, "N 2"],
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Box of the hull: from the reach of the cameras, carved coarsely and shrunk until it stays."""
    center, reach = _focus(masks, camera_to_world, focal, principal)
    lower, upper = center - reach, center + reach
    for resolution in _SEARCH_RESOLUTIONS:
        grid = _carve(views, lower, upper, resolution)
        if not grid.occupied.any():
            raise ValueError(_NO_HULL.format(len(views)))
        box = grid.bounds
        shrunk = np.prod(box[1] - box[0]) < 0.7 * np.prod(upper - lower)
        lower, upper = np.maximum(box[0], lower), np.minimum(box[1], upper)
        if not shrunk:
            break
    if (lower <= center - reach).any() or (upper >= center + reach).any():
        raise ValueError(
            f"the masks of the {len(views)} images do not bound the object: their hull is open at "
            f"{reach:.3g} world units around {np.round(center, 3).tolist()}; give views from "
            "more directions, or masks (alpha) that are 0 off the object"
        )
    return lower, upper


def _focus(
    masks: Float[np.ndarray, "N H W"],
    camera_to_world: Float[np.ndarray, "N 4 4"],
    focal: Float[np.ndarray, "N 2"],
    principal: Float[np.ndarray, "N 2"],
) -> tuple[Float[np.ndarray, " 3"], float]:
    """Point nearest to the rays through the masks' centroids; distance of the farthest camera."""
    poses = np.asarray(camera_to_world, np.float64)
    centroids = np.stack(
        [np.argwhere(mask > FOREGROUND_ALPHA).mean(axis=0)[::-1] + 0.5 for mask in masks]
    )
    local = (centroids - principal) / focal * [1.0, -1.0]
    directions = np.einsum("nij,nj->ni", poses[:, :3, :3], np.c_[local, -np.ones(len(poses))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    off_ray = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    origins = poses[:, :3, 3]
    right = np.einsum("nij,nj->i", off_ray, origins)
    center, _, rank, _ = np.linalg.lstsq(off_ray.sum(axis=0), right, rcond=1e-6)
    if rank < 3:
        raise ValueError(
            f"all {len(poses)} cameras look in the same direction: their masks do not bound the "
            "object; give views from other directions"
        )
    return center, float(np.linalg.norm(origins - center, axis=1).max())


def _carve(
    views: list[_View],
    lower: Float[np.ndarray, " 3"],
    upper: Float[np.ndarray, " 3"],
    resolution: int,
) -> OccupancyGrid:
    """Carve a grid of cubes over a box; about `resolution` voxels along its longest side.

    Blocks of 8 x 8 x 8 voxels are tested first; those that no image can split are settled as a
    whole, the others are halved. A block carries less rounding to pixels than its voxels, so that a
    little more is carved than by testing each voxel; both keep all of the object.
    """
    voxel_size = float((upper - lower).max()) / resolution
    blocks = np.maximum(np.ceil((upper - lower) / (_BLOCK * voxel_size) - 1e-9).astype(int), 1)
    first = 0.5 * (lower + upper) - 0.5 * voxel_size * (
        _BLOCK * blocks - 1
    )  # centre of voxel (0, 0, 0)
    needed = max(1, math.ceil(_SEEN_SHARE * len(views)))

    occupied = np.zeros(blocks, bool)
    index = np.argwhere(~occupied)
    size = _BLOCK
    while True:
        origin = first + 0.5 * voxel_size * (size - 1)
        chunks = np.array_split(index, math.ceil(len(index) / _CHUNK) or 1)
        results = [
            _classify(views, origin + size * voxel_size * c, size * voxel_size, needed)
            for c in chunks
        ]
        empty, full, seen = (np.concatenate(parts) for parts in zip(*results, strict=True))
        if size == 1:
            occupied[tuple(index[~empty & (seen >= needed)].T)] = True
            return OccupancyGrid(occupied, first, voxel_size)
        occupied[tuple(index[full].T)] = True
        occupied = occupied.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
        corners = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1)
        index = (2 * index[~empty & ~full, None] + corners).reshape(-1, 3)
        size //= 2


def _classify(
    views: list[_View], points: Float[np.ndarray, "points 3"], size: float, needed: int
) -> tuple[Bool[np.ndarray, " points"], Bool[np.ndarray, " points"], Int[np.ndarray, " points"]]:
    """Which cubes are off the hull, which are wholly in it, how many images see each centre."""
    radius = 0.5 * math.sqrt(3.0) * size
    alive = np.arange(len(points))
    full = np.ones(len(points), bool)
    seen = np.zeros(len(points), np.int32)  # images with the centre in their frame
    reached = np.zeros(len(points), np.int32)  # images with any part of the ball in their frame
    points = points.astype(np.float32)  # 1e-7 of the distance: far below a pixel
    for view in views:
        empty, inner, visible, touched = _look_up(view, points, radius)
        alive, points = alive[~empty], points[~empty]
        full[alive] &= inner[~empty]
        seen[alive] += visible[~empty]
        reached[alive] += touched[~empty]
    dropped = np.ones(len(full), bool)
    # A large cube may have parts that more images see than its centre.
    dropped[alive] = reached[alive] < needed
    full &= ~dropped & (seen >= needed) & (reached == seen)
    return dropped, full, seen


def _look_up(
    view: _View, points: Float[np.ndarray, "points 3"], radius: float
) -> tuple[Bool[np.ndarray, " points"], ...]:
    """What one image says of balls around `points`.

    Returns: empty (background all over), inner (all foreground, or out of frame), centre in the
    frame, and any part in the frame.
    """
    rotation = view.world_to_camera[:, :3].astype(np.float32)
    local = points @ rotation.T + view.world_to_camera[:, 3].astype(np.float32)
    depth = -local[:, 2]
    front = depth > 2.0 * radius
    depth = np.where(front, depth, np.float32(1.0))
    slope = local[:, :2] / depth[:, None]
    column = view.principal[0].astype(np.float32) + view.focal[0].astype(np.float32) * slope[:, 0]
    row = view.principal[1].astype(np.float32) - view.focal[1].astype(np.float32) * slope[:, 1]
    # For |d| <= r, |(c + d)_xy / (c + d)_z - c_xy / c_z| <= r sqrt(1 + |c_xy / c_z|^2) / (|c_z| -
    # r).
    stretch = np.sqrt(1.0 + slope[:, 0] ** 2 + slope[:, 1] ** 2)
    footprint = np.float32(view.focal.max() * radius) * stretch / (depth - np.float32(radius))
    height, width = view.distance.shape
    border = np.minimum(np.minimum(column, width - column), np.minimum(row, height - row))
    visible = front & (border > 0)
    distance = view.distance[
        np.where(visible, row, 0).astype(np.int32), np.where(visible, column, 0).astype(np.int32)
    ]
    # Two half diagonals of a pixel: from the projection to its pixel's centre, and a foreground
    # pixel's own.
    reach = footprint + np.float32(math.sqrt(2.0))
    whole = visible & (border >= footprint)
    touched = (front & (border > -footprint)) | (~front & (local[:, 2] < radius))
    return whole & (distance > reach), (whole & (-distance > reach)) | ~touched, visible, touched
