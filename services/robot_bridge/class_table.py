"""Tables whose values are ``module:Class``: what is in them is imported when it is chosen, and not before."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, TypeVar

from common.errors import ConfigError

Base = TypeVar("Base")


def extended(table: Mapping[str, str], rows: Mapping[str, Any] | None, section: str) -> dict[str, Any]:
    """Return ``table`` with the rows that the configuration adds to it in ``[sections]``.

    Raises:
        ConfigError: a row's name is taken.
    """
    for name in sorted(rows or {}):
        if name in table:
            raise ConfigError(f"[{section}s] {name}: this name is taken, by {table[name]}; choose another one")
    return {**table, **(rows or {})}


def load_class(base: type[Base], name: str, table: Mapping[str, Any], section: str) -> type[Base]:
    """Return the class in row ``name`` of ``table``.

    Args:
        base: what it has to be a subclass of.
        name: what was chosen, ``[section] name`` in the configuration.
        table: name -> ``module:Class``.
        section: of the configuration.

    Raises:
        ConfigError: there is no such row, or it leads to no such class.
    """
    if name not in table:
        raise ConfigError(f"[{section}] name = {name!r}: expected one of {', '.join(sorted(table))}")
    row = f"[{section}s] {name} = {table[name]!r}"
    module_name, _, class_name = str(table[name]).partition(":")
    try:
        found = getattr(importlib.import_module(module_name), class_name)
    except ModuleNotFoundError as error:
        hint = "; the folder that it is in has to be on PYTHONPATH" if error.name == module_name else ""
        raise ConfigError(f"{row}: expected module:Class that imports: {error}{hint}") from error
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"{row}: expected module:Class that imports: {error}") from error
    if not (isinstance(found, type) and issubclass(found, base)):
        raise ConfigError(f"{row}: expected a subclass of {base.__name__}")
    return found
