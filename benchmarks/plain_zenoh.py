"""Zenoh as it comes, with those settings of our transport that a message's way depends on."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import zenoh

CONNECTED_S = 5.0
"""Longest time that two sessions may take to find each other."""


def open_session(resources: ExitStack, listen: int = 0, connect: int = 0) -> Any:
    """Open a session that listens on or connects to a port of this computer, by TCP."""
    zenoh.init_log_from_env_or("off")
    config = zenoh.Config()
    values = {
        "mode": "peer",
        "listen/endpoints": [f"tcp/127.0.0.1:{listen}"] if listen else [],
        "connect/endpoints": [f"tcp/127.0.0.1:{connect}"] if connect else [],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,
    }
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    session = zenoh.open(config)
    resources.callback(session.close)
    return session


def urgent_publisher(session: Any, key: str) -> Any:
    """Publish as the transport does what is urgent."""
    return session.declare_publisher(
        key, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME, express=True
    )


def waiting_publisher(session: Any, key: str) -> Any:
    """Publish what must arrive: a put waits until there is room."""
    return session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)


def subscriber(session: Any, key: str, receive: Callable[[bytes], object]) -> Any:
    """Call ``receive`` with each payload, on the receiving thread."""
    handler = zenoh.handlers.Callback(lambda sample: receive(sample.payload.to_bytes()), indirect=False)
    return session.declare_subscriber(key, handler)


def wait_until_heard(publisher: Any) -> None:
    """Wait until somebody subscribes to what ``publisher`` publishes."""
    deadline_s = time.monotonic() + CONNECTED_S
    while not publisher.matching_status.matching:
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"nobody subscribed within {CONNECTED_S:g} s")
        time.sleep(0.01)
