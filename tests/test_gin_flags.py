"""gin files and flags: what can be bound, what is refused in one line, how a script exits."""

import argparse
import dataclasses
import subprocess
import sys
from pathlib import Path

import gin
import numpy as np
import pytest

from nimpostor_jax.config import (
    DecoderConfig,
    EncodingConfig,
    ExperimentConfig,
    ImpostorConfig,
    MarchConfig,
    RenderConfig,
    SamplerConfig,
    TrainConfig,
)
from nimpostor_jax.config_dict import check_types, to_dict
from nimpostor_jax.gin_flags import (
    TRACEBACK_VARIABLE,
    add_flags,
    config_from_args,
    config_of_runs,
    load_config,
    operative_config_text,
    run_cli,
)

CONFIGS = Path(__file__).resolve().parents[1] / "experiments" / "configs"

EVERYTHING_CHANGED = ExperimentConfig(
    impostor=ImpostorConfig(
        encoding=EncodingConfig(layout="per_tet", growth=1.6180339887498949, log2_tet_table=9),
        decoder=DecoderConfig(density_bias=-2.5, sh_degree=0),
    ),
    render=RenderConfig(
        march=MarchConfig(tile_size=64),
        sampler=SamplerConfig(measure="alpha", step=1e-7, capacity_per_ray=32),
        near=float("inf"),
    ),
    train=TrainConfig(steps=3, learning_rate=1, background="black"),
)


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def message_of(*args, **kwargs) -> str:
    with pytest.raises(ValueError) as caught:
        load_config(*args, **kwargs)
    message = str(caught.value)
    assert "\n" not in message
    return message


# What can be bound


def test_nothing_bound_is_the_default():
    assert load_config() == ExperimentConfig()


def test_nested_classes_are_put_together_without_wiring(tmp_path):
    text = "TrainConfig.steps = 5\nMarchConfig:\n  max_tets_per_ray = 9\n"
    path = write(tmp_path / "a.gin", text)
    config = load_config([path], ["EncodingConfig.layout = 'per_tet'"])
    assert config.train == TrainConfig(steps=5)
    assert config.render.march == MarchConfig(max_tets_per_ray=9)
    assert config.impostor.encoding == EncodingConfig(layout="per_tet")


def test_later_files_and_then_bindings_win(tmp_path):
    first = write(tmp_path / "first.gin", "TrainConfig.steps = 1\nTrainConfig.seed = 1")
    second = write(tmp_path / "second.gin", "TrainConfig.steps = 2\nTrainConfig.log_every = 2")
    train = load_config([first, str(second)], ["TrainConfig.log_every = 3"]).train
    assert (train.steps, train.seed, train.log_every) == (2, 1, 3)


def test_include_is_relative_to_the_including_file(tmp_path, monkeypatch):
    (tmp_path / "sub").mkdir()
    write(tmp_path / "base.gin", "TrainConfig.steps = 4\nTrainConfig.seed = 4")
    path = write(tmp_path / "sub" / "a.gin", "include '../base.gin'\nTrainConfig.seed = 5")
    monkeypatch.chdir("/")
    assert load_config([path]).train == TrainConfig(steps=4, seed=5)


def test_the_classes_themselves_stay_unaffected():
    config = load_config(bindings=["TrainConfig.steps = 7"])
    assert config.train.steps == 7
    assert TrainConfig().steps == ExperimentConfig().train.steps == 2000
    # Not gin's subclasses: equality, hashing and jit's cache go by the class.
    assert type(config) is ExperimentConfig
    assert type(config.train) is TrainConfig
    assert hash(config.train) == hash(TrainConfig(steps=7))


def test_two_calls_in_one_process_do_not_leak():
    assert load_config(bindings=["TrainConfig.steps = 7"]).train.steps == 7
    assert load_config(bindings=["TrainConfig.seed = 1"]).train == TrainConfig(seed=1)
    message_of(bindings=["TrainConfig.log_every = 2", "TrainConfig.steps = 0"])
    assert load_config() == ExperimentConfig()


