"""Captured scenes: a folder of photographs to an undistorted dataset folder with one pinhole size.

Read are `transforms.json` (instant-ngp, nerfstudio), COLMAP model folders, and images alone. Nothing is
assumed of the world's axes, origin or scale; cameras follow OpenGL axes. Everything that the metadata
and the images' headers can tell is checked before a pixel is decoded.
"""

import dataclasses
import json
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nimpostor_jax.io.atomic import atomic_path
from nimpostor_jax.io.colmap import (
    Lens,
    find_model,
    poses_from_images,
    read_model,
    resized,
    undistort,
    undistorted,
)
from nimpostor_jax.io.images import area_downsample, image_header, read_image, to_uint8, write_png
from nimpostor_jax.io.transforms import (
    DISTORTION_KEYS,
    IMAGE_SUFFIXES,
    check_no_masks,
    image_path,
    intrinsics,
    number,
    read_json,
    read_matrix,
)

Log = Callable[[str], None]

MIN_VIEWS = 3
_RADIAL = ("OPENCV", "FULL_OPENCV", "RADIAL", "SIMPLE_RADIAL")
_FISHEYE = ("OPENCV_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
_PINHOLE = ("PINHOLE", "SIMPLE_PINHOLE")
_MUCH_CROPPED = 0.75  # share of a picture below which cropping to the common shape is worth a warning


@dataclasses.dataclass(frozen=True, eq=False)
class Capture:
    """N photographs with poses and lenses, on disk."""

    source: Path  # the file or folder that says so
    paths: tuple[Path, ...]
    camera_to_world: Float[np.ndarray, "N 4 4"]
    lenses: tuple[Lens, ...]  # in pixels of the files


@dataclasses.dataclass(frozen=True)
class Crop:
    """Which part of an undistorted picture is kept; the part is then averaged to the common size."""

    pinhole: Lens
    left: int
    top: int
    width: int
    height: int

    def intrinsics(
        self, width: int, height: int
    ) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
        """Focal lengths and principal point in pixels of the part at a size."""
        zoom = np.array([width / self.width, height / self.height])
        principal = np.array(self.pinhole.principal) - [self.left, self.top]
        return np.array(self.pinhole.focal) * zoom, principal * zoom


def read_capture(folder: str | Path, workdir: str | Path, log: Log = print) -> Capture:
    """Photographs of a folder with `transforms.json`, a COLMAP model, or images alone, in this order.

    From images alone COLMAP's model is kept in `workdir`/colmap and found there again. Raises
    FileNotFoundError for a missing folder or image, ValueError for anything inconsistent; both name the
    file and the frame where there is one.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise FileNotFoundError(f"capture folder {folder} does not exist")
    model = find_model(folder)
    if (folder / "transforms.json").is_file():
        capture = _from_transforms(folder)
    elif model is not None:
        capture = _from_model(model, _images_of_model(folder, model))
    else:
        capture = _from_images(folder, Path(workdir) / "colmap", log)
    if len(capture.paths) < MIN_VIEWS:
        raise ValueError(f"{capture.source}: {len(capture.paths)} views; at least {MIN_VIEWS} are needed")
    models = Counter(lens.model for lens in capture.lenses)
    log(f"{capture.source}: {len(capture.paths)} views, {', '.join(f'{n} {m}' for m, n in models.items())}")
    return capture


def _from_transforms(folder: Path) -> Capture:
    json_path = folder / "transforms.json"
    meta = read_json(folder, json_path)
    frames = meta["frames"]
    paths, poses, lenses = [], [], []
    check_no_masks(frames, json_path)
    for i, frame in enumerate(frames):
        poses.append(read_matrix(frame, i, json_path))
        paths.append(image_path(folder, frame, i, json_path))
        width, height, _ = image_header(paths[-1])
        lenses.append(_lens({**meta, **frame}, width, height, json_path, i))
    _check_names(paths, json_path)
    return Capture(json_path, tuple(paths), np.stack(poses), tuple(lenses))


def _lens(values: dict[str, Any], width: int, height: int, json_path: Path, index: int) -> Lens:
    """The lens of a frame, in pixels of its file."""
    where = f"{json_path}: frame {index}"
    (fx, fy), (cx, cy) = intrinsics(values, width, height, json_path, index)
    coefficients = {key: number(values, key, 0.0, where) for key in DISTORTION_KEYS}
    model = values.get("camera_model", "OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV")
    if model not in _RADIAL + _FISHEYE + _PINHOLE:
        known = ", ".join(_PINHOLE + _RADIAL + _FISHEYE)
        raise ValueError(
            f"{where}: 'camera_model' {model!r} is not supported; undistort the images, or use one of {known}"
        )
    bent = [key for key, value in coefficients.items() if value]
    if model in _FISHEYE:
        wrong = [key for key in bent if key.startswith("p")]
        params = [coefficients[key] for key in ("k1", "k2", "k3", "k4")]
        lens = Lens("OPENCV_FISHEYE", width, height, (fx, fy, cx, cy, *params))
    else:
        # COLMAP's k4 divides where nerfstudio's multiplies: the same number would mean something else.
        wrong = bent if model in _PINHOLE else [key for key in bent if key == "k4"]
        params = [coefficients[key] for key in ("k1", "k2", "p1", "p2")]
        if coefficients["k3"]:
            lens = Lens("FULL_OPENCV", width, height, (fx, fy, cx, cy, *params, coefficients["k3"], 0, 0, 0))
        elif any(params):
            lens = Lens("OPENCV", width, height, (fx, fy, cx, cy, *params))
        else:
            lens = Lens("PINHOLE", width, height, (fx, fy, cx, cy))
    if wrong:
        raise ValueError(f"{where}: '{wrong[0]}' has no meaning for the lens {model!r}; set it to 0")
    return lens


def _images_of_model(folder: Path, model: Path) -> Path:
    for images in (folder / "images", model / "images", folder):
        if images.is_dir() and (images != folder or _picture_names(folder)):
            return images
    raise FileNotFoundError(f"{folder / 'images'} does not exist; put the images of {model} there")


def _from_model(model: Path, images: Path) -> Capture:
    found = read_model(model)
    paths, lenses = [], []
    for i, image in enumerate(found):
        path = images / image.name
        if not path.is_file():
            raise FileNotFoundError(f"image {path} does not exist ({model}, image {i})")
        paths.append(path)
        lenses.append(resized(image.lens, *image_header(path)[:2], path))
    _check_names(paths, model)
    return Capture(model, tuple(paths), np.stack([i.camera_to_world for i in found]), tuple(lenses))


def _from_images(folder: Path, output: Path, log: Log) -> Capture:
    images = folder / "images" if (folder / "images").is_dir() else folder
    names = _picture_names(images)
    if not names:
        raise FileNotFoundError(
            f"{folder} has no transforms.json, no COLMAP model (sparse/0) and no images "
            f"({' '.join(IMAGE_SUFFIXES)})"
        )
    for name in names:
        image_header(images / name)
    model, sizes = find_model(output), {name: (images / name).stat().st_size for name in names}
    record = output.with_name(f"{output.name}.json")  # names alone are the same in every camera
    if model is None:
        with atomic_path(record) as temporary:
            temporary.write_text(json.dumps(sizes, indent=1) + "\n", encoding="utf-8")
        model = poses_from_images(images, names, output, log)
    elif not record.is_file():
        raise ValueError(f"{record}, which says what {output} is made from, is missing; remove {output}")
    elif json.loads(record.read_text(encoding="utf-8")) != sizes:
        raise ValueError(f"{output} has the poses of other images than {images}; remove it")
    return _from_model(model, images)


def _picture_names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if p.is_file() and p.suffix.lower() in IMAGE_SUFFIXES)


def _check_names(paths: list[Path], source: Path) -> None:
    repeated = [path for path, count in Counter(paths).items() if count > 1]
    if repeated:
        raise ValueError(f"{source}: image {repeated[0]} is listed more than once; remove the copies")


def common_crops(capture: Capture, log: Log = print) -> tuple[list[Crop], int, int]:
    """What is kept of each undistorted picture, and the width and height that all are averaged to.

    The common shape is that of the lens that keeps most of all pictures; the common size is the smallest.
    """
    pinholes = {lens: undistorted(lens) for lens in set(capture.lenses)}
    shapes = {lens: pinhole.width / pinhole.height for lens, pinhole in pinholes.items()}
    counts = Counter(capture.lenses)

    def kept(aspect: float) -> float:
        return sum(n * min(aspect / shapes[lens], shapes[lens] / aspect) for lens, n in counts.items())

    aspect = max(sorted(set(shapes.values())), key=kept)
    crops = {}
    for lens, pinhole in pinholes.items():
        width = min(pinhole.width, max(1, round(pinhole.height * aspect)))
        height = min(pinhole.height, max(1, round(pinhole.width / aspect)))
        left, top = (pinhole.width - width) // 2, (pinhole.height - height) // 2
        crops[lens] = Crop(pinhole, left, top, width, height)
    share = min(c.width * c.height / (c.pinhole.width * c.pinhole.height) for c in crops.values())
    if share < _MUCH_CROPPED:
        log(f"warning: pictures of several shapes; of some only {share:.0%} is in the common one")
    width = min(crop.width for crop in crops.values())
    height = min(max(1, round(width / aspect)), *(crop.height for crop in crops.values()))
    return [crops[lens] for lens in capture.lenses], width, height


def write_views(
    capture: Capture, folder: Path, indices: np.ndarray, split: str, crops: list[Crop], size: tuple[int, int]
) -> None:
    """Undistort, crop and average the chosen views into `folder`/images, and list them.

    Raises ValueError, naming the file, for a damaged picture and for one that has an alpha mask.
    """
    width, height = size
    frames = []
    for i in indices:
        image, _ = read_image(capture.paths[i])
        if image[..., 3].min() < 1:
            raise ValueError(
                f"{capture.paths[i]} has an alpha mask; train on masks with experiments/train.py "
                "(nerf-synthetic layout, undistorted), or save the images without alpha"
            )
        crop = crops[i]
        pixels = undistort(to_uint8(image[..., :3]), capture.lenses[i])
        part = pixels[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]
        name = f"{i:04d}_{capture.paths[i].stem}.png"
        write_png(folder / "images" / name, area_downsample(part.astype(np.float32) / 255, width, height))
        focal, principal = crop.intrinsics(width, height)
        frames.append(
            {
                "file_path": f"images/{name}",
                "transform_matrix": capture.camera_to_world[i].tolist(),
                **dict(zip(("fl_x", "fl_y", "cx", "cy"), [*focal, *principal], strict=True)),
            }
        )
    _write(folder, split, {"w": width, "h": height, "frames": frames})


def write_backgrounds(folder: Path, split: str, pictures: Iterator[Float[np.ndarray, "H W 3"]]) -> None:
    """Add pictures of what is behind the object to the views of a split."""
    meta = read_json(folder, folder / f"transforms_{split}.json")
    for frame, picture in zip(meta["frames"], pictures, strict=True):
        frame["background_path"] = f"backgrounds/{Path(frame['file_path']).name}"
        write_png(folder / frame["background_path"], picture)
    _write(folder, split, meta)


def _write(folder: Path, split: str, values: dict[str, Any]) -> None:
    (folder / f"transforms_{split}.json").write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
