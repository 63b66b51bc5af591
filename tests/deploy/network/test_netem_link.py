from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from deploy.network import (
    PRESETS,
    Crossing,
    DirectionConditions,
    LinkUnavailable,
    NetemLink,
    NetworkConditions,
    Trace,
    open_link,
)
from deploy.network import netem_link as netem_module
from deploy.network.namespaces import namespace_name
from deploy.network.netem_link import join_commands, netem_options

_EVERY_KEY = DirectionConditions(
    delay_ms=40,
    jitter_ms=2,
    loss=0.05,
    rate_mbit=12,
    queue_packets=30,
    jitter_correlation=0.25,
    loss_burst_packets=4,
    loss_in_burst=0.9,
    loss_between_bursts=0.01,
)


@pytest.mark.parametrize(
    ("one_way", "options"),
    [
        (DirectionConditions(), "limit 100000"),
        (DirectionConditions(delay_ms=5), "limit 100000 delay 5ms"),
        # 1 packet of 1500 bytes per ms: 200 in the queue, 5 on their way, 1 being sent. 14 bytes are Ethernet's.
        (DirectionConditions(delay_ms=5, rate_mbit=12), "limit 206 delay 5ms rate 12mbit -14"),
        (DirectionConditions(loss=0.005), "limit 100000 loss random 0.5%"),
        # A rate, however high, keeps packets in order.
        (
            DirectionConditions(delay_ms=40, jitter_ms=2),
            "limit 100000 delay 40ms 2ms 0% distribution normal rate 100gbit",
        ),
        # Bursts are (0.05 - 0.01) / 0.89 = 4.4944 % of the packets; one begins with 0.25 x 0.044944 / 0.955056.
        (
            _EVERY_KEY,
            "limit 77 delay 40ms 2ms 25% distribution normal loss gemodel 1.17647% 25% 90% 1% rate 12mbit -14",
        ),
    ],
)
def test_conditions_become_the_options_of_netem(one_way: DirectionConditions, options: str) -> None:
    assert " ".join(netem_options(one_way)) == options


def test_the_mean_of_a_delay_that_netem_cuts_off_at_0_is_the_delay() -> None:
    # 0.9 + 0.1 of the standard deviation: see the formula of channel.centre at c = s.
    options = netem_options(DirectionConditions(delay_ms=10.83316, jitter_ms=10))
    assert options[options.index("delay") + 1 :][:2] == ["10ms", "10ms"]


def test_the_cable_has_the_conditions_of_each_direction_where_its_packets_leave() -> None:
    commands = [" ".join(command) for command in join_commands(NetworkConditions(DirectionConditions(delay_ms=5)))]
    local, remote = namespace_name("local"), namespace_name("remote")
    assert commands == [
        f"ip link add dev net0 address 02:00:0a:d5:4d:01 netns {local} type veth "
        f"peer name net0 address 02:00:0a:d5:4d:02 netns {remote}",
        f"ip -n {local} link set dev net0 gso_max_segs 1",
        f"tc -n {local} qdisc add dev net0 root netem limit 100000 delay 5ms",
        f"ip -n {remote} link set dev net0 gso_max_segs 1",
        f"tc -n {remote} qdisc add dev net0 root netem limit 100000",
    ]


@pytest.mark.parametrize(
    ("conditions", "reason"),
    [
        (PRESETS["outage"], "tc netem has no outages: choose the packet link"),
        (
            NetworkConditions(downlink=DirectionConditions(trace=Trace("t.csv", (0, 1), loss=(0, 1)))),
            "tc netem cannot follow a trace: choose the packet link",
        ),
    ],
)
def test_what_netem_cannot_do_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, conditions: NetworkConditions, reason: str
) -> None:
    monkeypatch.setattr(netem_module, "require_namespaces", lambda: None)
    monkeypatch.setattr(netem_module.shutil, "which", lambda name: f"/sbin/{name}")
    with pytest.raises(LinkUnavailable, match=reason):
        NetemLink(conditions, tmp_path).__enter__()


def test_a_machine_without_tc_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(netem_module, "require_namespaces", lambda: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(LinkUnavailable, match="needs the command 'tc': install iproute2"):
        NetemLink(NetworkConditions(), tmp_path).__enter__()


@pytest.mark.usefixtures("namespaces")
def test_the_kernel_takes_every_option_or_says_that_it_has_no_netem_and_nothing_is_left(tmp_path: Path) -> None:
    network_link = NetemLink(NetworkConditions(_EVERY_KEY, PRESETS["wifi_bad"].downlink), tmp_path)
    reason = ""
    try:
        with network_link:
            assert network_link.kernel_bytes() == {"uplink": 0, "downlink": 0}
        assert json.loads((tmp_path / "network.json").read_text(encoding="utf-8"))["kind"] == "netem"
    except LinkUnavailable as error:
        reason = str(error)
    # Where there is none, tc has understood all of it, or it would not have asked the kernel.
    assert not reason or re.search("no netem: load it with 'modprobe sch_netem'.*qdisc kind is unknown", reason)
    assert not (Path("/var/run/netns") / namespace_name("local")).exists()


def test_netem_is_opened_only_for_who_asks_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: NetemLink) -> NetemLink:
        raise LinkUnavailable("this kernel has no netem")

    monkeypatch.setattr(NetemLink, "__enter__", refuse)
    needs = [Crossing("local", "remote", 7447)]
    with (
        pytest.raises(LinkUnavailable, match="has no netem"),
        open_link(NetworkConditions(), needs=needs, run_dir=tmp_path, prefer="netem"),
    ):
        pass
    with open_link(NetworkConditions(), needs=needs, run_dir=tmp_path, prefer="relay") as network_link:
        assert not isinstance(network_link, NetemLink)


def test_the_record_counts_ip_packets_and_what_the_queue_did_not_deliver() -> None:
    queue = {"kind": "netem", "bytes": 5140, "packets": 10, "drops": 3, "backlog": 228, "qlen": 2}
    counts = netem_module._counts(queue, {"bytes": 4112, "packets": 8})
    assert (counts.packets_in, counts.bytes_in) == (15, 5140 + 228 - 12 * 14)
    assert (counts.packets_delivered, counts.bytes_delivered) == (8, 4000)
    assert counts.dropped["loss"] == 3