def test_bindings_made_elsewhere_do_not_leak_in():
    gin.bind_parameter("TrainConfig.steps", 9)
    gin.finalize()  # locks gin, as another library in the same notebook may have
    assert load_config() == ExperimentConfig()


@pytest.mark.parametrize("config", [ExperimentConfig(), EVERYTHING_CHANGED])
def test_operative_text_round_trips(config, tmp_path):
    path = write(tmp_path / "operative.gin", operative_config_text(config))
    assert load_config([path]) == config


def test_operative_text_holds_every_field_once():
    def leaves(values: dict) -> int:
        return sum(leaves(value) if isinstance(value, dict) else 1 for value in values.values())

    names = [line.split(" = ")[0] for line in operative_config_text(ExperimentConfig()).split("\n")]
    names = [name for name in names if name]
    assert len(names) == len(set(names)) == leaves(to_dict(ExperimentConfig()))


def test_operative_text_of_numpy_scalars_can_be_read():
    config = ExperimentConfig(train=TrainConfig(learning_rate=np.float64(0.25)))
    assert load_config(bindings=[operative_config_text(config)]) == config


# What is refused


@pytest.mark.parametrize(
    "binding, parts",
    [
        ("TrainConfig.stesp = 3", ["did you mean TrainConfig.steps?", "rays_per_batch"]),
        ("TrainConfg.steps = 3", ["did you mean TrainConfig.steps?", "CageConfig"]),
        ("steps = 3", ["did you mean TrainConfig.steps?"]),
        ("TrainConfig.target_tets = 3", ["did you mean CageConfig.target_tets?"]),
        ("config.TrainConfig.steps = 3", ["did you mean TrainConfig.steps?"]),
        ("TrainConfg:\n  steps = 3", ["did you mean TrainConfig?"]),
        ("ExperimentConfig.train = 3", ["ExperimentConfig.train", "TrainConfig"]),
        ("RenderConfig.march = 3", ["march", "fields: density_measure, near"]),
        ("TrainConfig.steps = '5'", ["TrainConfig.steps must be int, got '5' (str)"]),
        ("TrainConfig.steps = 5.0", ["TrainConfig.steps must be int, got 5.0 (float)"]),
        ("TrainConfig.steps = True", ["TrainConfig.steps must be int, got True (bool)"]),
        ("EncodingConfig.log2_tet_table = 'a'", ["EncodingConfig.log2_tet_table must be int"]),
        ("DataConfig.background = 'purple'", ["DataConfig.background", "'white'", "'purple'"]),
        ("TrainConfig.steps = 0", ["TrainConfig.steps must be >= 1, got 0"]),
        ("EncodingConfig.max_log2_tet_table = 4", ["min_log2_tet_table must be in"]),
        ("EncodingConfig.growth = 1e300", ["EncodingConfig"]),
        ("DataConfig.background = black", ["'black'", "text in quotes"]),
        ("TrainConfig.steps", ["Class.field = value"]),
        ("TrainConfig.steps = (1", ["cannot be read"]),
        ("TrainConfig.steps = 1 TrainConfig.seed = 2", ["newline"]),
        ("", ["empty"]),
        ("a/TrainConfig.steps = 1", ["scope 'a'", "write TrainConfig.steps"]),
        ("TrainConfig.steps = %steps", ["TrainConfig.steps must be a literal, got %steps"]),
        ("TrainConfig.steps = @TrainConfig()", ["must be a literal, got @TrainConfig"]),
        ("import os", ["import"]),
    ],
)
def test_a_bad_binding_is_one_line_that_names_it(binding, parts):
    message = message_of(bindings=["TrainConfig.seed = 1", binding])
    assert message.startswith(f"binding {binding!r}: ")
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    "line", ["TrainConfig.stesp = 3", "TrainConfig.steps = '3'", "TrainConfig.steps = 0", "= 3"]
)
def test_a_bad_line_of_a_file_is_named_by_its_place(line, tmp_path):
    path = write(tmp_path / "a.gin", f"# comment\nTrainConfig.seed = 1\n\n{line}\n")
    assert message_of([path]).startswith(f"{path}:4: ")


