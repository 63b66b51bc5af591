"""Two network namespaces joined by a cable whose ends are the kernel's own emulator, ``tc netem``.

It costs no process and carries gigabits, and is less exact than the packet link: its chances cannot be seeded; its
correlation of delays is that of its random numbers, of which the kernel keeps what a division leaves; its queue is
counted in packets; and the kernel counts what leaves the emulator, not what enters it. It has neither outages nor
traces.
"""

from __future__ import annotations

import json
import math
import shutil
import time
from pathlib import Path
from typing import Any, Self

from common.record import write_atomically
from deploy.network.channel import centre
from deploy.network.conditions import DIRECTIONS, HOSTS, DirectionConditions, Host, NetworkConditions, burst_share
from deploy.network.errors import LinkUnavailable
from deploy.network.namespaces import (
    DEVICE,
    MTU_BYTES,
    NamespaceHosts,
    device_statistics,
    namespace_name,
    require_namespaces,
    run_command,
)
from deploy.network.part import DeviceBytes, DirectionCounts, NetworkPart

_ETHERNET_BYTES = 14
"""What a cable's packets have and the table's do not: the header."""
_HARDWARE_ADDRESS: dict[Host, str] = {"local": "02:00:0a:d5:4d:01", "remote": "02:00:0a:d5:4d:02"}
_UNLIMITED = "100gbit"
"""Netem keeps packets in order only where it has a rate."""
_MAX_PACKETS = 100_000
"""Room for what is on its way, where no queue bounds it."""


class NetemLink(NamespaceHosts):
    """The hosts are joined by a pair of virtual cards, each with a queue ``netem`` where packets leave."""

    def __init__(self, conditions: NetworkConditions, run_dir: Path) -> None:
        super().__init__(conditions)
        self._part_path = run_dir / "network.json"
        self._start_monotonic_ns = 0
        self._final_part: NetworkPart | None = None

    def __enter__(self) -> Self:
        require_netem(self._conditions)
        return super().__enter__()

    def part(self) -> NetworkPart:
        return self._final_part if self._final_part is not None else self._read_part()

    def failure(self) -> str | None:
        return None

    def over(self) -> str | None:
        return None

    def _join(self) -> None:
        for command in join_commands(self._conditions):
            try:
                run_command(*command)
            except LinkUnavailable as error:
                if "qdisc kind is unknown" not in str(error):
                    raise
                raise LinkUnavailable(
                    "this kernel has no netem: load it with 'modprobe sch_netem', install your kernel's extra modules, "
                    f"or choose the packet link (namespaces) [{error}]"
                ) from error
        for host in HOSTS:
            self._set_up(host)
            # Nobody has to ask who has an address, so that no answer can be lost.
            other: Host = "remote" if host == "local" else "local"
            neighbour = (self.addresses[other], "lladdr", _HARDWARE_ADDRESS[other], "dev", DEVICE, "nud", "permanent")
            run_command("ip", "-n", namespace_name(host), "neigh", "add", *neighbour)
        self._start_monotonic_ns = time.monotonic_ns()
        self._part_path.parent.mkdir(parents=True, exist_ok=True)

    def _stop(self) -> None:
        if self._start_monotonic_ns and self._final_part is None:
            self._final_part = self._read_part()
            write_atomically(self._part_path, self._final_part.to_json())

    def _sent_bytes(self, host: Host) -> int:
        return _ip_bytes(device_statistics(host)["tx"])

    def _read_part(self) -> NetworkPart:
        counts, kernel = {}, {}
        for direction, sender, receiver in zip(DIRECTIONS, HOSTS, reversed(HOSTS), strict=True):
            statistics = device_statistics(sender)
            kernel[sender] = DeviceBytes(sent=_ip_bytes(statistics["tx"]), received=_ip_bytes(statistics["rx"]))
            counts[direction] = _counts(_queue_statistics(sender), device_statistics(receiver)["rx"])
        return NetworkPart(
            kind="netem",
            start_monotonic_ns=self._start_monotonic_ns,
            written_monotonic_ns=time.monotonic_ns(),
            directions=counts,
            outages=[],
            kernel=kernel,
        )


