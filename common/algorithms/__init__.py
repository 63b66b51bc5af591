"""Learning algorithms behind one interface (:mod:`common.algorithms.base`); importing this package needs no torch."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from common.algorithms.table import ALGORITHMS
from common.errors import ConfigError

if TYPE_CHECKING:
    from common.algorithms.base import Algorithm

__all__ = ["ALGORITHMS", "load_algorithm"]


def load_algorithm(name: str) -> type[Algorithm]:
    """Return an algorithm's class; imports torch.

    Raises:
        ConfigError: the name is not in :data:`ALGORITHMS`.
    """
    if name not in ALGORITHMS:
        raise ConfigError(f"unknown algorithm {name!r}; known: {', '.join(ALGORITHMS)}")
    module, _, attribute = ALGORITHMS[name].learner.partition(":")
    algorithm: type[Algorithm] = getattr(import_module(module), attribute)
    return algorithm
