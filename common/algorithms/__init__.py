"""Learning algorithms behind one interface (:mod:`common.algorithms.base`); importing this package needs no torch."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

from common.errors import ConfigError

if TYPE_CHECKING:
    from common.algorithms.base import Algorithm


@dataclass(frozen=True)
class AlgorithmRow:
    """One row of the table."""

    learner: str
    """``module:class`` of the :class:`Algorithm`; needs torch."""
    presets: str
    """``module:name`` of its settings by preset; without torch, because actor and replay read them too. Whether they
    are :class:`OffPolicyConfig` or :class:`OnPolicyConfig` decides which store replay keeps."""


ALGORITHMS = {
    "sac": AlgorithmRow("common.algorithms.sac:SAC", "common.algorithms.sac_config:SAC_PRESETS"),
    "ppo": AlgorithmRow("common.algorithms.ppo:PPO", "common.algorithms.ppo_config:PPO_PRESETS"),
}
"""The table of algorithms. A new one is a file for each of the first two columns, and one line here."""


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
