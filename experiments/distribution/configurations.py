"""What is compared, a line each: which algorithm learns, what runs where, and over which network.

No run measures the computer it runs on. What a host's file does not say is set here: the inference time of an actor
that is not on the learner's computer, and the duration of PPO's updates.
"""

from __future__ import annotations

from dataclasses import dataclass

from experiments.distribution.bars import AtMost, Bar, ClearlyAbove, Equivalent

LAPTOP_ACTOR = ("actor.min_inference_s=0.003",)
"""As the laptop's host file has it: in remote_local the laptop computes the actions (thesis 4.4)."""

_PPO_UPDATE_S = 0.55
"""From a rollout of Dot-Reacher, the preset's 2048 steps, measured on one Zen 4 core, which is the workstation here."""
PPO_ON_WORKSTATION = (f"learner.min_update_s={_PPO_UPDATE_S}",)
PPO_ON_LAPTOP = (f"learner.min_update_s={3 * _PPO_UPDATE_S:.2f}",)
"""Slower by as much as the host files say of SAC's updates."""

PENDING = ("algorithm.pending_actions=3",)
"""Of the answers over wifi_bad 86 % take more than one cycle, 18 % more than two, 4 % more than three and 1 % more than
four (one run, 3000 steps of Dot-Reacher): nearly all that is on its way was chosen on the last three observations."""


@dataclass(frozen=True)
class Configuration:
    """A distribution of one algorithm over hosts."""

    name: str
    """Also the folders'."""
    algorithm: str
    mode: str
    network: str | None
    """Between the hosts; None: there is one host."""
    host: str
    """The learner's, a name of ``deploy/hosts/``."""
    overrides: tuple[str, ...] = ()
    """``section.key=value``"""


SAC = (
    Configuration("sac_workstation", "sac", "local_only", None, "workstation"),
    Configuration("sac_laptop", "sac", "local_only", None, "laptop"),
    Configuration("sac_jetson", "sac", "local_only", None, "jetson"),
    Configuration("sac_remote_only_office", "sac", "remote_only", "wifi_office", "workstation"),
    Configuration("sac_remote_only_bad", "sac", "remote_only", "wifi_bad", "workstation"),
    Configuration("sac_remote_local_office", "sac", "remote_local", "wifi_office", "workstation", LAPTOP_ACTOR),
    Configuration("sac_remote_local_bad", "sac", "remote_local", "wifi_bad", "workstation", LAPTOP_ACTOR),
)
SAC_PENDING = (
    Configuration("sac_workstation_pending", "sac", "local_only", None, "workstation", PENDING),
    Configuration("sac_remote_only_office_pending", "sac", "remote_only", "wifi_office", "workstation", PENDING),
    Configuration("sac_remote_only_bad_pending", "sac", "remote_only", "wifi_bad", "workstation", PENDING),
)
"""The ablation: is Remote-Only hurt by delay, or by what that hides from the policy? On the workstation nothing is
hidden, so there it shows what more inputs and learning from chosen actions change by themselves."""
PPO = (
    Configuration("ppo_laptop", "ppo", "local_only", None, "laptop", PPO_ON_LAPTOP),
    Configuration("ppo_remote_only_office", "ppo", "remote_only", "wifi_office", "workstation", PPO_ON_WORKSTATION),
    Configuration(
        "ppo_remote_local_office",
        "ppo",
        "remote_local",
        "wifi_office",
        "workstation",
        (*LAPTOP_ACTOR, *PPO_ON_WORKSTATION),
    ),
)


@dataclass(frozen=True)
class Question:
    """Two configurations of which the thesis says something."""

    configuration: str
    against: str
    finding: str
    """What the thesis found, and where."""
    bar: Bar | None = None
    """What is expected here of the means; None: nothing in numbers."""


_WORST = "SAC hardly learns on the emulated Jetson (Fig. 5.1)"
_PPO = "PPO is nearly the same in all modes (Fig. 5.3)"
_HIDDEN = "not in the thesis: is it what the delay hides from the policy?"
_CONTROL = "not in the thesis: what pending actions change where nothing is hidden"

QUESTIONS = (
    Question("sac_laptop", "sac_workstation", "SAC is worse on the laptop than on the workstation (Fig. 5.1)"),
    *(Question("sac_jetson", other.name, _WORST, ClearlyAbove()) for other in SAC if other.name != "sac_jetson"),
    Question(
        "sac_remote_local_office",
        "sac_workstation",
        "Remote-Local comes within 10 % of the best (Fig. 5.1, 5.2)",
        AtMost(1.11),
    ),
    Question("sac_remote_local_bad", "sac_workstation", "the same over a bad link (not in the thesis)", AtMost(1.11)),
    Question("sac_remote_only_office", "sac_laptop", "Remote-Only barely improves on the laptop alone (Fig. 5.1)"),
    Question(
        "sac_remote_only_office", "sac_remote_local_office", "Remote-Only is worse than Remote-Local (Fig. 5.1, 5.2)"
    ),
    Question(
        "sac_remote_only_bad",
        "sac_remote_local_bad",
        "the same over a bad link (not in the thesis)",
        ClearlyAbove(),
    ),
    Question("sac_remote_only_bad", "sac_workstation", "not in the thesis: what the delay costs, all else equal"),
    Question("sac_remote_only_bad_pending", "sac_remote_only_bad", _HIDDEN),
    Question("sac_remote_only_office_pending", "sac_remote_only_office", _HIDDEN),
    Question("sac_workstation_pending", "sac_workstation", _CONTROL),
    Question("sac_remote_only_bad_pending", "sac_workstation_pending", "not in the thesis: what delay alone costs"),
    Question("ppo_remote_only_office", "ppo_laptop", _PPO, Equivalent(0.15)),
    Question("ppo_remote_local_office", "ppo_laptop", _PPO, Equivalent(0.15)),
    Question("ppo_remote_only_office", "ppo_remote_local_office", _PPO, Equivalent(0.15)),
)
