"""Cameras and `transforms_*.json` for scenes that tests write."""

import json

import numpy as np


def camera_to_world(angle):
    """A camera 4 units from the origin, turned about z, that looks at it."""
    c, s = np.cos(angle), np.sin(angle)
    right, up, back = np.array([-s, c, 0]), np.array([0, 0, 1.0]), np.array([c, s, 0])
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, up, back, 4 * back], axis=1)
    return matrix


def read_transforms(folder, split="train"):
    return json.loads((folder / f"transforms_{split}.json").read_text())


def write_transforms(folder, split, values):
    (folder / f"transforms_{split}.json").write_text(json.dumps(values))
