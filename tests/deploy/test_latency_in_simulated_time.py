"""A delay appears in the waterfall where it was put, whatever the clocks of the two computers show."""

from __future__ import annotations

import logging

import pytest

from deploy.action_age import ActionAges
from tests.deploy.simulated_run import CAMERA_MS, INFERENCE_MS, simulate

SETTLED_S = 30.0


@pytest.fixture(scope="module")
def near(tmp_path_factory):
    """5 ms each way; the actor's clock is 3 s ahead and gains 50 ppm."""
    run_dir = tmp_path_factory.mktemp("near")
    hosts = simulate(run_dir, SETTLED_S, uplink_ms=5.0, downlink_ms=5.0)
    return ActionAges.read(run_dir), hosts


def medians(ages):
    return {name: values["p50"] for name, values in ages.quantiles_ms().items()}


def test_each_part_is_what_was_put_there(near):
    ages, _ = near
    assert len(ages.age) > 0.9 * SETTLED_S / 0.04
    assert (ages.unknown, ages.contradicted) == (0, 0)
    expected = {"camera": CAMERA_MS, "encode": 0, "uplink": 5, "queue": 0, "inference": INFERENCE_MS, "downlink": 5}
    assert medians(ages) == pytest.approx({**expected, "apply": 0, "age": 22}, abs=0.3)


def test_the_actor_finds_offset_and_drift(near):
    _, hosts = near
    now_ns = hosts.clock.now_ns()
    actor_ns = hosts.actor_clock.now_ns()
    offset_ns, bound_ns = hosts.actor_service.bridge_offset(actor_ns)
    assert offset_ns == pytest.approx(now_ns - actor_ns, abs=0.3e6)
    assert offset_ns == pytest.approx(-3e9 - 50e-6 * SETTLED_S * 1e9, abs=0.4e6)
    assert 0.3e6 < bound_ns < 6e6


def test_20_ms_more_each_way_appear_in_uplink_and_downlink_and_nowhere_else(near, tmp_path):
    simulate(tmp_path, SETTLED_S, uplink_ms=25.0, downlink_ms=25.0)
    near_ms, far_ms = medians(near[0]), medians(ActionAges.read(tmp_path))
    added = {name: far_ms[name] - near_ms[name] for name in near_ms}
    assert added.pop("uplink") == pytest.approx(20.0, abs=1.0)
    assert added.pop("downlink") == pytest.approx(20.0, abs=1.0)
    assert added.pop("age") == pytest.approx(40.0, abs=0.2)
    assert added == pytest.approx(dict.fromkeys(added, 0.0), abs=0.01)


def test_over_an_asymmetric_link_the_sum_is_right_and_the_bound_covers_each_way(tmp_path):
    simulate(tmp_path, SETTLED_S, uplink_ms=30.0, downlink_ms=10.0)
    ages = ActionAges.read(tmp_path)
    both = ages.parts["uplink"] + ages.parts["downlink"]
    assert both.min() >= 40.0 - 2.0 - 0.01
    assert both.max() <= 40.0 + 2.0 + 0.01
    wrong_ms = abs(ages.parts["uplink"] - 30.0)
    assert (wrong_ms <= ages.offset_bound + 1.0).all(), "and the way's own jitter"
    assert wrong_ms.mean() == pytest.approx(10.0, abs=1.0), "equal ways are what is assumed"


@pytest.mark.parametrize("jump_s", [-2.5, 2.5])
def test_a_jump_of_the_actor_s_clock_is_told_and_disturbs_nothing(near, tmp_path, caplog, jump_s):
    with caplog.at_level(logging.WARNING):
        hosts = simulate(tmp_path, SETTLED_S, 5.0, 5.0, events={15.0: lambda hosts: hosts.actor_clock.jump(jump_s)})
    (told,) = [record.getMessage() for record in caplog.records if "jumped" in record.getMessage()]
    assert f"{-jump_s:+.3f} s" in told
    # The actor's clock plays no part in the action cycle.
    undisturbed = near[1].bridge.counters()
    for name in ("overruns", "late_actions", "stops", "refused_actions", "unanswered"):
        assert hosts.bridge.counters()[name] == undisturbed[name], name
    ages = ActionAges.read(tmp_path)
    assert 0 < ages.contradicted < 25, "a second of actions, at most, until it is noticed"
    # What was on its way through the actor as its clock jumped shows the jump; it is one action at most.
    assert medians(ages) == pytest.approx(medians(near[0]), abs=0.3)


def test_a_jump_of_the_bridge_s_clock_stops_the_robot_until_an_action_comes(tmp_path):
    """As after a sleep: for the robot, nothing has been heard for all that time."""
    hosts = simulate(tmp_path, SETTLED_S, 5.0, 5.0, events={15.0: lambda hosts: hosts.bridge_clock.jump(2.5)})
    counters = hosts.bridge.counters()
    assert counters["stops"] == 1
    assert counters["overruns"] == 1
    assert counters["cycles"] > 0.9 * SETTLED_S / 0.04, "and it goes on"
    ages = ActionAges.read(tmp_path)
    assert ages.parts["uplink"][-100:] == pytest.approx(5.0, abs=2.0)
