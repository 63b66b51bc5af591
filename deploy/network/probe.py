"""``python -m deploy.network.probe``: sends or receives what ``deploy.network check`` measures a link with.

Everything that is sent carries its number and when it was sent. The kernel says when it came, so that a receiver which
wakes up late does not count as delay. Both are on the real-time clock, which the two ends of an emulated link share.
"""

from __future__ import annotations

import argparse
import json
import select
import socket
import struct
import sys
import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from deploy.network.link_program import prepare_link_process

Transport = Literal["packets", "stream"]

HEADER = struct.Struct("!qq")
"""Number of the block and when it was sent, ns."""
_BLOCK_SIZE = struct.Struct("!i")
"""The first word on a connection: the size of each block that follows, bytes."""
_SO_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)
_TIMESPEC = struct.Struct("@qq")
_BUFFER_BYTES = 32 * 1024 * 1024
_READ_BYTES = 256 * 1024
_MAX_LATE_S = 0.005
"""A sender that is later than this does not catch up: a burst would not be what was asked for."""


@dataclass(frozen=True)
class Phase:
    """Blocks that are sent one after the other; their numbers begin with the phase's own."""

    number: int
    blocks: int
    """How many to send at most."""
    block_bytes: int
    gap_s: float
    """From one group to the next, s; 0: as fast as the other end takes them."""
    group: int = 1
    """How many at once."""
    limit_s: float = 60.0
    """The phase ends after this time, s."""
    connections: int = 1
    """Over how many connections in turn (streams only)."""

    def block_number(self, index: int) -> int:
        return self.number << 32 | index


def phase_of(block_number: int) -> int:
    """The phase that a block belongs to."""
    return block_number >> 32


Sent = list[tuple[int, int]]
"""Number of each block and when it was sent, ns on the real-time clock."""
Received = list[tuple[int, int, int]]
"""Number of each block, when it was sent and when it came, ns on the real-time clock."""


def read_sent(path: Path) -> Sent:
    """What a sender has written."""
    numbers = _read(path)
    return list(zip(numbers[::2], numbers[1::2], strict=True))


def read_received(path: Path) -> Received:
    """What a receiver has written."""
    numbers = _read(path)
    return list(zip(numbers[::3], numbers[1::3], numbers[2::3], strict=True))


def send(transport: Transport, address: tuple[str, int], phases: Sequence[Phase], pause_s: float) -> array[int]:
    """Send the phases, ``pause_s`` apart; returns number and time of each block in turn."""
    record = array("q")
    for index, phase in enumerate(phases):
        if index:
            time.sleep(pause_s)
        if transport == "packets":
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                sender.connect(address)
                _send_phase(phase, [sender.send], record)
        else:
            connections = [_dial(address, phase.block_bytes) for _ in range(phase.connections)]
            time.sleep(pause_s)  # they are through to the other end
            _send_phase(phase, [connection.sendall for connection in connections], record)
            for connection in connections:
                connection.shutdown(socket.SHUT_WR)
    return record


def receive(transport: Transport, address: tuple[str, int]) -> array[int]:
    """Receive until standard input ends; returns number, time of sending and time of arrival of each block in turn."""
    record = array("q")
    if transport == "packets":
        with _socket(socket.SOCK_DGRAM, address) as receiver:
            print("listening", flush=True)
            _until_told({receiver: _packet_reader(receiver, record)})
        return record
    with _socket(socket.SOCK_STREAM, address) as listener:
        listener.listen(64)
        print("listening", flush=True)
        readers: dict[socket.socket, Callable[[], bool]] = {}

        def accept() -> bool:
            connection, _ = listener.accept()
            readers[connection] = _stream_reader(connection, record)
            return True

        readers[listener] = accept
        _until_told(readers)
    return record


def _send_phase(phase: Phase, sends: Sequence[Callable[[bytes], object]], record: array[int]) -> None:
    filling = bytes(phase.block_bytes - HEADER.size)
    begin_s = due_s = time.monotonic()
    for index in range(phase.blocks):
        if phase.gap_s and index % phase.group == 0:
            now_s = time.monotonic()
            if now_s < due_s:
                time.sleep(due_s - now_s)
            elif now_s - due_s > _MAX_LATE_S:
                due_s = now_s
            due_s += phase.gap_s
        if time.monotonic() - begin_s > phase.limit_s:
            return
        number, sent_ns = phase.block_number(index), time.time_ns()
        sends[index % len(sends)](HEADER.pack(number, sent_ns) + filling)
        record.extend((number, sent_ns))


