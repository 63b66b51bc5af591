"""WiFi-like links between two emulated hosts, ``local`` and ``remote``, on one machine."""

from deploy.network.conditions import (
    DIRECTIONS,
    HOSTS,
    PRESETS,
    Direction,
    DirectionConditions,
    Host,
    NetworkConditions,
    load_network,
    parse_network,
)
from deploy.network.errors import LinkFailedError, LinkUnavailable
from deploy.network.link import Crossing, NetworkLink, NoLink
from deploy.network.namespaces import NamespaceLink
from deploy.network.opening import LinkPreference, open_link
from deploy.network.part import NetworkPart
from deploy.network.relay_link import RelayLink
from deploy.network.schedule import DropCause, OutageTimes, PacketSchedule, StreamSchedule, direction_random

__all__ = [
    "DIRECTIONS",
    "HOSTS",
    "PRESETS",
    "Crossing",
    "Direction",
    "DirectionConditions",
    "DropCause",
    "Host",
    "LinkFailedError",
    "LinkPreference",
    "LinkUnavailable",
    "NamespaceLink",
    "NetworkConditions",
    "NetworkLink",
    "NetworkPart",
    "NoLink",
    "OutageTimes",
    "PacketSchedule",
    "RelayLink",
    "StreamSchedule",
    "direction_random",
    "load_network",
    "open_link",
    "parse_network",
]
