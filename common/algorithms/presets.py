"""The settings of an algorithm by the name of their preset, and what is changed in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from importlib import import_module
from typing import Any

from common.algorithms.config import AlgorithmConfig
from common.algorithms.table import ALGORITHMS
from common.errors import ConfigError


def presets_of(algorithm: str) -> Mapping[str, AlgorithmConfig]:
    """Return an algorithm's presets, name -> settings.

    Raises:
        ConfigError: there is no such algorithm.
    """
    if algorithm not in ALGORITHMS:
        raise ConfigError(f"unknown algorithm {algorithm!r}; known: {', '.join(ALGORITHMS)}")
    module, _, attribute = ALGORITHMS[algorithm].presets.partition(":")
    presets: Mapping[str, AlgorithmConfig] = getattr(import_module(module), attribute)
    return presets


def resolve_config(algorithm: str, preset: str, overrides: Mapping[str, object]) -> AlgorithmConfig:
    """Return a preset with some of its settings replaced.

    Args:
        algorithm: a key of :data:`ALGORITHMS`.
        preset: a key of the algorithm's presets.
        overrides: setting -> value; a list stands for a tuple, an integer for a float.

    Raises:
        ConfigError: a name is unknown or a value is not what the setting accepts.
    """
    presets = presets_of(algorithm)
    if preset not in presets:
        raise ConfigError(f"unknown preset {preset!r} of {algorithm}; known: {', '.join(presets)}")
    base = presets[preset]
    known = {field.name: str(field.type) for field in fields(base)}
    values: dict[str, Any] = {}
    for name, value in overrides.items():
        if name not in known:
            raise ConfigError(f"{algorithm}: unknown setting {name!r}; known: {', '.join(known)}")
        values[name] = _converted(name, known[name], value)
    return replace(base, **values)


def setting_names(algorithm: str) -> frozenset[str]:
    """Return what can be set of an algorithm."""
    return frozenset(field.name for preset in presets_of(algorithm).values() for field in fields(preset))


def _converted(name: str, annotation: str, value: object) -> object:
    """Return ``value`` as the type a field is annotated with; bool never counts as a number."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    integer = isinstance(value, int) and number
    match annotation:
        case "int" if integer:
            return value
        case "bool" if isinstance(value, bool):
            return value
        case "float" | "float | None" if number:
            return float(value)  # type: ignore[arg-type]  # number says so
        case "float | None" if value is None:
            return None
        case "str" if isinstance(value, str):
            return value
        case _ if annotation.startswith("tuple") and isinstance(value, list | tuple):
            element = "int" if "int" in annotation else "float"
            return tuple(_converted(f"{name}[{i}]", element, item) for i, item in enumerate(value))
    raise ConfigError(f"{name} = {value!r}: expected {annotation}")
