"""gin files and command-line flags to an `ExperimentConfig`; the only module that imports gin.

Every config class of `config.py` is bound by its name (`TrainConfig.steps = 2000`), and the nested
classes are put together here, so a gin file needs no wiring: literals only, without scopes, macros,
references and imports, each of which gin would otherwise accept and could silently ignore.
"""

import argparse
import dataclasses
import difflib
import os
import sys
import tokenize
import typing
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn

import gin
from gin import config_parser

from nimpostor_jax.config import ExperimentConfig
from nimpostor_jax.config_dict import check_types
from nimpostor_jax.io.atomic import atomic_path

TRACEBACK_VARIABLE = "NIMPOSTOR_TRACEBACK"


def _config_classes(root: Any) -> Iterator[type]:
    yield root
    for field in dataclasses.fields(root):
        if dataclasses.is_dataclass(field.type):
            yield from _config_classes(field.type)


def _leaf_fields(cls: Any) -> list[dataclasses.Field]:
    return [field for field in dataclasses.fields(cls) if not dataclasses.is_dataclass(field.type)]


_CLASSES: dict[str, Any] = {cls.__name__: cls for cls in _config_classes(ExperimentConfig)}
# gin's wrappers are subclasses: the classes themselves never see a binding.
_CONFIGURABLES = {name: gin.external_configurable(cls) for name, cls in _CLASSES.items()}
_FIELDS = {
    name: [field.name for field in _leaf_fields(cls)]
    for name, cls in _CLASSES.items()
    if _leaf_fields(cls)
}


def load_config(
    configs: Sequence[str | Path] = (), bindings: Sequence[str] = ()
) -> ExperimentConfig:
    """Build the config of one run from gin files and then bindings; a later one wins.

    gin keeps one global table of bindings. It is emptied first, so calls do not affect each other
    (nor do bindings that others made with gin survive).

    Args:
      configs: paths of gin files. `include "other.gin"` is relative to the including file.
      bindings: lines as in a gin file, e.g. `TrainConfig.steps = 2000`.

    Raises:
      FileNotFoundError: a file does not exist.
      ValueError: in one line, the first binding that cannot be read, names an unknown class or
        field, or has a value of the wrong type or out of range, with its place.
    """
    for name, given in (("configs", configs), ("bindings", bindings)):
        if isinstance(given, (str, Path)):
            raise ValueError(f"{name} must be a list, got {str(given)!r}; put it in brackets")
    gin.clear_config()
    places: dict[str, str] = {}
    for path in configs:
        _bind_file(Path(path), places, including=())
    for binding in bindings:
        _bind_text(binding, None, places, including=())
    return _build(ExperimentConfig, places)


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add `--gin_configs`, `--gin_bindings` and `--traceback`; `--help` ends with every field."""
    parser.add_argument(
        "--gin_configs", nargs="*", action="extend", default=[], metavar="FILE", help="gin files"
    )
    parser.add_argument(
        "--gin_bindings",
        nargs="*",
        action="extend",
        default=[],
        metavar="CLASS.FIELD=VALUE",
        help="bindings that override the files', e.g. TrainConfig.steps=500 TrainConfig.seed=1",
    )
    parser.add_argument(
        "--traceback",
        action="store_true",
        help=f"end an error with its full traceback (or set {TRACEBACK_VARIABLE}=1)",
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "\n\n".join(filter(None, [parser.epilog, _help_text()]))


def config_from_args(args: argparse.Namespace) -> ExperimentConfig:
    """The config that the flags of `add_flags` ask for; errors as `load_config`."""
    return load_config(args.gin_configs, args.gin_bindings)


def config_of_run(workdir: Path, args: argparse.Namespace) -> ExperimentConfig:
    """The config that a training run saved, with `args` of `add_flags` on top.

    Raises FileNotFoundError where there is none.
    """
    saved = workdir / "config.gin"
    if not saved.exists():
        raise FileNotFoundError(
            f"{saved} does not exist; train first (experiments/train.py --workdir={workdir})"
        )
    return load_config([saved, *args.gin_configs], args.gin_bindings)


def config_of_runs(workdirs: Sequence[Path], args: argparse.Namespace) -> ExperimentConfig:
    """The first run's config, for what is made of several runs' fields; errors as `config_of_run`.

    Raises ValueError for a run whose densities do not keep their meaning in another frame, and where one
    rule of rendering does not fit all of the fields.
    """
    configs = [config_of_run(workdir, args) for workdir in workdirs]
    for workdir, config in zip(workdirs, configs, strict=True):
        if config.render.density_measure != "barycentric":
            raise ValueError(
                f"{workdir} measures density by length, which changes with the cage's frame; train it with "
                "RenderConfig.density_measure='barycentric'"
            )
        for name in ("integrate", "directions"):
            ours, first = (getattr(each.render, name) for each in (config, configs[0]))
            if ours != first:
                raise ValueError(
                    f"RenderConfig.{name} is {ours!r} in {workdir} and {first!r} in {workdirs[0]}: one rule "
                    "renders both; train them alike, or bind it"
                )
    return configs[0]


def save_config(config: ExperimentConfig, folder: Path) -> None:
    """Write `config.gin`, which `config_of_run` reads, whole or not at all."""
    with atomic_path(folder / "config.gin") as temporary:
        temporary.write_text(operative_config_text(config), encoding="utf-8")


def operative_config_text(config: ExperimentConfig) -> str:
    """Every field of a config as the text of a gin file, which `load_config` reads back equal."""
    return (
        "\n\n".join(
            "\n".join(
                f"{type(part).__name__}.{field.name} = {_literal(getattr(part, field.name))}"
                for field in _leaf_fields(part)
            )
            for part in _parts(config)
            if _leaf_fields(part)
        )
        + "\n"
    )


def run_cli(
    main: Callable[[Sequence[str]], int | None], argv: Sequence[str] | None = None
) -> NoReturn:
    """Run a script's `main(argv)` and exit with its status; what a user can cause ends in one line.

    ValueError, TypeError, OSError (a missing file), FloatingPointError (training) and RuntimeError (a frame's
    buffers) print `error: ...` on stderr and exit with 2, Ctrl-C exits with 130. `--traceback` or
    NIMPOSTOR_TRACEBACK=1 lets the error through instead.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        status = main(arguments)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except (ValueError, TypeError, OSError, FloatingPointError, RuntimeError) as error:
        if "--traceback" in arguments or os.environ.get(TRACEBACK_VARIABLE, "0") != "0":
            raise
        # These are seldom the user's doing: say how to see where they come from.
        hint = " (--traceback shows where)" if isinstance(error, TypeError | RuntimeError) else ""
        message = " ".join(str(error).split()) or type(error).__name__
        print(f"error: {message}{hint}", file=sys.stderr)
        sys.exit(2)
    sys.exit(status or 0)


