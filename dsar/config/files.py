"""config.json: a run's settings, written and read."""

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

from dsar.config.migrations import rename_settings
from dsar.config.settings import EMBEDDED_CAPTURES, TrainConfig
from dsar.errors import ConfigError
from dsar.text import read_json

T = TypeVar("T")


def config_to_json(config: TrainConfig) -> str:
    """Return the settings as readable JSON."""
    return json.dumps(dataclasses.asdict(config), indent=2) + "\n"


def config_from_json(path: Path) -> TrainConfig:
    """Read a config.json, one of an earlier version too (`dsar.config.migrations`).

    Raises:
        ConfigError: it cannot be read, a setting is unknown, missing or of another kind, or settings
            contradict each other.
    """
    values = rename_settings(read_json(path, ConfigError))
    try:
        config = _from_values(TrainConfig, values, "")
        config.validate()
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}; it was changed, or is of another version") from error
    return config


def _from_values(kind: type[T], values: Any, prefix: str) -> T:
    """Return a dataclass of settings from JSON, in which each of them stands, and nothing else."""
    if not isinstance(values, dict):
        raise ConfigError(f"expected {prefix.rstrip('.') or 'the settings'} as an object, found {values!r}")
    hints = get_type_hints(kind)
    for what, names in (("unknown", values.keys() - hints), ("missing", hints.keys() - values)):
        if names:
            raise ConfigError(f"{what}: {', '.join(prefix + name for name in sorted(names))}")
    return kind(**{name: _from_value(hint, values[name], prefix + name) for name, hint in hints.items()})


def _from_value(hint: Any, value: Any, name: str) -> Any:
    """Return a setting's value of the type that it has."""
    if dataclasses.is_dataclass(hint):
        return _from_values(cast(type, hint), value, f"{name}.")
    parts = get_args(hint)
    if get_origin(hint) is Literal:
        fits = value in parts
    elif get_origin(hint) is tuple:
        fits = isinstance(value, list) and all(_is_of(item, parts[0]) for item in value)
    else:
        fits = any(_is_of(value, kind) for kind in parts or (hint,))
    if not fits:
        expected = " or ".join(map(repr, parts)) if get_origin(hint) is Literal else hint
        raise ConfigError(f"{name} is {value!r}, expected {getattr(expected, '__name__', expected)}")
    return tuple(value) if isinstance(value, list) else value


def _is_of(value: Any, kind: type) -> bool:
    """Return whether a JSON value is of a type; every integer is a number, too, and a truth value neither."""
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is kind


def with_absolute_paths(config: TrainConfig) -> TrainConfig:
    """Return settings that mean the same capture and body file in whatever folder they are read."""
    body = None if config.body is None else str(Path(config.body).resolve())
    return dataclasses.replace(config, capture=absolute_capture(config.capture), body=body)


def absolute_capture(capture: str) -> str:
    """Return the path of a capture as it is from any folder; an embedded one's name stays what it is."""
    return capture if capture in EMBEDDED_CAPTURES else str(Path(capture).resolve())