def require_netem(conditions: NetworkConditions) -> None:
    """Raise :class:`LinkUnavailable` if ``tc netem`` cannot be asked for these conditions at all."""
    require_namespaces()
    if shutil.which("tc") is None:
        raise LinkUnavailable("netem needs the command 'tc': install iproute2")
    if conditions.outage_s:
        raise LinkUnavailable("tc netem has no outages: choose the packet link (namespaces)")
    if any(conditions.direction(direction).trace is not None for direction in DIRECTIONS):
        raise LinkUnavailable("tc netem cannot follow a trace: choose the packet link (namespaces)")


def join_commands(conditions: NetworkConditions) -> list[list[str]]:
    """The commands that lay the cable between the two namespaces and put the conditions on its ends."""
    local, remote = ([DEVICE, "address", _HARDWARE_ADDRESS[host], "netns", namespace_name(host)] for host in HOSTS)
    commands = [["ip", "link", "add", "dev", *local, "type", "veth", "peer", "name", *remote]]
    for direction, sender in zip(DIRECTIONS, HOSTS, strict=True):
        name = namespace_name(sender)
        # Else TCP hands down up to 64 KiB as one packet, to be delayed and lost as one.
        commands.append(["ip", "-n", name, "link", "set", "dev", DEVICE, "gso_max_segs", "1"])
        options = netem_options(conditions.direction(direction))
        commands.append(["tc", "-n", name, "qdisc", "add", "dev", DEVICE, "root", "netem", *options])
    return commands


def netem_options(one_way: DirectionConditions) -> list[str]:
    """What to write behind ``tc qdisc add ... netem`` for one direction."""
    options = ["limit", str(packet_limit(one_way))]
    if one_way.delay_ms:
        options += ["delay", f"{centre(one_way.delay_ms, one_way.jitter_ms):.6g}ms"]
    if one_way.jitter_ms:
        options += [f"{one_way.jitter_ms:.6g}ms", _percent(one_way.jitter_correlation), "distribution", "normal"]
    if one_way.loss_burst_packets:
        inside, outside = one_way.loss_in_burst, one_way.loss_between_bursts
        share = burst_share(one_way.loss, inside, outside)
        leave = 1 / one_way.loss_burst_packets
        probabilities = (leave * share / (1 - share), leave, inside, outside)
        options += ["loss", "gemodel", *map(_percent, probabilities)]
    elif one_way.loss:
        options += ["loss", "random", _percent(one_way.loss)]
    if one_way.bytes_per_s is not None:
        options += ["rate", f"{one_way.rate_mbit:.6g}mbit", str(-_ETHERNET_BYTES)]
    elif one_way.jitter_ms:
        options += ["rate", _UNLIMITED]
    return options


def packet_limit(one_way: DirectionConditions) -> int:
    """How many packets netem may hold: those in flight, and those in the queue, counted as the longest there are."""
    if one_way.bytes_per_s is None:
        return _MAX_PACKETS
    packets_per_ms = one_way.bytes_per_s / 1e3 / MTU_BYTES
    queued = packets_per_ms * one_way.queue_ms
    if one_way.queue_packets:
        queued = min(queued, one_way.queue_packets)
    in_flight = packets_per_ms * (one_way.delay_ms + 3 * one_way.jitter_ms)
    return math.ceil(queued + in_flight) + 1  # and the one that is being sent


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.6g}%"


def _ip_bytes(counted: dict[str, int]) -> int:
    return counted["bytes"] - _ETHERNET_BYTES * counted["packets"]


def _queue_statistics(host: Host) -> dict[str, Any]:
    text = run_command("tc", "-n", namespace_name(host), "-s", "-j", "qdisc", "show", "dev", DEVICE)
    statistics: dict[str, Any] = json.loads(text)[0]
    return statistics


def _counts(queue: dict[str, Any], received: dict[str, int]) -> DirectionCounts:
    """Netem does not tell what the air lost from what the queue had no room for, nor how long that was, bytes."""
    counts = DirectionCounts(
        packets_in=queue["packets"] + queue["qlen"] + queue["drops"],
        bytes_in=queue["bytes"] + queue["backlog"] - _ETHERNET_BYTES * (queue["packets"] + queue["qlen"]),
        packets_delivered=received["packets"],
        bytes_delivered=_ip_bytes(received),
    )
    counts.dropped["loss"] = queue["drops"]
    return counts
