"""The table of algorithms: read it and you know what there is to learn with. Without torch."""

from __future__ import annotations

from dataclasses import dataclass


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
"""Name -> where it is. A new algorithm is a file for each of the two columns, and one line here."""
