"""What COLMAP does for captured scenes, by pycolmap (extra `capture`): models, lenses, poses from images.

The only module that imports pycolmap, and only when it is needed. COLMAP's poses are world-to-camera with
OpenCV axes (x right, y down, looking along +z); what is returned here is camera-to-world with OpenGL axes.
Pixel centres lie at half integers in both.
"""

import dataclasses
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

Log = Callable[[str], None]

PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
_OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_MODEL_FILES = ("cameras.bin", "cameras.txt")
_MIN_MAPPED_SHARE = 0.5  # of the images: below that, poses are not worth going on with


@dataclasses.dataclass(frozen=True)
class Lens:
    """A camera model of COLMAP (`OPENCV`, `PINHOLE`, ...) with its parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def is_pinhole(self) -> bool:
        """Without distortion."""
        return self.model in PINHOLES

    @property
    def focal(self) -> tuple[float, float]:
        """Of a pinhole, in pixels."""
        return self.params[0], self.params[len(self.params) - 3]

    @property
    def principal(self) -> tuple[float, float]:
        """Of a pinhole, in pixels."""
        return self.params[-2], self.params[-1]


@dataclasses.dataclass(frozen=True)
class ModelImage:
    """An image of a COLMAP model: its name in the images' folder, its pose, its lens."""

    name: str
    camera_to_world: Float[np.ndarray, "4 4"]
    lens: Lens


def require_pycolmap(purpose: str) -> Any:
    """The module pycolmap; ValueError that names the extra where it is missing."""
    try:
        import pycolmap
    except ImportError as error:
        raise ValueError(
            f"{purpose} needs pycolmap, which is not installed ({error}); "
            "pip install -e '.[capture]'"
        ) from error
    return pycolmap


def find_model(folder: Path) -> Path | None:
    """The folder of a COLMAP model in a capture folder, where COLMAP and nerfstudio put it."""
    for place in ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "."):
        if any((folder / place / name).is_file() for name in _MODEL_FILES):
            return folder / place
    return None


def read_model(model: Path) -> list[ModelImage]:
    """The images of a COLMAP model (binary or text) that have a pose, by name.

    Raises ValueError where the model cannot be read or no image has a pose.
    """
    pycolmap = require_pycolmap(f"the COLMAP model {model}")
    try:
        reconstruction = pycolmap.Reconstruction(str(model))
    except (ValueError, RuntimeError, OSError) as error:
        raise ValueError(f"{model} is not a COLMAP model that can be read ({error})") from error
    images = []
    for image in reconstruction.images.values():
        if not image.has_pose:
            continue
        camera = reconstruction.cameras[image.camera_id]
        world_to_camera = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        lens = Lens(camera.model_name, camera.width, camera.height, tuple(map(float, camera.params)))
        images.append(ModelImage(image.name, np.linalg.inv(world_to_camera) @ _OPENCV_TO_OPENGL, lens))
    if not images:
        raise ValueError(f"{model}: no image has a pose; run COLMAP's mapper on more or sharper images")
    return sorted(images, key=lambda image: image.name)


def resized(lens: Lens, width: int, height: int, path: Path) -> Lens:
    """The lens in pixels of a stored picture, which may be a smaller copy of the one in the model.

    Raises ValueError, naming the picture's `path`, where it has another shape.
    """
    if (lens.width, lens.height) == (width, height):
        return lens
    if abs(lens.height * width / lens.width - height) > 1.0:  # its rounding: up to one pixel
        raise ValueError(
            f"{path} is {width}x{height}, but its camera in the model is {lens.width}x{lens.height}; "
            "give the images that COLMAP saw, or smaller copies of them"
        )
    camera = _camera(require_pycolmap("reading COLMAP models"), lens)
    camera.rescale(width, height)
    return Lens(lens.model, width, height, tuple(map(float, camera.params)))


def undistorted(lens: Lens) -> Lens:
    """The pinhole that a lens is undistorted to: as large as can be without blank pixels.

    Raises ValueError for a model that COLMAP does not know, or whose parameters leave no such pinhole.
    """
    if lens.is_pinhole:
        return lens
    pycolmap = require_pycolmap(f"undistorting ({lens.model})")
    try:
        camera = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), _camera(pycolmap, lens))
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"lens {lens.model} {lens.params} cannot be undistorted ({error})") from error
    pinhole = Lens(camera.model_name, camera.width, camera.height, tuple(map(float, camera.params)))
    if min(pinhole.focal) <= 0 or min(pinhole.width, pinhole.height) < 1:
        raise ValueError(f"lens {lens.model} {lens.params} cannot be undistorted to a pinhole")
    return pinhole


def undistort(pixels: UInt8[np.ndarray, "H W 3"], lens: Lens) -> UInt8[np.ndarray, "h w 3"]:
    """The picture that `undistorted(lens)` would have taken."""
    if lens.is_pinhole:
        return pixels
    pycolmap = require_pycolmap(f"undistorting ({lens.model})")
    bitmap = pycolmap.Bitmap.from_array(np.ascontiguousarray(pixels))
    options = pycolmap.UndistortCameraOptions()
    return pycolmap.undistort_image(options, bitmap, _camera(pycolmap, lens))[0].to_array()


def _camera(pycolmap: Any, lens: Lens) -> Any:
    return pycolmap.Camera(
        model=lens.model, width=lens.width, height=lens.height, params=list(lens.params)
    )


def poses_from_images(images: Path, names: Sequence[str], output: Path, log: Log = print) -> Path:
    """Run COLMAP on images alone: features, matches of all pairs, mapping. Returns the model's folder.

    One lens with radial distortion is shared by all images of one size. `output` is written
    whole or not at all. Raises ValueError where fewer than half of the images find their place.
    """
    pycolmap = require_pycolmap("finding poses from images alone")
    partial = output.with_name(f".{output.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        database = partial / "database.db"
        groups: dict[tuple[int, int], list[str]] = {}
        for name in names:
            bitmap = pycolmap.Bitmap.read(str(images / name), True)
            if bitmap is None:
                raise ValueError(f"{images / name} cannot be read by COLMAP; save it as JPEG or PNG")
            groups.setdefault((bitmap.width, bitmap.height), []).append(name)
        log(f"COLMAP: features and matches of {len(names)} images (minutes)")
        for group in groups.values():
            pycolmap.extract_features(
                database, images, image_names=group, camera_mode=pycolmap.CameraMode.SINGLE
            )
        pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, images, partial / "models")
        best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
        placed = best.num_reg_images() if best is not None else 0
        log(f"COLMAP: {placed} of {len(names)} images have a pose")
        if best is None or placed < _MIN_MAPPED_SHARE * len(names):
            raise ValueError(
                f"{images}: COLMAP finds poses for {placed} of {len(names)} images only; take more, "
                "sharper and more overlapping ones of something textured, or give poses (transforms.json)"
            )
        (partial / "sparse" / "0").mkdir(parents=True)
        best.write(partial / "sparse" / "0")
        shutil.rmtree(output, ignore_errors=True)
        partial.rename(output)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return output / "sparse" / "0"
