"""``python -m deploy.network check``: holds each way of emulating a network against the ``[network]`` table."""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from deploy.network.check_plan import duration_s, pause_s, plan
from deploy.network.check_rows import Crossed, Row, compare
from deploy.network.conditions import DIRECTIONS, HOSTS, Direction, Host, NetworkConditions, direction_from
from deploy.network.errors import LinkFailedError, LinkUnavailable
from deploy.network.link import LOOPBACK, Crossing, NetworkLink
from deploy.network.link_process import python_path
from deploy.network.opening import open_link
from deploy.network.presets import PRESETS
from deploy.network.probe import Transport, read_received, read_sent, sender_arguments
from deploy.network.table import load_network

Backend = Literal["namespaces", "netem", "relay"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)

_TRANSPORT: dict[Backend, Transport] = {"namespaces": "packets", "netem": "packets", "relay": "stream"}
_START_S = 2.0
"""What starting the programs of one network takes, about, s."""
_GRACE_S = 30.0
"""How much longer than planned a sender may take, s."""
_POLL_S = 0.1

_EPILOG = """\
Sends its own traffic through each backend, in both directions at once: mean delay must be within 10 %, loss within
20 % (of itself) and rate within 10 %; where a longer measurement would be needed to be that sure, the tolerance is
three standard errors, and where the delay is below 2 ms, 0.2 ms. It takes a minute or two per backend for all presets;
another load on the same cores shows in the delay. Exit code 1: something misses its table, or could not be measured.

examples:
  python -m deploy.network check
  python -m deploy.network check --backend relay --network wifi_bad
  python -m deploy.network check --backend namespaces --network my_network.toml
"""


@dataclass(frozen=True)
class Check:
    """One network over one backend."""

    backend: Backend
    network: str
    conditions: NetworkConditions

    @property
    def seconds(self) -> float:
        """How long it takes, about."""
        between_s = pause_s(self.conditions)
        phases = (plan(self.conditions, direction, _TRANSPORT[self.backend]) for direction in DIRECTIONS)
        return _START_S + max(duration_s(one_way, between_s) for one_way in phases)


def add_check_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``check``."""
    parser.epilog = _EPILOG
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "--backend", action="append", choices=BACKENDS, help="only this one; may be given several times (default: all)"
    )
    parser.add_argument(
        "--network",
        action="append",
        metavar="PRESET|FILE",
        help=f"only this one; may be given several times (default: {', '.join(PRESETS)})",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of jitter and loss (default: %(default)s)")


def _say(text: str) -> None:
    print(text, flush=True)  # line by line into a pipe, too: it takes minutes


def run_check(parsed: argparse.Namespace, say: Callable[[str], None] = _say) -> int:
    """Check what was asked for; returns the exit code.

    Raises:
        ConfigError: a network that cannot be used.
    """
    networks = {Path(name).stem: load_network(name) for name in parsed.network or PRESETS}
    misses: list[str] = []
    measured: set[Backend] = set()
    for backend in parsed.backend or BACKENDS:
        if reason := unavailable(backend):
            say(f"{backend}: not available here: {reason}\n")
            continue
        checks = [Check(backend, name, conditions) for name, conditions in networks.items()]
        say(f"{backend}: {len(checks)} networks, about {sum(check.seconds for check in checks):.0f} s")
        say(HEADING)
        for check in checks:
            _progress(f"{backend} {check.network}: measuring for about {check.seconds:.0f} s")
            try:
                rows = measure(check, parsed.seed)
            except LinkUnavailable as error:
                say(f"{check.network:<12} not measured: {error}")
                continue
            except LinkFailedError as error:
                say(f"{check.network:<12} FAILED: {error}")
                misses.append(f"{backend} {check.network}")
                continue
            finally:
                _progress("")
            measured.add(backend)
            for row in rows:
                say(row_text(check.network, row))
            misses += [f"{backend} {check.network} {row.direction} {row.quantity}" for row in rows if row.misses]
        say("")
    if unmeasured := [backend for backend in parsed.backend or () if backend not in measured]:
        say(f"not measured: {', '.join(unmeasured)}")
        return 1
    if not measured:
        say("nothing could be measured")
        return 1
    say(
        f"missed: {'; '.join(misses)}"
        if misses
        else f"{', '.join(sorted(measured))}: every number within its tolerance"
    )
    return 1 if misses else 0


HEADING = f"{'network':<12} {'direction':<9} {'quantity':<10} {'expected':>10} {'measured':>10} {'allowed':>10}"


def row_text(network: str, row: Row) -> str:
    """One line of the table below :data:`HEADING`."""
    measured = "nothing" if row.measured is None else f"{row.measured:.3f}"
    verdict = f"MISSES {row.note}".rstrip() if row.misses else "ok" if row.ok else "cannot be measured: all is lost"
    return (
        f"{network:<12} {row.direction:<9} {row.quantity:<10} {row.expected:>10.3f} {measured:>10} "
        f"{f'± {row.allowed:.3f}':>10} {row.unit:<6} {verdict}"
    )


def unavailable(backend: Backend) -> str | None:
    """Why this backend cannot be used here; None if it can."""
    try:
        with tempfile.TemporaryDirectory() as directory, _open(backend, NetworkConditions(), Path(directory), 0):
            return None
    except LinkUnavailable as error:
        return str(error)


def measure(check: Check, seed: int = 0) -> list[Row]:
    """Send traffic in both directions at once, and compare.

    Raises:
        LinkUnavailable: the backend cannot emulate this network.
        LinkFailedError: it did not last, or a probe failed.
    """
    transport = _TRANSPORT[check.backend]
    for direction in DIRECTIONS:
        if transport == "stream" and check.conditions.direction(direction).silent:
            raise LinkUnavailable(f"everything in the {direction} is lost (loss = 1): no stream gets through there")
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        with _open(check.backend, check.conditions, directory, seed) as (network_link, ports):
            _exchange(check, network_link, ports, directory)
        part = network_link.part()  # final, now that the link is closed
        assert part is not None
        start_ns = time.time_ns() - time.monotonic_ns() + part.start_monotonic_ns
        return [
            row
            for direction in DIRECTIONS
            for row in compare(
                Crossed(
                    conditions=check.conditions,
                    direction=direction,
                    transport=transport,
                    start_ns=start_ns,
                    sent=read_sent(directory / f"{direction}.sent"),
                    received=read_received(directory / f"{direction}.received"),
                    counts=part.directions[direction],
                    lost_take_their_turn=check.backend != "netem",
                )
            )
        ]


@contextlib.contextmanager
def _open(
    backend: Backend, conditions: NetworkConditions, directory: Path, seed: int
) -> Iterator[tuple[NetworkLink, dict[Direction, int]]]:
    """The link, and the port that each direction's receiver listens on."""
    with ExitStack() as stack:
        reserved = [stack.enter_context(socket.create_server((LOOPBACK, 0))) for _ in DIRECTIONS]
        ports = {name: listener.getsockname()[1] for name, listener in zip(DIRECTIONS, reserved, strict=True)}
    needs = [Crossing(sender, _other(sender), ports[direction_from(sender)]) for sender in HOSTS]
    with open_link(conditions, needs=needs, run_dir=directory, prefer=backend, seed=seed) as network_link:
        yield network_link, ports


