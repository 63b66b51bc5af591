"""What the packet link and the relay have in common as programs: options, priority, how they end."""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import json
import os
import signal
import socket
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common.errors import ConfigError
from common.priority import run_before_others
from deploy.network.conditions import NetworkConditions
from deploy.network.table import parse_network

LINK_PRIORITY = 1
"""Of SCHED_RR: a packet is not late because someone learns. The bridge still comes first."""
_PR_SET_PDEATHSIG = 1
_PR_SET_TIMERSLACK = 29


@dataclass(frozen=True)
class LinkProcessSettings:
    """What every link process is told on its command line."""

    conditions: NetworkConditions
    part_path: Path
    seed: int
    parent_pid: int
    """The process that started it; it ends with that one."""


def add_link_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of every link process."""
    parser.epilog = "The [network] table is read from standard input, as JSON."
    parser.add_argument("--part", type=Path, required=True, help="file to write the link's part of the record to")
    parser.add_argument("--seed", type=int, default=0, help="seed of jitter and loss")
    parser.add_argument("--parent-pid", type=int, default=os.getppid(), help="process to end with")


def read_settings(parser: argparse.ArgumentParser, parsed: argparse.Namespace) -> LinkProcessSettings:
    """The options of :func:`add_link_arguments`, checked."""
    try:
        conditions = parse_network(json.load(sys.stdin))
    except (json.JSONDecodeError, ConfigError) as error:
        parser.error(f"standard input: {error}")
    return LinkProcessSettings(conditions, parsed.part, parsed.seed, parsed.parent_pid)


def prepare_link_process(parent_pid: int) -> None:
    """End with the parent, and be as punctual as the machine allows."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != parent_pid:  # it died before it could be told to signal
        sys.exit("the process that started this link has ended")
    # Timers may fire up to 50 us late by default, and a link without any delay is measured in tens of them.
    libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    run_before_others(LINK_PRIORITY)
    # Packets and their bookkeeping form no cycles; a collection would only be a pause.
    gc.disable()


@contextlib.contextmanager
def stop_signals() -> Iterator[socket.socket]:
    """A socket that becomes readable on SIGTERM or SIGINT, for a loop that waits in ``select``."""
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    signal.set_wakeup_fd(sender.fileno())
    # Also where the parent was started in the background and has left SIGINT ignored.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda _number, _frame: None)
    try:
        yield receiver
    finally:
        signal.set_wakeup_fd(-1)
        receiver.close()
        sender.close()


def report_ready(**facts: Any) -> None:
    """Tell the parent that the link is up."""
    print(json.dumps(facts), flush=True)
