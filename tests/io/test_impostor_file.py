import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nimpostor_jax.io.impostor_file import load_impostor, save_impostor


def test_round_trip_is_exact(tmp_path, impostor):
    save_impostor(tmp_path / "new" / "ball.npz", impostor)
    loaded = load_impostor(tmp_path / "new" / "ball.npz")
    assert type(loaded) is type(impostor) and loaded.config == impostor.config
    assert jax.tree.structure(loaded) == jax.tree.structure(impostor)  # containers and None too
    for a, b in zip(jax.tree.leaves(loaded), jax.tree.leaves(impostor), strict=True):
        assert isinstance(a, jax.Array) and a.dtype == b.dtype and a.shape == b.shape
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["ball.npz"]


def test_the_same_impostor_gives_the_same_file(tmp_path, impostor):
    for name in ("a.npz", "b.npz"):
        save_impostor(tmp_path / name, impostor)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_the_file_needs_no_pickle(tmp_path, impostor):
    save_impostor(tmp_path / "a.npz", impostor)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        assert all(file[name].dtype != object for name in file.files)
        vertices = file["impostor/mesh/vertices"]
    assert vertices.tobytes() == np.asarray(impostor.mesh.vertices).tobytes()


def test_float64_needs_x64(tmp_path, impostor):
    with jax.enable_x64(True):
        mesh = impostor.mesh.replace(vertices=jnp.asarray(impostor.mesh.vertices, jnp.float64) / 3)
        save_impostor(tmp_path / "a.npz", impostor.replace(mesh=mesh))
        loaded = load_impostor(tmp_path / "a.npz").mesh.vertices
        assert loaded.dtype == jnp.float64 and (loaded == mesh.vertices).all()
    with pytest.raises(ValueError, match=r"a\.npz .*mesh/vertices is float64; set jax_enable_x64"):
        load_impostor(tmp_path / "a.npz")


def rewrite_header(path, change):
    with np.load(path) as file:
        stored = {name: file[name] for name in file.files}
    header = json.loads(stored["header.json"].tobytes())
    change(header)
    stored["header.json"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(path, **stored)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda h: h.update(version=3), "has format 3, not 2; update nimpostor-jax"),
        (lambda h: h.update(version=1), "has format 1, not 2; train and save it again"),
        (lambda h: h.update(version="x"), "is not an impostor file"),
        (lambda h: h.update(format="other"), "is not an impostor file"),
        (lambda h: h.pop("format"), "damaged, or not an impostor file"),
        (lambda h: h["config"].update(colour=1), "no field 'colour'"),
        (lambda h: h["structure"]["fields"].pop("tables"), "tables"),
        (lambda h: h["structure"].update(record="Popen"), "'Popen'"),
        (
            lambda h: h.update(structure=h["structure"]["fields"]["mesh"]),
            "a TetMesh, not a NeuralImpostor",
        ),
        (
            lambda h: h["structure"]["fields"]["decoder_index"].update(array="gone"),
            "cannot be read as an impostor: 'gone'",
        ),
    ],
)
def test_other_headers_are_refused(tmp_path, impostor, change, message):
    path = tmp_path / "a.npz"
    save_impostor(path, impostor)
    rewrite_header(path, change)
    with pytest.raises(ValueError, match=message) as caught:
        load_impostor(path)
    assert str(path) in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone\.npz does not exist"):
        load_impostor(tmp_path / "gone.npz")


@pytest.mark.parametrize("content", [b"", b"text", b"\x80\x04N.", b"PK\x03\x04" + bytes(40)])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.npz is damaged, or not an impostor file"):
        load_impostor(tmp_path / "a.npz")


def test_other_npz_files_are_refused(tmp_path):
    np.savez(tmp_path / "cage.npz", V=np.zeros((4, 3)), T=np.zeros((1, 4)))
    np.save(tmp_path / "array.npy", np.zeros(3))
    for name in ("cage.npz", "array.npy"):
        with pytest.raises(ValueError, match=f"{name} is damaged, or not an impostor file"):
            load_impostor(tmp_path / name)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_truncated_files_are_refused(tmp_path, impostor, share):
    path = tmp_path / "a.npz"
    save_impostor(path, impostor)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match=r"a\.npz is damaged"):
        load_impostor(path)


def test_a_changed_byte_is_noticed(tmp_path, impostor):
    path = tmp_path / "a.npz"
    save_impostor(path, impostor)
    data = bytearray(path.read_bytes())
    raw = np.asarray(impostor.tables.features).tobytes()
    data[data.index(raw) + 5] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.npz is damaged"):
        load_impostor(path)


@pytest.mark.parametrize(
    "decoders, message",
    [
        ({1: jnp.zeros(2)}, "keys must be text"),
        ({"a/b": jnp.zeros(2)}, "keys must be text without '/'"),
        ({"a": "text"}, "impostor/decoders/a: expected an array, got str"),
        ({"a": jax.random.key(0)}, "expected an array"),
    ],
)
def test_what_cannot_be_saved_leaves_nothing(tmp_path, impostor, decoders, message):
    with pytest.raises(ValueError, match=message):
        save_impostor(tmp_path / "a.npz", impostor.replace(decoders=decoders))
    assert list(tmp_path.iterdir()) == []


def test_the_suffix_is_npz(tmp_path, impostor):
    with pytest.raises(ValueError, match=r"a\.ckpt: the suffix of an impostor file must be \.npz"):
        save_impostor(tmp_path / "a.ckpt", impostor)
