"""Configuration: frozen dataclasses, filled from a TOML file and ``--set section.key=value``.

A configuration class is a dataclass of sections; a section is a dataclass of settings declared with
:func:`setting`. Everything is checked when it is loaded: an unknown key, a wrong type or a value out of range is a
:class:`~common.errors.ConfigError` that names the key, the value and what was expected.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, field, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from common.errors import ConfigError

Config = TypeVar("Config")
Tables = dict[str, dict[str, Any]]
_NUMBERS = re.compile(r"[-+.,\[\]\s\d_eE]+")
"""A number or a list of them, and nothing that is text."""
_LEADING_POINT = re.compile(r"(?<![.\w])\.(?=\d)")
_LARGEST_WHOLE = 2**63 - 1
"""Larger ones fit neither messages nor arrays."""


def setting(
    default: Any = MISSING,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: Iterable[str] = (),
    rest: bool = False,
) -> Any:
    """Declare a setting with inclusive bounds or allowed values; ``rest`` collects a section's other keys."""
    metadata = {"low": low, "high": high, "choices": tuple(choices), "rest": rest}
    if rest:
        return field(default_factory=dict, metadata=metadata)
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def load_config(cls: type[Config], path: Path, overrides: Iterable[str] = ()) -> Config:
    """Read ``path``, apply ``section.key=value`` overrides, check everything, return the configuration."""
    tables = read_toml(path)
    for override in overrides:
        section, key, value = parse_override(override)
        if section not in section_names(cls):
            raise ConfigError(f"--set {override}: no section [{section}]{_hint(section, section_names(cls))}")
        table = tables.setdefault(section, {})
        if isinstance(table, dict):  # What else may stand there is refused below.
            table[key] = value
    return build_config(cls, tables, str(path))


def read_toml(path: Path) -> Tables:
    """Return the tables of a TOML file."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"{path}: not a TOML file: {error}") from error


def parse_override(override: str) -> tuple[str, str, Any]:
    """Split ``section.key=value``; the value is TOML (``3``, ``true``, ``"text"``), or a bare word as text.

    Unlike in TOML, numbers may begin with their point: ``.5``, ``[-.25, .17]``.
    """
    name, equals, text = override.partition("=")
    section, dot, key = name.strip().partition(".")
    if not (equals and dot and section and key):
        raise ConfigError(f"--set {override!r}: expected section.key=value, for example task.preset=thesis")
    toml = _LEADING_POINT.sub("0.", text) if _NUMBERS.fullmatch(text) else text
    try:
        return section, key, tomllib.loads(f"value = {toml}")["value"]
    except ValueError:
        return section, key, text.strip()


def section_names(cls: type) -> list[str]:
    """Sections of a configuration class, in order."""
    return [f.name for f in fields(cls)]


def build_config(cls: type[Config], tables: Mapping[str, Any], where: str) -> Config:
    """Check ``tables`` against the configuration class and return it."""
    hints = get_type_hints(cls)
    for name in tables:
        if name not in hints:
            raise ConfigError(f"{where}: unknown section [{name}]{_hint(name, list(hints))}")
    sections = {
        name: build_section(section, tables.get(name, {}), f"{where}: [{name}]") for name, section in hints.items()
    }
    return cls(**sections)


def to_tables(config: Any) -> Tables:
    """Return a configuration as TOML tables, the opposite of :func:`build_config`."""
    tables: Tables = {}
    for section in fields(config):
        values = getattr(config, section.name)
        table: dict[str, Any] = {}
        for item in fields(values):
            value = getattr(values, item.name)
            if item.metadata.get("rest"):
                table.update(value)
            else:
                table[item.name] = value
        tables[section.name] = table
    return tables


def build_section(cls: type[Config], values: Any, where: str) -> Config:
    """Check one table against its section's class and return the section."""
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where}: expected a table, got {values!r}")
    assert is_dataclass(cls)
    hints = get_type_hints(cls)
    declared = {f.name: f for f in fields(cls)}
    rest = next((f.name for f in fields(cls) if f.metadata.get("rest")), None)
    arguments: dict[str, Any] = {rest: {}} if rest else {}
    for key, value in values.items():
        if key in declared and key != rest:
            arguments[key] = _checked(hints[key], value, declared[key], f"{where} {key}")
        elif rest:
            arguments[rest][key] = value
        else:
            raise ConfigError(f"{where}: unknown key {key!r}{_hint(key, list(declared))}")
    for name, item in declared.items():
        required = item.default is MISSING and item.default_factory is MISSING
        if required and name not in arguments:
            raise ConfigError(f"{where}: {name} is missing; expected {_type_name(hints[name])}")
    try:
        return cls(**arguments)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error


def _checked(hint: Any, value: Any, item: dataclasses.Field[Any], where: str) -> Any:
    kind = get_origin(hint) or hint
    if isinstance(value, int) and abs(value) > _LARGEST_WHOLE:
        raise ConfigError(f"{where} = {value}: expected a number of at most 64 bits")
    if kind is float:
        value = _as_float(value)
    wrong_bool = isinstance(value, bool) and kind is not bool
    if not isinstance(value, kind) or wrong_bool:
        raise ConfigError(f"{where} = {value!r}: expected {_type_name(hint)}")
    if kind is list:
        element = get_args(hint)[0]
        elements = [_as_float(v) for v in value] if element is float else list(value)
        if not all(isinstance(v, element) for v in elements):
            raise ConfigError(f"{where} = {value!r}: expected {_type_name(hint)}")
        return elements
    metadata = item.metadata
    if metadata.get("choices") and value not in metadata["choices"]:
        expected = ", ".join(metadata["choices"])
        raise ConfigError(f"{where} = {value!r}: expected one of {expected}{_suggestion(value, metadata['choices'])}")
    low, high = metadata.get("low"), metadata.get("high")
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{where} = {value!r}: expected a finite number")
    if (low is not None and value < low) or (high is not None and value > high):
        raise ConfigError(f"{where} = {value!r}: expected {_range(low, high)}")
    return value


def _as_float(value: Any) -> Any:
    """A whole number as the number that is wanted; anything else as it is."""
    whole = isinstance(value, int) and not isinstance(value, bool)
    return float(value) if whole and abs(value) <= _LARGEST_WHOLE else value


def _range(low: float | None, high: float | None) -> str:
    if high is None:
        return f"at least {low}"
    if low is None:
        return f"at most {high}"
    return f"a value from {low} to {high}"


def _type_name(hint: Any) -> str:
    names = {
        str: "text",
        int: "a whole number",
        float: "a number",
        bool: "true or false",
        list[str]: "a list of texts",
        list[float]: "a list of numbers",
    }
    return names.get(hint, str(hint))


def _hint(name: Any, known: Iterable[str]) -> str:
    known = list(known)
    return _suggestion(name, known) or f"; known: {', '.join(known)}"


def _suggestion(name: Any, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(str(name), list(known), 1)
    return f"; did you mean {close[0]!r}?" if close else ""
