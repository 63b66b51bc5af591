"""``python -m deploy.network.tun``: carries IP packets between two TUN devices in two network namespaces.

A TUN device is a network card whose cable is this process: what a host sends is read here, and leaves
through the other host's device when the schedule says so. The kernels on both sides do the rest, so TCP
loses, repeats and slows down as over a radio.
"""

from __future__ import annotations

import argparse
import ctypes
import fcntl
import os
import select
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

from deploy.network.conditions import DIRECTIONS, HOSTS, Direction, Host, NetworkConditions
from deploy.network.link_program import (
    add_link_arguments,
    prepare_link_process,
    read_settings,
    report_ready,
    stop_signals,
)
from deploy.network.part import DeviceBytes, DirectionCounts, NetworkPart, PartWriter, outages_so_far
from deploy.network.schedule import DropCause, OutageTimes, PacketSchedule, direction_random

_CLONE_NEWNET = 0x40000000
_TUNSETIFF = 0x400454CA
_IFF_TUN = 0x0001
_IFF_NO_PI = 0x1000
_MAX_PACKET_BYTES = 2048
"""More than the MTU of 1500: a longer packet would be cut off."""
_BATCH = 64
"""Packets to take from one device before the other one has its turn."""


class TunDevice:
    """One host's end of the link: an existing TUN device in a network namespace."""

    def __init__(self, namespace: Path, name: str) -> None:
        self._name = name
        home = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
        there = os.open(namespace, os.O_RDONLY)
        try:
            _enter_namespace(there)
            self.fd = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
            fcntl.ioctl(self.fd, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TUN | _IFF_NO_PI))
            # An open file stays with the namespace it was opened in: no need to enter it for every look.
            self._counters = os.open("/proc/thread-self/net/dev", os.O_RDONLY)
        finally:
            _enter_namespace(home)
            os.close(there)
            os.close(home)

    def kernel_bytes(self) -> DeviceBytes:
        """The kernel's counters of this device."""
        for line in os.pread(self._counters, 65536, 0).decode().splitlines():
            name, _, numbers = line.partition(":")
            if name.strip() == self._name:
                columns = numbers.split()
                return DeviceBytes(sent=int(columns[8]), received=int(columns[0]))
        raise OSError(f"device {self._name} is gone")


class PacketPath:
    """One direction: packets from a device, through a schedule, to the other device."""

    def __init__(self, source: int, sink: int, schedule: PacketSchedule, now_s: Callable[[], float]) -> None:
        self.source = source
        """File descriptor of the device that packets come from."""
        self._sink = sink
        self._schedule = schedule
        self._now_s = now_s
        self._on_the_way: deque[tuple[float, bytes]] = deque()
        self._counts = DirectionCounts()

    def counts(self) -> DirectionCounts:
        """The counts so far."""
        self._counts.max_queue_delay_ms = self._schedule.max_queue_delay_s * 1e3
        return self._counts

    def next_delivery_s(self) -> float | None:
        """When the next packet is due; None if none is on the way."""
        return self._on_the_way[0][0] if self._on_the_way else None

    def receive(self) -> None:
        """Take what the device has, at most a batch; what is due at once is delivered at once."""
        counts = self._counts
        for _ in range(_BATCH):
            try:
                packet = os.read(self.source, _MAX_PACKET_BYTES)
            except BlockingIOError:
                return
            now_s = self._now_s()
            counts.packets_in += 1
            counts.bytes_in += len(packet)
            outcome = self._schedule.offer(now_s, len(packet))
            if isinstance(outcome, DropCause):
                counts.dropped[outcome.value] += 1
            elif outcome <= now_s and not self._on_the_way:
                self._write(packet)
            else:
                self._on_the_way.append((outcome, packet))

    def deliver_due(self) -> None:
        """Hand over the packets whose time has come."""
        now_s = self._now_s()
        while self._on_the_way and self._on_the_way[0][0] <= now_s:
            due_s, packet = self._on_the_way.popleft()
            self._counts.max_late_ms = max(self._counts.max_late_ms, (now_s - due_s) * 1e3)
            self._write(packet)

    def _write(self, packet: bytes) -> None:
        try:
            os.write(self._sink, packet)
        except OSError:  # its queue is full, or the host has taken the device down: lost, like on any network
            self._counts.dropped[DropCause.WRITE.value] += 1
        else:
            self._counts.packets_delivered += 1
            self._counts.bytes_delivered += len(packet)


class PacketLink:
    """Both directions, and the loop that serves them."""

    def __init__(self, devices: dict[Host, TunDevice], conditions: NetworkConditions, seed: int) -> None:
        self._devices = devices
        self._outages = OutageTimes.from_conditions(conditions)
        self._start_ns = time.monotonic_ns()
        start_s = self._start_ns / 1e9

        def now_s() -> float:
            return time.monotonic() - start_s

        def path(direction: Direction, source: Host, sink: Host) -> PacketPath:
            schedule = PacketSchedule(conditions, direction, direction_random(seed, direction))
            return PacketPath(devices[source].fd, devices[sink].fd, schedule, now_s)

        self._now_s = now_s
        self._uplink = path("uplink", "local", "remote")
        self._downlink = path("downlink", "remote", "local")

    def run(self, stop_fd: int) -> None:
        """Carry packets until ``stop_fd`` becomes readable."""
        paths = (self._uplink, self._downlink)
        sources = [stop_fd, *(path.source for path in paths)]
        while True:
            due = [due_s for path in paths if (due_s := path.next_delivery_s()) is not None]
            # select() and not epoll: it waits for microseconds, where epoll rounds up to milliseconds.
            timeout_s = max(0.0, min(due) - self._now_s()) if due else None
            readable = select.select(sources, [], [], timeout_s)[0]
            for path in paths:
                if path.source in readable:
                    path.receive()
            for path in paths:
                path.deliver_due()
            if stop_fd in readable:
                return

    def part(self) -> NetworkPart:
        """The link's part of the record."""
        now_ns = time.monotonic_ns()
        return NetworkPart(
            kind="namespaces",
            start_monotonic_ns=self._start_ns,
            written_monotonic_ns=now_ns,
            directions=dict(zip(DIRECTIONS, (self._uplink.counts(), self._downlink.counts()), strict=True)),
            outages=outages_so_far(self._outages, self._start_ns, now_ns),
            kernel={host: self._devices[host].kernel_bytes() for host in HOSTS},
        )


def _enter_namespace(fd: int) -> None:
    # os.setns() exists from Python 3.12 on only.
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(fd, _CLONE_NEWNET) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"cannot enter a network namespace: {os.strerror(number)}")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="deploy.network.tun", description=__doc__)
    parser.add_argument("--local", type=Path, required=True, help="file of the local host's namespace")
    parser.add_argument("--remote", type=Path, required=True, help="file of the remote host's namespace")
    parser.add_argument("--device", required=True, help="name of the TUN device, the same in both namespaces")
    add_link_arguments(parser)
    parsed = parser.parse_args(arguments)
    settings = read_settings(parser, parsed)
    prepare_link_process(settings.parent_pid)
    with stop_signals() as stop:
        devices: dict[Host, TunDevice] = {
            "local": TunDevice(parsed.local, parsed.device),
            "remote": TunDevice(parsed.remote, parsed.device),
        }
        link = PacketLink(devices, settings.conditions, settings.seed)
        with PartWriter(settings.part_path, link.part):
            report_ready()
            link.run(stop.fileno())


if __name__ == "__main__":
    main()