def test_a_bad_line_of_an_included_file_is_named_by_its_place(tmp_path):
    base = write(tmp_path / "base.gin", "TrainConfig.steps = 0")
    path = write(tmp_path / "a.gin", "include 'base.gin'")
    assert message_of([path]).startswith(f"{base}:1: ")


def test_a_file_that_includes_itself(tmp_path):
    path = write(tmp_path / "a.gin", "include 'a.gin'")
    assert "includes itself" in message_of([path])
    (tmp_path / "sub").mkdir()
    write(tmp_path / "sub" / "c.gin", "include '../b.gin'")  # its path is spelled longer each time
    assert "includes itself" in message_of([write(tmp_path / "b.gin", "include 'sub/c.gin'")])


def test_a_missing_file_suggests_its_neighbour(tmp_path):
    write(tmp_path / "mic.gin", "")
    with pytest.raises(FileNotFoundError) as caught:
        load_config([tmp_path / "mik.gin"])
    assert str(tmp_path / "mik.gin") in str(caught.value)
    assert "did you mean mic.gin?" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_text(tmp_path):
    (tmp_path / "a.gin").write_bytes(b"\xff\xfe\x00")
    assert str(tmp_path / "a.gin") in message_of([tmp_path / "a.gin"])
    assert str(tmp_path) in message_of([tmp_path])


@pytest.mark.parametrize("name", ["configs", "bindings"])
def test_text_in_place_of_a_list(name):
    # Otherwise each of its characters would be taken for a file or a binding.
    assert f"{name} must be a list" in message_of(**{name: "TrainConfig.steps = 1"})


# Flags