def _dial(address: tuple[str, int], block_bytes: int) -> socket.socket:
    connection = socket.create_connection(address, timeout=60)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.sendall(_BLOCK_SIZE.pack(block_bytes))
    return connection


def _socket(kind: socket.SocketKind, address: tuple[str, int]) -> socket.socket:
    receiver = socket.socket(socket.AF_INET, kind)
    receiver.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)  # accepted connections inherit it
    if kind is socket.SOCK_DGRAM:
        # More than the usual limit takes privileges, and who has namespaces has them.
        force = getattr(socket, "SO_RCVBUFFORCE", 33)
        try:
            receiver.setsockopt(socket.SOL_SOCKET, force, _BUFFER_BYTES)
        except PermissionError:
            receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    else:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    receiver.bind(address)
    return receiver


def _until_told(readers: dict[socket.socket, Callable[[], bool]]) -> None:
    """Call the reader of whatever has something until standard input ends; a reader says whether there may be more."""
    while True:
        ready = select.select([sys.stdin, *readers], [], [])[0]
        for source in ready:
            if source is not sys.stdin and not readers[source]():
                del readers[source]
                source.close()
        if sys.stdin in ready and len(ready) == 1:
            return


def _packet_reader(receiver: socket.socket, record: array[int]) -> Callable[[], bool]:
    def read() -> bool:
        data, ancillary, _, _ = receiver.recvmsg(2048, 64)
        number, sent_ns = HEADER.unpack_from(data)
        record.extend((number, sent_ns, _kernel_time_ns(ancillary)))
        return True

    return read


def _stream_reader(connection: socket.socket, record: array[int]) -> Callable[[], bool]:
    pending = bytearray()
    block_bytes = 0

    def read() -> bool:
        nonlocal block_bytes
        data, ancillary, _, _ = connection.recvmsg(_READ_BYTES, 64)
        if not data:
            return False
        came_ns = _kernel_time_ns(ancillary)
        pending.extend(data)
        if not block_bytes and len(pending) >= _BLOCK_SIZE.size:
            (block_bytes,) = _BLOCK_SIZE.unpack_from(pending)
            del pending[: _BLOCK_SIZE.size]
        if block_bytes:
            whole = len(pending) - len(pending) % block_bytes
            for begin in range(0, whole, block_bytes):
                number, sent_ns = HEADER.unpack_from(pending, begin)
                record.extend((number, sent_ns, came_ns))
            del pending[:whole]
        return True

    return read


def _kernel_time_ns(ancillary: Sequence[tuple[int, int, bytes]]) -> int:
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            return int(seconds) * 1_000_000_000 + int(nanoseconds)
    return time.time_ns()


def _read(path: Path) -> array[int]:
    numbers = array("q")
    numbers.frombytes(path.read_bytes())
    return numbers


def sender_arguments(
    transport: Transport, address: tuple[str, int], phases: Sequence[Phase], pause_s: float
) -> list[str]:
    """The command line of a sender, ``--record`` and ``--parent-pid`` aside."""
    table = json.dumps([asdict(phase) for phase in phases])
    return ["send", transport, address[0], str(address[1]), "--phases", table, "--pause-s", str(pause_s)]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="deploy.network.probe", description=__doc__)
    parser.add_argument("role", choices=("send", "receive"))
    parser.add_argument("transport", choices=("packets", "stream"))
    parser.add_argument("address")
    parser.add_argument("port", type=int)
    parser.add_argument("--record", type=Path, required=True, help="file to write the numbers to")
    parser.add_argument("--parent-pid", type=int, required=True, help="process to end with")
    parser.add_argument("--phases", type=json.loads, default=[], help="JSON list of what to send")
    parser.add_argument("--pause-s", type=float, default=0.0, help="between two phases")
    parsed = parser.parse_args(arguments)
    prepare_link_process(parsed.parent_pid)
    address = (parsed.address, parsed.port)
    if parsed.role == "send":
        record = send(parsed.transport, address, [Phase(**phase) for phase in parsed.phases], parsed.pause_s)
    else:
        record = receive(parsed.transport, address)
    parsed.record.write_bytes(record.tobytes())


if __name__ == "__main__":
    main()
