"""Captures that tests make: an object in front of a smooth dome, through a lens, in a world of any frame.

    python tests/captures.py --data=DIR --out=DIR [--resolution=200] [--poses={json,colmap,none}]

turns the training views of an RGBA scene into such photographs. The lens is written out here (OpenCV's
model), so that it checks the one that the library uses.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

LENS = {"k1": 0.08, "k2": -0.02, "p1": 0.003, "p2": -0.002}


def distort(points, k1=0.0, k2=0.0, p1=0.0, p2=0.0):
    """OpenCV's radial and tangential model on normalised image points [..., 2] (y down)."""
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([x * radial + dx, y * radial + dy], axis=-1)


def undistort(points, **lens):
    """Its inverse, by fixed-point iteration."""
    found = points.copy()
    for _ in range(50):
        found = found - (distort(found, **lens) - points)
    return found


def dome(directions):
    """A smooth colour in [0, 1] for each direction."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return 0.5 + 0.4 * np.stack(
        [np.sin(2 * x + z), np.cos(1.5 * y - 0.5 * x), np.sin(1.5 * z + 1) * np.cos(y)], axis=-1
    )


def similarity(seed=3, scale=2.7, shift=(40.0, -7.0, 3.0)):
    """Rotation, scale and shift of an arbitrary world."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q)), scale, np.array(shift)


def moved(poses, rotation, scale, shift):
    """Camera-to-world matrices in the moved world."""
    poses = np.array(poses, float)
    poses[:, :3, :3] = rotation @ poses[:, :3, :3]
    poses[:, :3, 3] = scale * poses[:, :3, 3] @ rotation.T + shift
    return poses


def photograph(rgba, focal, principal, pose, lens, new_focal, new_principal, size, background=dome):
    """What a distorting camera sees of a pinhole's premultiplied picture, before the background."""
    width, height = size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    seen = (np.stack([x, y], axis=-1) - new_principal) / new_focal
    ideal = undistort(seen, **lens)
    at = ideal * focal + principal - 0.5
    place = [at[..., 1], at[..., 0]]
    channels = [ndimage.map_coordinates(rgba[..., c], place, order=1, cval=0.0) for c in range(4)]
    image = np.stack(channels, axis=-1)
    local = np.stack([ideal[..., 0], -ideal[..., 1], -np.ones(ideal.shape[:2])], axis=-1)
    directions = local @ pose[:3, :3].T
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return image[..., :3] + (1 - image[..., 3:]) * background(directions)


def write_capture(folder, views, world=None, lens=LENS, wide=0.95, background=dome):
    """Photographs of posed RGBA views and their `transforms.json`, in instant-ngp's manner.

    `wide` is the focal length over the views' own: below 1 more of the surroundings is seen.
    """
    (folder / "images").mkdir(parents=True, exist_ok=True)
    poses = moved(views.camera_to_world, *(similarity() if world is None else world))
    width, height = views.width, views.height
    new_focal, new_principal = wide * views.focal[0], views.principal[0] + [0.02 * width, -0.03 * height]
    frames = []
    for i, pose in enumerate(poses):
        image = photograph(
            views.images[i], views.focal[i], views.principal[i], pose, lens, new_focal, new_principal,
            (width, height), background,
        )
        pixels = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
        Image.fromarray(pixels).save(folder / "images" / f"{i:03d}.jpg", quality=95)
        frames.append({"file_path": f"images/{i:03d}.jpg", "transform_matrix": pose.tolist()})
    meta = {"fl_x": new_focal[0], "fl_y": new_focal[1], "cx": new_principal[0], "cy": new_principal[1]}
    meta |= {"w": width, "h": height, **lens, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


def to_colmap_model(folder):
    """Put a COLMAP model with the same poses and lens in the place of a capture's `transforms.json`."""
    import pycolmap

    meta = json.loads((folder / "transforms.json").read_text())
    params = [meta[key] for key in ("fl_x", "fl_y", "cx", "cy")] + [meta.get(k, 0.0) for k in LENS]
    camera = pycolmap.Camera(camera_id=1, model="OPENCV", width=meta["w"], height=meta["h"], params=params)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    for i, frame in enumerate(meta["frames"]):
        world_to_camera = np.diag([1, -1, -1, 1]) @ np.linalg.inv(frame["transform_matrix"])
        image = pycolmap.Image(name=Path(frame["file_path"]).name, camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(world_to_camera[:3]))
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(folder / "sparse" / "0")
    (folder / "transforms.json").unlink()


def main():
    """Run as a script."""
    from nimpostor_jax.io.blender import load_blender

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", required=True)
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--resolution", type=int)
    parser.add_argument("--poses", choices=["json", "colmap", "none"], default="json")
    args = parser.parse_args()
    write_capture(args.out, load_blender(args.data, "train", args.resolution))
    if args.poses == "colmap":
        to_colmap_model(args.out)
    elif args.poses == "none":
        (args.out / "transforms.json").unlink()


if __name__ == "__main__":
    main()