def _exchange(check: Check, network_link: NetworkLink, ports: dict[Direction, int], directory: Path) -> None:
    """Run a sender and a receiver for each direction, from the first block to the last."""
    transport = _TRANSPORT[check.backend]
    between_s = pause_s(check.conditions)
    receivers, senders = [], []
    with ExitStack() as stack:
        for host in HOSTS:
            direction, to_host = direction_from(host), _other(host)
            role = ["receive", transport, network_link.listen_address(to_host), str(ports[direction])]
            process = _start(stack, network_link, to_host, role, directory / f"{direction}.received")
            assert process.stdout is not None
            if process.stdout.readline() != "listening\n":
                raise LinkFailedError(f"the receiver of the {direction} did not start: {_said(directory, direction)}")
            receivers.append(process)
        for host in HOSTS:
            direction = direction_from(host)
            address = network_link.dial_address(host, _other(host), ports[direction])
            phases = plan(check.conditions, direction, transport)
            role = sender_arguments(transport, address, phases, between_s)
            senders.append(_start(stack, network_link, host, role, directory / f"{direction}.sent"))
        deadline_s = time.monotonic() + check.seconds + _GRACE_S
        while any(sender.poll() is None for sender in senders):
            if reason := network_link.failure() or network_link.over():
                raise LinkFailedError(f"{check.backend} {check.network}: {reason}")
            if time.monotonic() > deadline_s:
                raise LinkFailedError(f"{check.backend} {check.network}: not over {_GRACE_S:.0f} s after it should be")
            time.sleep(_POLL_S)
        time.sleep(between_s)
        for process in receivers:
            assert process.stdin is not None
            process.stdin.close()
        for direction, *both in zip(DIRECTIONS, senders, receivers, strict=True):
            if any(process.wait(_GRACE_S) != 0 for process in both):
                raise LinkFailedError(f"a probe of the {direction} failed: {_said(directory, direction)}")


def _start(
    stack: ExitStack, network_link: NetworkLink, host: Host, role: Sequence[str], record: Path
) -> subprocess.Popen[str]:
    command = [*network_link.command_prefix(host), sys.executable, "-m", "deploy.network.probe", *role]
    with record.with_suffix(record.suffix + ".log").open("w") as log:
        process = subprocess.Popen(
            [*command, "--record", str(record), "--parent-pid", str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            env={**os.environ, "PYTHONPATH": python_path()},
        )
    stack.enter_context(process)  # waits for it, and closes its pipes
    stack.callback(process.kill)  # first
    return process


def _said(directory: Path, direction: Direction) -> str:
    """The last line that a probe of this direction complained with."""
    lines = [line for path in sorted(directory.glob(f"{direction}.*.log")) for line in path.read_text().splitlines()]
    return lines[-1] if lines else "it said nothing"


def _other(host: Host) -> Host:
    return "remote" if host == "local" else "local"


def _progress(text: str) -> None:
    """What is going on, on a terminal only; the next one replaces it."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)
