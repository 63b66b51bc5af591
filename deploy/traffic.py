"""What the record says went over the network, beside what the kernel counted there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from common.topics import TOPICS
from deploy.network import DIRECTIONS, HOSTS, Direction, Host, NetworkPart
from deploy.network.conditions import direction_from


def bytes_per_key(service_bytes: Mapping[str, Counter[str]]) -> dict[str, int]:
    """Topic -> payload bytes of all services."""
    total: Counter[str] = Counter()
    for counts in service_bytes.values():
        total.update(counts)
    return dict(sorted(total.items()))


def record_bytes(bytes_sent: Mapping[str, Counter[str]], placement: Mapping[str, str]) -> dict[Direction, int]:
    """Direction -> payload bytes that must have crossed the network, by the services' own counts.

    A payload crosses once for each service on the other host that subscribes to its topic.
    """
    crossed: Counter[Direction] = Counter()
    for host in HOSTS:
        for topic in TOPICS:
            listeners = sum(placement.get(name) not in (None, host) for name in topic.subscribers)
            senders = [name for name in topic.publishers if placement.get(name) == host]
            crossed[direction_from(host)] += listeners * sum(bytes_sent[name][topic.name] for name in senders)
    return {direction: crossed[direction] for direction in DIRECTIONS}


def bytes_received_by_host(
    bytes_received: Mapping[str, Counter[str]], placement: Mapping[str, str]
) -> dict[Host, dict[str, int]]:
    """Host -> topic -> payload bytes that its services received, from wherever they came."""
    hosts = {host: [name for name in bytes_received if placement.get(name) == host] for host in HOSTS}
    return {host: bytes_per_key({name: bytes_received[name] for name in names}) for host, names in hosts.items()}


def network_link(
    backend: str,
    part: NetworkPart,
    bytes_sent: Mapping[str, Counter[str]],
    bytes_received: Mapping[str, Counter[str]],
    placement: Mapping[str, str],
) -> dict[str, Any]:
    """``network_link`` of ``summary.json``: bytes on the link against the bytes that the record assigns to it.

    ``kernel_bytes`` counts IP packets, so their headers, TCP's repetitions and Zenoh's own messages are in it; it is
    null where the network is emulated above the kernel. ``received`` shows for each host which keys came to it: a key
    that is published on one host only, and received on the other, has crossed.
    """
    recorded = record_bytes(bytes_sent, placement)
    table: dict[str, Any] = {"backend": backend}
    for host in HOSTS:
        direction = direction_from(host)
        kernel = part.kernel[host].sent if host in part.kernel else None
        expected = recorded[direction]
        ratio = None if kernel is None or not expected else round(kernel / expected, 4)
        table[direction] = {"kernel_bytes": kernel, "record_bytes": expected, "ratio": ratio}
    table["received"] = bytes_received_by_host(bytes_received, placement)
    return table
