"""Whether virtual runs may stand for real ones, from their summaries."""

from __future__ import annotations

import json

import pytest

from experiments.virtual_against_real import compare, main


@pytest.fixture
def make(tmp_path):
    """Write a run's summary; return its folder."""

    def make(name, p50, episodes, **changes):
        values = {
            **{"task": "dot_reacher", "algorithm": "sac", "mode": "remote_only", "network": "wifi_office"},
            **{"steps": 1000, "cycles": 1000, "late_actions": 10, "episodes": episodes},
            "observation_to_action_ms": {"p50": p50, "p99": 2 * p50},
            **changes,
        }
        (tmp_path / name).mkdir()
        (tmp_path / name / "summary.json").write_text(json.dumps(values))
        return tmp_path / name

    return make


def test_latency_is_compared_by_medians_and_learning_by_intervals(make):
    real = [make("r0", 10.0, 100), make("r1", 12.0, 50), make("r2", 11.0, 80)]
    virtual = [make("v0", 10.0, 90), make("v1", 9.9, 60)]
    comparison = compare(real, virtual)
    assert comparison.latency_difference == pytest.approx(9.95 / 11 - 1)
    # 10, 20 and 12.5 steps per goal: 14.17 ± 4.303 * 5.204 / sqrt(3).
    assert comparison.real.steps_per_goal.mean == pytest.approx(42.5 / 3)
    assert comparison.real.steps_per_goal.half == pytest.approx(12.93, abs=0.01)
    assert comparison.learning_overlaps
    assert comparison.agrees
    assert "-9.5 %" in str(comparison)


def test_too_fast_answers_or_other_learning_disagree(make):
    real = [make("r0", 10.0, 100), make("r1", 10.0, 101)]
    fast = [make("f0", 8.4, 100), make("f1", 8.4, 101)]
    learning = [make("l0", 10.0, 50), make("l1", 10.0, 51)]
    assert not compare(real, fast).agrees
    assert compare(real, fast).learning_overlaps
    assert not compare(real, learning).agrees
    assert compare(real, real).agrees
    command = ["--real", *map(str, real), "--virtual"]
    assert (main([*command, *map(str, real)]), main([*command, *map(str, fast)])) == (0, 1)


def test_what_cannot_be_compared_is_refused_with_the_reason(make, tmp_path, capsys):
    run, other = make("r0", 10.0, 100), make("r1", 10.0, 100)
    for virtual, reason in (
        ([run, make("x", 10.0, 100, network="wifi_bad")], "expected 'wifi_office'"),
        ([run, make("y", 10.0, 0)], "episodes = 0"),
        ([run, tmp_path / "none"], "finished run"),
        ([run], "at least two"),
    ):
        assert main(["--real", str(run), str(other), "--virtual", *map(str, virtual)]) == 1
        assert reason in capsys.readouterr().err