class _NoLiteral(typing.NamedTuple):
    """Stands for gin's `@reference` or `%macro`, to be refused where its line is known."""

    name: str


class _LiteralsOnly(config_parser.ParserDelegate):
    """What gin's parser asks for what is no literal."""

    def configurable_reference(self, scoped_configurable_name: str, evaluate: bool) -> _NoLiteral:
        return _NoLiteral(f"@{scoped_configurable_name}")

    def macro(self, macro_name: str) -> _NoLiteral:
        return _NoLiteral(f"%{macro_name}")


def _bind_file(path: Path, places: dict[str, str], including: tuple[Path, ...]) -> None:
    if path.resolve() in [other.resolve() for other in including]:
        raise ValueError(f"{path} includes itself through {including[-1]}")
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        siblings = sorted(file.name for file in path.parent.glob("*.gin"))
        suggestion = _did_you_mean(difflib.get_close_matches(path.name, siblings, n=1))
        raise FileNotFoundError(f"gin file {path} does not exist{suggestion}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"gin file {path} cannot be read: {error}") from error
    _bind_text(text, path, places, (*including, path))


def _bind_text(
    text: str, path: Path | None, places: dict[str, str], including: tuple[Path, ...]
) -> None:
    """Check and bind each line; `places` learns where each `Class.field` was bound."""

    def place(line: int) -> str:
        return f"{path}:{line}" if path else f"binding {text.strip()!r}"

    empty = True
    line = 1
    try:
        for statement in config_parser.ConfigParser(text, _LiteralsOnly()):
            empty = False
            line = statement.location.line_num
            if isinstance(statement, config_parser.IncludeStatement):
                folder = path.parent if path else Path()
                _bind_file(folder / statement.filename, places, including)
            elif isinstance(statement, config_parser.ImportStatement):
                raise ValueError(f"{place(line)}: an import has no use here")
            else:
                _check_names(statement, place(line))
            if isinstance(statement, config_parser.BindingStatement):
                key = f"{statement.selector}.{statement.arg_name}"
                if isinstance(statement.value, _NoLiteral):
                    raise ValueError(
                        f"{place(line)}: {key} must be a literal, got {statement.value.name}"
                    )
                gin.bind_parameter(key, statement.value)
                places[key] = place(line)
    except (SyntaxError, tokenize.TokenError) as error:
        reason, location = error.args  # a SyntaxError's location starts with the file's name
        line = location[1] if isinstance(error, SyntaxError) else location[0]
        reason = reason.splitlines()[-1].strip(" .")
        raise ValueError(
            f"{place(line)}: cannot be read ({reason}); write Class.field = value, text in quotes"
        ) from None
    if empty and path is None:
        raise ValueError(f"{place(1)}: is empty; write Class.field = value")


def _check_names(statement: Any, place: str) -> None:
    """Refuse a scope, an unknown class and an unknown field."""
    owner, field = statement.selector, getattr(statement, "arg_name", None)
    key = f"{owner}.{field}" if field else owner
    if statement.scope:
        raise ValueError(f"{place}: the scope {statement.scope!r} has no use here; write {key}")
    if owner not in _FIELDS:
        raise ValueError(
            f"{place}: {key!r} names no class that can be bound{_suggest(key)}; "
            f"classes with fields: {', '.join(_FIELDS)}"
        )
    if field is not None and field not in _FIELDS[owner]:
        raise ValueError(
            f"{place}: {owner} has no field {field!r}{_suggest(key)}; "
            f"fields: {', '.join(_FIELDS[owner])}"
        )


def _suggest(key: str) -> str:
    """The binding most like `key` in spelling, and the one that has its field in another class."""
    known = [f"{owner}.{field}" for owner, fields in _FIELDS.items() for field in fields]
    field = key.rpartition(".")[2]
    same_field = [name for name in known if name.endswith(f".{field}")]
    matches = difflib.get_close_matches(key, known + list(_FIELDS), n=1)
    matches += difflib.get_close_matches(key, same_field, n=1, cutoff=0.0)
    return _did_you_mean(list(dict.fromkeys(matches)))


def _did_you_mean(matches: list[str]) -> str:
    return f" (did you mean {' or '.join(matches)}?)" if matches else ""


def _build(cls: Any, places: dict[str, str]) -> Any:
    """A config with its nested ones, each made by its own gin configurable, and checked."""
    nested = {
        field.name: _build(field.type, places)
        for field in dataclasses.fields(cls)
        if dataclasses.is_dataclass(field.type)
    }
    try:
        config = _CONFIGURABLES[cls.__name__](**nested)
        check_types(config)
    except (ValueError, TypeError, ArithmeticError) as error:
        raise ValueError(_explain(cls, error, places)) from None
    return config


def _explain(cls: Any, error: Exception, places: dict[str, str]) -> str:
    """One line for a refused value: the place of its binding and the field's rule."""
    message = str(error).splitlines()[0]  # gin adds lines about its wrappers
    if not isinstance(error, ValueError):
        message = _wrong_type(cls) or f"{cls.__name__}: {message}"
    bound = {key: place for key, place in places.items() if key.startswith(f"{cls.__name__}.")}
    # A rule between two fields may name the one that was not bound.
    place = bound.get(message.split()[0]) or ", ".join(dict.fromkeys(bound.values()))
    return f"{place}: {message}"


def _wrong_type(cls: Any) -> str | None:
    """What `check_types` says of the bound values, if any has the wrong type.

    Asked of an instance made without `__post_init__`, whose comparisons are what fails, without
    naming the field, where text stands for a number.
    """
    unchecked = object.__new__(cls)
    for name, value in gin.get_bindings(cls.__name__).items():
        object.__setattr__(unchecked, name, value)
    try:
        check_types(unchecked)
    except TypeError as error:
        return str(error)
    return None


def _parts(config: Any) -> Iterator[Any]:
    yield config
    for field in dataclasses.fields(config):
        if dataclasses.is_dataclass(field.type):
            yield from _parts(getattr(config, field.name))


def _literal(value: Any) -> str:
    # A NumPy scalar passes for a float, but gin cannot read its repr; inf has no literal in gin.
    if isinstance(value, float):
        return repr(float(value)).replace("inf", "1e999")
    return repr(value)


def _help_text() -> str:
    lines = ["fields that --gin_configs and --gin_bindings can set, with their defaults:"]
    for owner in _FIELDS:
        hints = typing.get_type_hints(_CLASSES[owner])
        lines.append("")
        for field in _leaf_fields(_CLASSES[owner]):
            hint = hints[field.name]
            options = typing.get_args(hint) if typing.get_origin(hint) is Literal else ()
            kind = " | ".join(map(repr, options)) or getattr(hint, "__name__", str(hint))
            lines.append(f"  {owner}.{field.name} = {_literal(field.default)}  ({kind})")
    return "\n".join(lines)
