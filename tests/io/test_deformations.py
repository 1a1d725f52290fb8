"""Deformation files: the reference scenes' JSON, and one clear error for each mistake."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from nimpostor_jax.edit import deform
from nimpostor_jax.io.deformations import load_deformation

SHARED = Path(__file__).resolve().parents[2] / "../shared/data"
POINTS = jnp.array([[0.3, -0.2, 0.9], [-0.5, 0.1, -0.4]])


def write(tmp_path, content):
    path = tmp_path / "deformation.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize(
    "content, same_as",
    [
        ({"name": "twist", "k": 0.9}, deform.twist(0.9)),
        ({"name": "bend", "c": 0.5, "formula": "ignored"}, deform.bend(0.5)),
        ({"name": "stretch", "a": 0.2, "b": 3}, deform.stretch(0.2, 3.0)),
        (
            {
                "name": "rigid",
                "rotation": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
                "translation": [1, 2, 3],
            },
            deform.rigid(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3])),
        ),
        (
            {
                "name": "drag",
                "center": [0.2, 0, 0.8],
                "radius": 0.5,
                "translation": [0.1, 0, 0],
                "rotation_vector": [0, 0, 0.4],
            },
            deform.drag(np.array([0.2, 0, 0.8]), 0.5, np.array([0.1, 0, 0]), np.array([0, 0, 0.4])),
        ),
    ],
)
def test_reads_every_family(tmp_path, content, same_as):
    loaded = load_deformation(write(tmp_path, content))
    np.testing.assert_array_equal(loaded(POINTS), same_as(POINTS))


def test_reads_the_reference_scenes():
    path = SHARED / "fluffy_ball/deformation_bend.json"
    if not path.exists():
        pytest.skip("the shared data is not there")
    np.testing.assert_array_equal(load_deformation(path)(POINTS), deform.bend(0.5)(POINTS))


@pytest.mark.parametrize(
    "content, message",
    [
        ("{", "not readable as JSON"),
        ("[1]", "expected an object"),
        ({"c": 1.0}, "unknown deformation None; known: bend, drag, rigid, stretch, twist"),
        ({"name": "fold"}, "unknown deformation 'fold'; known: bend"),
        ({"name": ["bend"]}, "unknown deformation"),
        ({"name": "stretch", "a": 1.0}, "'stretch' lacks parameter 'b'; it takes a, b"),
        ({"name": "bend", "c": "0.5"}, "'c' must be a finite number, got '0.5'"),
        ({"name": "bend", "c": True}, "'c' must be a finite number"),
        ('{"name": "bend", "c": NaN}', "'c' must be a finite number"),
        (
            {"name": "drag", "radius": 0}
            | {name: [0, 0, 0] for name in ("center", "translation", "rotation_vector")},
            "deformation.json: drag: radius must be > 0",
        ),
        ({"name": "rigid", "rotation": [1], "translation": [0, 0, 0]}, "shape [3, 3]"),
    ],
)
def test_mistakes_are_named(tmp_path, content, message):
    path = write(tmp_path, content)
    with pytest.raises(ValueError) as error:
        load_deformation(path)
    assert message in str(error.value) and str(path) in str(error.value)


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.json"):
        load_deformation(tmp_path / "nothing.json")
