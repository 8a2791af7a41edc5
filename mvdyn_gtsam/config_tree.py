"""Building a tree of frozen dataclasses from plain values, strictly, whatever the values mean."""

from __future__ import annotations

import ast
import dataclasses
import difflib
import enum
import inspect
import json
import math
import textwrap
import tomllib
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from mvdyn_gtsam.errors import ConfigError

Section = TypeVar("Section")


@dataclass(frozen=True)
class ConfigKey:
    """One configurable value."""

    key: str
    """Dotted path, e.g. ``tracking.window``."""
    default: Any
    """Plain value, as in a TOML file."""
    doc: str
    """Help text with the source of the default."""


def build(kind: type[Section], values: Mapping[str, Any]) -> Section:
    """An instance of the dataclass ``kind`` with its defaults changed by nested ``values``.

    Raises ConfigError for a key that ``kind`` does not have and for a value of another type.
    """
    return _instance(kind, check(kind, values))


def check(kind: type[Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Nested ``values`` in the types of the dataclass ``kind``. Raises ConfigError as ``build`` does, but not
    for values out of range, which may depend on one another."""
    taken, refused = sift(kind, values)
    if refused:
        raise ConfigError(next(iter(refused.values())))
    return taken


def sift(
    kind: type[Any], values: Mapping[str, Any], prefix: str = ""
) -> tuple[dict[str, Any], dict[str, str]]:
    """Those of nested ``values`` that the dataclass ``kind`` takes, in its types; for the others, by dotted
    key, why it does not."""
    hints = typing.get_type_hints(kind)
    names = {item.name for item in dataclasses.fields(kind)}
    taken: dict[str, Any] = {}
    refused: dict[str, str] = {}
    for name, value in values.items():
        key = f"{prefix}{name}"
        if name not in names:
            refused[key] = unknown_key(key, kind, prefix)
        elif not dataclasses.is_dataclass(hints[name]):
            try:
                taken[name] = convert(value, hints[name], key)
            except ConfigError as error:
                refused[key] = str(error)
        elif isinstance(value, Mapping):
            taken[name], below = sift(typing.cast(type[Any], hints[name]), value, f"{key}.")
            refused.update(below)
        else:
            example = _first_key(hints[name], key)
            refused[key] = f"{key} is a section, not a value; set a key of it, e.g. {example}"
    return taken, refused


def _instance(kind: type[Section], taken: Mapping[str, Any]) -> Section:
    hints = typing.get_type_hints(kind)
    sections = {name for name in taken if dataclasses.is_dataclass(hints[name])}
    return kind(
        **{
            name: _instance(hints[name], value) if name in sections else value
            for name, value in taken.items()
        }
    )


def unknown_key(key: str, kind: type[Any], prefix: str) -> str:
    """Message about ``key``, suggesting the closest key below ``kind`` (whose keys start with ``prefix``)."""
    keys = [f"{prefix}{item}" for item in _key_paths(kind)]
    close = difflib.get_close_matches(key, keys, n=1, cutoff=0.6)
    if not close:  # the right name in the wrong section, or without one
        leaf = key.rsplit(".", 1)[-1]
        close = [item for item in keys if item.rsplit(".", 1)[-1] == leaf][:1]
    return f"unknown key {key}" + (f" (did you mean {close[0]}?)" if close else "")


def convert(value: Any, hint: Any, key: str) -> Any:
    """``value`` as the annotated type ``hint``: bool, int, float, str, Path, Enum, Optional, tuple, Literal.

    An int is accepted where a float is asked for; nothing else is converted silently.
    """
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        return _convert_optional(value, hint, key)
    if origin is tuple:
        return _convert_tuple(value, hint, key)
    if origin is typing.Literal:
        choices = typing.get_args(hint)
        if not isinstance(value, str) or value not in choices:
            raise ConfigError(f"{key} is {value!r}; it must be one of {', '.join(map(str, choices))}")
        return value
    if inspect.isclass(hint) and issubclass(hint, enum.Enum):
        try:
            return hint(value)
        except ValueError as error:
            members = ", ".join(str(member.value) for member in hint)
            raise ConfigError(f"{key} is {value!r}; it must be one of {members}") from error
    return _convert_scalar(value, hint, key)


def _convert_scalar(value: Any, hint: Any, key: str) -> Any:
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        if not math.isfinite(value):
            raise ConfigError(f"{key} is {value}; it must be finite")
        return float(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    if hint in (bool, int, str) and type(value) is hint:
        return value
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "a string", Path: "a path"}
    if hint not in names:
        raise TypeError(f"{key}: the configuration cannot hold values of type {hint}")
    raise ConfigError(f"{key} is {value!r}; it must be {names[hint]}")


def _convert_optional(value: Any, hint: Any, key: str) -> Any:
    inner = [kind for kind in typing.get_args(hint) if kind is not type(None)]
    if len(inner) != 1:
        raise TypeError(f"{key}: the configuration cannot hold values of type {hint}")
    # TOML has no null: the empty string stands for it.
    return None if value is None or value == "" else convert(value, inner[0], key)


def _convert_tuple(value: Any, hint: Any, key: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise ConfigError(f"{key} is {value!r}; it must be a list, e.g. [1, 2]")
    kinds = typing.get_args(hint)
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    if len(kinds) != len(value):
        raise ConfigError(f"{key} is {list(value)}; it must hold {len(kinds)} values")
    return tuple(
        convert(item, kind, f"{key}[{i}]") for i, (item, kind) in enumerate(zip(value, kinds, strict=True))
    )


def parse_override(kind: type[Any], override: str, values: dict[str, Any]) -> None:
    """Put ``"a.b=value"`` into nested ``values``. Raises ConfigError for a wrong form or an unknown key."""
    key, separator, text = override.partition("=")
    names = key.strip().split(".")
    if not separator or not all(names):
        raise ConfigError(f"--set {override}: write it as section.key=value, e.g. tracking.window=25")
    if ".".join(names) not in _key_paths(kind):
        raise ConfigError(
            f"--set {override}: {unknown_key('.'.join(names), kind, '')}; `mvdyn config` lists every key"
        )
    table = values
    for name in names[:-1]:
        table = table.setdefault(name, {})
    table[names[-1]] = _parse_value(text.strip())


def _parse_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text  # an unquoted string; convert() refuses it where another type is asked for


def read_file(path: Path) -> dict[str, Any]:
    """Nested values of a TOML file, or of a JSON file where the name ends so."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not text"
        raise ConfigError(f"{path}: cannot be read ({reason})") from error
    try:
        values = json.loads(text) if path.suffix.lower() == ".json" else tomllib.loads(text)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: must hold sections, e.g. a [tracking] table")
    return values


def to_plain(value: Any) -> Any:
    """``value`` as dicts, lists, numbers, strings and booleans; None as the empty string, as TOML needs."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: to_plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {name: to_plain(item) for name, item in value.items()}
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return "" if value is None else value


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested ``values`` by dotted key."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f"{prefix}{name}."))
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def nest(flat: Mapping[str, Any]) -> dict[str, Any]:
    """The inverse of ``flatten``."""
    values: dict[str, Any] = {}
    for key, value in flat.items():
        *sections, name = key.split(".")
        table = values
        for section in sections:
            table = table.setdefault(section, {})
        table[name] = value
    return values


def describe_tree(section: Any, prefix: str = "") -> list[ConfigKey]:
    """Every key below the dataclass instance ``section``, with the docstring below its field."""
    docs = _field_docs(type(section))
    keys: list[ConfigKey] = []
    for item in dataclasses.fields(section):
        value = getattr(section, item.name)
        if dataclasses.is_dataclass(value):
            keys += describe_tree(value, f"{prefix}{item.name}.")
        else:
            keys.append(ConfigKey(f"{prefix}{item.name}", to_plain(value), docs.get(item.name, "")))
    return keys


def _field_docs(kind: type[Any]) -> dict[str, str]:
    """Docstrings below the fields of a dataclass, which Python itself does not keep."""
    body = typing.cast(ast.ClassDef, ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]).body
    docs: dict[str, str] = {}
    for statement, following in zip(body, body[1:], strict=False):
        if (
            isinstance(statement, ast.AnnAssign)
            and isinstance(statement.target, ast.Name)
            and isinstance(following, ast.Expr)
            and isinstance(following.value, ast.Constant)
            and isinstance(following.value.value, str)
        ):
            docs[statement.target.id] = " ".join(following.value.value.split())
    return docs


def _key_paths(kind: type[Any]) -> list[str]:
    hints = typing.get_type_hints(kind)
    paths: list[str] = []
    for item in dataclasses.fields(kind):
        hint = hints[item.name]
        if dataclasses.is_dataclass(hint):
            paths += [f"{item.name}.{path}" for path in _key_paths(typing.cast(type[Any], hint))]
        else:
            paths.append(item.name)
    return paths


def _first_key(hint: Any, key: str) -> str:
    paths = _key_paths(hint)
    return f"{key}.{paths[0]}" if paths else f"{key} (it has no keys yet)"
