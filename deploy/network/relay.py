"""``python -m deploy.network.relay``: a TCP relay that delays what passes through it, for want of privileges.

It emulates the link from above TCP, on the payload:

- delay, jitter and rate as the packet link does, on segments of 1448 bytes; one connection's bytes keep
  their order;
- a loss cannot lose bytes, so the segment comes late by the time TCP takes to repeat it, with all that is
  behind it on the same connection; the sender's congestion control never hears of it;
- in an outage bytes wait: connections stay up, nothing moves, and a new connection is accepted but not yet
  passed on;
- a full queue stops the reading, so the sender's own buffers fill up. The kernel's buffers lie in front of
  the queue.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import selectors
import signal
import socket
import time
from collections.abc import Sequence
from pathlib import Path

from deploy.network.conditions import DIRECTIONS, NetworkConditions, direction_from
from deploy.network.link import LOOPBACK, Crossing
from deploy.network.link_program import add_link_arguments, prepare_link_process, read_settings, report_ready
from deploy.network.part import NetworkPart, PartWriter, outages_so_far
from deploy.network.relay_ways import End, RelayedDirection, Way
from deploy.network.schedule import OutageTimes

_RECEIVE_BUFFER_BYTES = 128 * 1024
"""Kernel buffer in front of a limited rate: less than two of loopback's 64 KiB segments, and TCP itself stalls."""
_HANDSHAKE_BYTES = 60


class Relay:
    """All crossings, and the connections on them."""

    def __init__(self, conditions: NetworkConditions, seed: int) -> None:
        self._outages = OutageTimes.from_conditions(conditions)
        self._start_ns = time.monotonic_ns()
        self._directions = {name: RelayedDirection(conditions, name, seed) for name in DIRECTIONS}
        self._tasks: set[asyncio.Task[None]] = set()

    async def listen(self, crossing: Crossing) -> tuple[asyncio.Server, int]:
        """Serve a crossing on a free port, which is returned with the server."""
        listener = socket.create_server((LOOPBACK, 0))
        out = self._directions[direction_from(crossing.from_host)]
        back = self._directions[direction_from(crossing.to_host)]
        self._limit_buffer(listener, out)  # accepted connections inherit it
        loop = asyncio.get_running_loop()
        server = await loop.create_server(lambda: self._accept(crossing.port, out, back), sock=listener)
        return server, listener.getsockname()[1]

    def part(self) -> NetworkPart:
        """The link's part of the record."""
        now_ns = time.monotonic_ns()
        return NetworkPart(
            kind="relay",
            start_monotonic_ns=self._start_ns,
            written_monotonic_ns=now_ns,
            directions={name: direction.counts() for name, direction in self._directions.items()},
            outages=outages_so_far(self._outages, self._start_ns, now_ns),
            kernel={},
        )

    def _accept(self, port: int, out: RelayedDirection, back: RelayedDirection) -> End:
        out_way, back_way = Way(out, self._now_s), Way(back, self._now_s)

        def connected(transport: asyncio.Transport) -> None:
            task = asyncio.get_running_loop().create_task(self._pass_on(transport, port, out_way, back_way))
            self._tasks.add(task)  # the loop itself would not keep it alive
            task.add_done_callback(self._tasks.discard)

        return End(out_way, back_way, connected)

    async def _pass_on(self, dialler: asyncio.Transport, port: int, out: Way, back: Way) -> None:
        """Connect to the service that was dialled, when the news of it would have crossed the link."""
        now_s = self._now_s()
        await asyncio.sleep(out.direction.schedule.offer(now_s, _HANDSHAKE_BYTES).delivery_s - now_s)
        target = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        target.setblocking(False)
        self._limit_buffer(target, back.direction)
        loop = asyncio.get_running_loop()
        try:
            await loop.sock_connect(target, (LOOPBACK, port))
        except OSError:
            target.close()
            dialler.abort()  # nobody listens there: the dialler sees its connection reset, and tries again
            return
        if dialler.is_closing():
            target.close()
            return

        def close_if_ended() -> None:
            if out.ended and back.ended:
                dialler.close()
                service.close()

        service, _ = await loop.create_connection(lambda: End(back, out, lambda _transport: None), sock=target)
        out.connect(dialler, service, close_if_ended)
        back.connect(service, dialler, close_if_ended)

    def _limit_buffer(self, connection: socket.socket, direction: RelayedDirection) -> None:
        if direction.limited:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)

    def _now_s(self) -> float:
        return (time.monotonic_ns() - self._start_ns) / 1e9


async def serve(relay: Relay, crossings: Sequence[Crossing], part_path: Path) -> None:
    """Relay until SIGTERM or SIGINT."""
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    listening = [await relay.listen(crossing) for crossing in crossings]
    with PartWriter(part_path, relay.part):
        report_ready(ports=[port for _, port in listening])
        await stop.wait()
    for server, _ in listening:
        server.close()


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="deploy.network.relay", description=__doc__)
    parser.add_argument("--crossings", required=True, help="JSON list of {from_host, to_host, port}")
    add_link_arguments(parser)
    parsed = parser.parse_args(arguments)
    settings = read_settings(parser, parsed)
    crossings = [Crossing(**crossing) for crossing in json.loads(parsed.crossings)]
    prepare_link_process(settings.parent_pid)
    # select() and not epoll: it waits for microseconds, where epoll rounds up to milliseconds.
    with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(selectors.SelectSelector())) as runner:
        runner.run(serve(Relay(settings.conditions, settings.seed), crossings, settings.part_path))


if __name__ == "__main__":
    main()
