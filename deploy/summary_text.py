"""The summary for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from deploy.run_file import IN_PROCESS
from services.robot_bridge.action_age import PARTS

_LABEL_WIDTH = 11


def summary_text(values: Mapping[str, Any]) -> str:
    """Return ``summary.json`` as a short table; ``?`` stands for what the record does not tell."""
    rows = [
        ("run", _run(values)),
        ("steps", _steps(values)),
        # In simulated time there are no overruns and no latencies to report.
        *(
            []
            if values["mode"] == IN_PROCESS
            else [("real time", _real_time(values)), ("answers", _answers(values)), ("latency", _age(values))]
        ),
        ("experience", _experience(values)),
        ("learning", _learning(values)),
        ("network", _network(values)),
        ("outages", _outages(values)),
        *[("failed", f"{failure['service']}: {failure['failure']}") for failure in values["service_failures"]],
        *[("note", note) for note in values["notes"]],
    ]
    return "\n".join(f"{label:<{_LABEL_WIDTH}}{text}" for label, text in rows if text)


def _known(value: Any, suffix: str = "") -> str:
    if value is None:
        return "?"
    return f"{value:.4g}{suffix}" if isinstance(value, float) else f"{value}{suffix}"


def _run(values: Mapping[str, Any]) -> str:
    facts = [_known(values[name]) for name in ("task", "algorithm", "mode")]
    facts += [f"network {_known(values['network'])}", f"seed {_known(values['seed'])}"]
    wall_s = values["wall_s"]
    return ", ".join([*facts, "? s" if wall_s is None else f"{wall_s:.0f} s"])


def _steps(values: Mapping[str, Any]) -> str:
    text = f"{_known(values['steps'])} ({_known(values['acted_steps'])} acted), {_known(values['episodes'])} episodes"
    if values["steps_per_goal_last_1000"] is not None:
        text += f", {_known(values['steps_per_goal_last_1000'])} steps per goal in the last 1000"
    return text


def _real_time(values: Mapping[str, Any]) -> str:
    return (
        f"{_known(values['cycles'])} cycles, {_known(values['overruns'])} overruns, of them after the first 1000 "
        f"cycles {_counted(values, 'overruns_after_1000')}, late actions {_counted(values, 'late_actions')}"
    )


def _counted(values: Mapping[str, Any], name: str) -> str:
    """A count and its share of the cycles."""
    count, cycles = values[name], values["cycles"]
    return f"{count} ({100 * count / cycles:.2f} %)" if count is not None and cycles else _known(count)


def _answers(values: Mapping[str, Any]) -> str:
    delays = values["observation_to_action_ms"]
    if delays is None:
        return "no action arrived"
    return f"{_known(delays['p50'], ' ms')} from observation to action (p50), {_known(delays['p99'], ' ms')} (p99)"


def _age(values: Mapping[str, Any]) -> str:
    medians = values["action_age_ms"]
    if medians is None:
        return ""
    parts = ", ".join(f"{name} {medians[name]:.2f}" for name in PARTS if name in medians)
    return f"{medians['age']:.2f} ms of age (p50): {parts}; uplink and downlink +- {medians['offset_bound']:.2f}"


def _experience(values: Mapping[str, Any]) -> str:
    counts = values["experience"]
    return ", ".join(f"{_known(counts[name])} {name}" for name in counts)


def _learning(values: Mapping[str, Any]) -> str:
    text = (
        f"{_known(values['updates'])} updates, {_known(values['policy_pushes'])} policy pushes, "
        f"policy version {_known(values['policy_version'])}"
    )
    if (rollouts := values["rollouts"]) is not None:
        text += f", {rollouts['complete']} rollouts, {_known(rollouts['dropped_transitions'])} transitions dropped"
    return text


def _network(values: Mapping[str, Any]) -> str:
    link = values["network_link"]
    if link is None:
        return ""
    directions = []
    for direction in ("uplink", "downlink"):
        counted = link[direction]
        kernel_bytes, ratio = counted["kernel_bytes"], counted["ratio"]
        seen = "not counted" if kernel_bytes is None else f"{kernel_bytes / 1e6:.2f} MB"
        if ratio is not None:
            seen += f" ({ratio:.3f} x the record's)"
        directions.append(f"{direction} {seen}")
    return f"{link['backend']}: {', '.join(directions)}"


def _outages(values: Mapping[str, Any]) -> str:
    outages = values["outages"]
    if not outages:
        return ""
    delays = [outage["first_action_s"] for outage in outages if outage["first_action_s"] is not None]
    slowest = f"; first action after at most {max(delays):.2f} s" if delays else ""
    return f"{len(outages)}{slowest}"
