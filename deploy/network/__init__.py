"""WiFi-like links between two emulated hosts, ``local`` and ``remote``, on one machine."""

from deploy.network.conditions import (
    DIRECTIONS,
    HOSTS,
    Direction,
    DirectionConditions,
    Host,
    NetworkConditions,
)
from deploy.network.errors import LinkFailedError, LinkUnavailable
from deploy.network.link import Crossing, NetworkLink, NoLink
from deploy.network.namespaces import NamespaceLink
from deploy.network.netem_link import NetemLink
from deploy.network.opening import LINK_PREFERENCES, LinkPreference, open_link
from deploy.network.part import NetworkPart
from deploy.network.presets import PRESETS
from deploy.network.relay_link import RelayLink
from deploy.network.schedule import DropCause, OutageTimes, PacketSchedule, StreamSchedule, direction_random
from deploy.network.table import load_network, parse_network, recorded_table
from deploy.network.trace import Trace, read_trace

__all__ = [
    "DIRECTIONS",
    "HOSTS",
    "LINK_PREFERENCES",
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
    "NetemLink",
    "NetworkConditions",
    "NetworkLink",
    "NetworkPart",
    "NoLink",
    "OutageTimes",
    "PacketSchedule",
    "RelayLink",
    "StreamSchedule",
    "Trace",
    "direction_random",
    "load_network",
    "open_link",
    "parse_network",
    "read_trace",
    "recorded_table",
]