def parse(*argv: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(epilog="More text.")
    add_flags(parser)
    return parser.parse_args(argv)


def test_flags_take_several_values_and_can_be_repeated(tmp_path):
    first = write(tmp_path / "first.gin", "TrainConfig.steps = 1\nTrainConfig.seed = 1")
    second = write(tmp_path / "second.gin", "TrainConfig.steps = 2")
    args = parse(
        f"--gin_configs={first}",
        *("--gin_configs", str(second)),
        "--gin_bindings=TrainConfig.log_every=2",
        *("--gin_bindings", "TrainConfig.warmup_steps=3", "CageConfig.target_tets = 30"),
    )
    config = config_from_args(args)
    assert config.train == TrainConfig(steps=2, seed=1, log_every=2, warmup_steps=3)
    assert config.cage.target_tets == 30


def test_runs_that_no_one_config_renders_are_refused(tmp_path):
    """As training leaves them, and with a flag that makes them alike."""
    parser = argparse.ArgumentParser()
    add_flags(parser)
    plain, color, early, length = (tmp_path / name for name in ("plain", "color", "early", "length"))
    for folder, binding in (
        (plain, ()),
        (color, ["TrainConfig.steps=7"]),
        (early, ["RenderConfig.integrate='features'"]),
        (length, ["RenderConfig.density_measure='euclidean'"]),
    ):
        folder.mkdir()
        (folder / "config.gin").write_text(operative_config_text(load_config([], binding)))
    assert config_of_runs([color, plain], parser.parse_args([])).train.steps == 7
    with pytest.raises(ValueError, match=r"integrate is 'features' in .*early and 'color' in .*plain"):
        config_of_runs([plain, early], parser.parse_args([]))
    bound = parser.parse_args(["--gin_bindings", "RenderConfig.integrate='features'"])
    assert config_of_runs([plain, early], bound).render.integrate == "features"
    with pytest.raises(ValueError, match="length measures density by length"):
        config_of_runs([plain, length], parser.parse_args([]))


def test_flags_default_to_nothing_and_keep_nothing_between_parsers():
    assert parse("--gin_bindings=TrainConfig.seed=1").gin_bindings == ["TrainConfig.seed=1"]
    args = parse()
    assert (args.gin_configs, args.gin_bindings, args.traceback) == ([], [], False)


def test_help_lists_every_field_with_its_default():
    parser = argparse.ArgumentParser(epilog="More text.")
    add_flags(parser)
    text = parser.format_help()
    assert "More text." in text
    for line in filter(None, operative_config_text(ExperimentConfig()).split("\n")):
        assert f"{line}  (" in text


# Scripts


def outcome(main, argv, capsys) -> tuple[int, str]:
    with pytest.raises(SystemExit) as caught:
        run_cli(main, argv)
    return caught.value.code, capsys.readouterr().err


def failing(error: BaseException):
    def main(argv):
        raise error

    return main


def test_run_cli_passes_arguments_and_status(capsys):
    seen = []
    assert outcome(seen.extend, ["a", "b"], capsys) == (0, "")
    assert seen == ["a", "b"]
    assert outcome(lambda argv: 3, [], capsys) == (3, "")


@pytest.mark.parametrize("kind", [ValueError, FileNotFoundError, PermissionError, FloatingPointError])
def test_run_cli_ends_a_users_error_in_one_line(kind, capsys):
    assert outcome(failing(kind("bad\n  file x")), [], capsys) == (2, "error: bad file x\n")


@pytest.mark.parametrize("kind", [TypeError, RuntimeError])
def test_run_cli_says_how_to_see_where_other_errors_come_from(kind, capsys):
    status, err = outcome(failing(kind("bad")), [], capsys)
    assert (status, err.count("\n")) == (2, 1)
    assert err.startswith("error: bad") and "--traceback" in err


def test_run_cli_interrupted(capsys):
    assert outcome(failing(KeyboardInterrupt()), [], capsys) == (130, "interrupted\n")


def test_run_cli_lets_errors_through_when_asked(monkeypatch):
    with pytest.raises(ValueError, match="bad"):
        run_cli(failing(ValueError("bad")), ["--traceback"])
    monkeypatch.setenv(TRACEBACK_VARIABLE, "1")
    with pytest.raises(ValueError, match="bad"):
        run_cli(failing(ValueError("bad")), [])


def test_run_cli_does_not_hide_other_errors():
    with pytest.raises(ZeroDivisionError):
        run_cli(failing(ZeroDivisionError()), [])


def test_a_script_end_to_end(tmp_path):
    script = write(
        tmp_path / "script.py",
        "import argparse\n"
        "from nimpostor_jax.gin_flags import add_flags, config_from_args, run_cli\n"
        "def main(argv):\n"
        "    parser = argparse.ArgumentParser()\n"
        "    add_flags(parser)\n"
        "    print(config_from_args(parser.parse_args(argv)).train.steps)\n"
        "run_cli(main)\n",
    )

    def run(binding: str) -> subprocess.CompletedProcess:
        command = [sys.executable, str(script), f"--gin_bindings={binding}"]
        return subprocess.run(command, capture_output=True, text=True, timeout=60)

    good, bad = run("TrainConfig.steps=12"), run("TrainConfig.stesp=12")
    assert (good.returncode, good.stdout) == (0, "12\n")
    assert (bad.returncode, bad.stdout, bad.stderr.count("\n")) == (2, "", 1)
    assert bad.stderr.startswith("error: binding 'TrainConfig.stesp=12': ")


# The files of experiments/configs


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.gin")), ids=lambda path: path.name)
def test_shipped_config_loads_and_states_only_what_differs_from_the_defaults(path):
    config = load_config([path])
    check_types(config)
    lines = [line.split("#")[0].strip() for line in path.read_text().splitlines()]
    default = operative_config_text(ExperimentConfig()).splitlines()
    for line in filter(None, lines):
        assert line not in default


def test_the_three_scenes_have_a_config():
    assert {"fluffy_ball.gin", "mic.gin", "plush_spot.gin"} <= {p.name for p in CONFIGS.iterdir()}


def test_every_config_class_occurs_once():
    # A binding names a class, so a class with two places in the tree could not be told apart.
    def classes(config):
        yield type(config)
        for field in dataclasses.fields(config):
            if dataclasses.is_dataclass(field.type):
                yield from classes(getattr(config, field.name))

    found = list(classes(ExperimentConfig()))
    assert len(found) == len(set(found))
