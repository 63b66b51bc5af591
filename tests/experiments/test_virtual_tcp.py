"""TCP over a lossy link: nothing is lost, and what comes late comes as late as it should. Times in milliseconds."""

from __future__ import annotations

import heapq
import itertools
import random
from collections import Counter

import pytest

from deploy.network import DropCause
from experiments.virtual_tcp import HEADER_BYTES, SEGMENT_BYTES, TcpStream

MS = 1_000_000
ONE_WAY_MS = 10


class Timers:
    """Time that jumps from one callback to the next."""

    def __init__(self) -> None:
        self._now_ns, self._order, self._due = 0, itertools.count(), []

    def now_ns(self) -> int:
        return self._now_ns

    def call_later(self, delay_ns, callback) -> None:
        heapq.heappush(self._due, (self._now_ns + delay_ns, next(self._order), callback))

    def run(self) -> None:
        while self._due:
            self._now_ns, _, callback = heapq.heappop(self._due)
            callback()


class Path:
    """Takes :data:`ONE_WAY_MS`; ``lose`` says which packets, by number or time in ms, never arrive."""

    def __init__(self, timers, lose=lambda number, at_ms: False) -> None:
        self._timers, self._lose = timers, lose
        self.sent: list[tuple[float, int]] = []

    def send(self, size_bytes):
        at_ms = self._timers.now_ns() / MS
        self.sent.append((at_ms, size_bytes))
        return DropCause.LOSS if self._lose(len(self.sent) - 1, at_ms) else ONE_WAY_MS * MS


class Scene:
    """A connection, and when its messages arrived."""

    def __init__(self, lose=lambda number, at_ms: False, lose_back=lambda number, at_ms: False) -> None:
        self.timers = Timers()
        self.path, self.back = Path(self.timers, lose), Path(self.timers, lose_back)
        self.stream = TcpStream(self.timers, self.path, self.back)
        self.arrived: list[tuple[str, float]] = []

    def write(self, at_ms, name, size_bytes=100) -> None:
        def arrive() -> None:
            self.arrived.append((name, self.timers.now_ns() / MS))

        self.timers.call_later(at_ms * MS - self.timers.now_ns(), lambda: self.stream.write(size_bytes, arrive))

    def run(self):
        self.timers.run()
        assert self.stream.backlog_bytes == 0
        return self.arrived


def test_a_message_arrives_when_its_last_packet_does_and_each_carries_its_headers():
    scene = Scene()
    scene.write(0, "three packets", 2 * SEGMENT_BYTES + 1)
    assert scene.run() == [("three packets", 10)]
    full = SEGMENT_BYTES + HEADER_BYTES
    assert scene.path.sent == [(0, full), (0, full), (0, 1 + HEADER_BYTES)]
    assert [size for _, size in scene.back.sent] == [HEADER_BYTES] * 3


def test_the_next_message_shows_the_loss_of_the_one_before_and_waits_for_it():
    scene = Scene(lose=lambda number, _: number == 1)
    for at_ms, name in ((0, "a"), (40, "b"), (80, "c"), (120, "d")):
        scene.write(at_ms, name)
    # c's acknowledgement is back at 100: b is sent again and there at 110, and c, there since 90, behind it.
    assert scene.run() == [("a", 10), ("b", 110), ("c", 110), ("d", 130)]
    assert scene.stream.retransmitted == 1


def test_a_loss_is_not_believed_before_a_quarter_of_the_round_trip_is_over():
    scene = Scene(lose=lambda number, _: number == 1)
    scene.write(0, "a")
    scene.write(40, "b")
    scene.write(41, "c")
    # c's acknowledgement comes at 61, and b, sent at 40, is lost from 40 + 20 + 5 on, plus the timer's 8.
    assert scene.run() == [("a", 10), ("b", 83), ("c", 83)]


def test_a_lone_message_that_is_lost_comes_after_the_time_out():
    scene = Scene(lose=lambda number, _: number == 1)
    scene.write(0, "a")
    scene.write(1000, "b")
    # Round trip 20, and 200 above it.
    assert scene.run() == [("a", 10), ("b", 1230)]


def test_before_anything_is_known_of_the_round_trip_the_time_out_is_a_second():
    scene = Scene(lose=lambda number, _: number == 0)
    scene.write(0, "a")
    assert scene.run() == [("a", 1010)]


def test_the_end_of_a_burst_is_asked_for_after_two_round_trips():
    scene = Scene(lose=lambda number, _: number == 3)
    scene.write(0, "a")
    scene.write(1000, "b", 3 * SEGMENT_BYTES)
    # The two before it are acknowledged at 1020; of a single packet the acknowledgement may be late by 200 on purpose,
    # so the time-out, 220 from then on, comes before the probe.
    assert scene.run() == [("a", 10), ("b", 1250)]
    scene = Scene(lose=lambda number, _: number in (3, 4))
    scene.write(0, "a")
    scene.write(1000, "b", 4 * SEGMENT_BYTES)
    # Of two, the last is sent again at 1020 + 2 * 20 + 8 = 1068; its acknowledgement at 1088 shows the other's loss.
    assert scene.run() == [("a", 10), ("b", 1098)]


def test_a_silence_is_tested_at_doubling_intervals_and_all_that_was_written_in_it_arrives():
    scene = Scene(lose=lambda _, at_ms: 1000 <= at_ms < 2000)
    scene.write(0, "a")
    for number in range(10):
        scene.write(1000 + 100 * number, f"b{number}")
    arrived = scene.run()
    # b0 at 1000, in vain at 1220 and at 1220 + 440, then at 1660 + 880 = 2540.
    assert arrived[:2] == [("a", 10), ("b0", 2550)]
    assert [name for name, _ in arrived[1:]] == [f"b{number}" for number in range(10)]
    assert all(2550 < at_ms < 2700 for _, at_ms in arrived[2:])


def test_ten_packets_may_be_on_their_way_at_first_and_twice_as_many_with_each_round_trip():
    scene = Scene()
    scene.write(0, "a", 70 * SEGMENT_BYTES)
    assert scene.run() == [("a", 50)]
    assert [at_ms for at_ms, _ in scene.path.sent] == [0] * 10 + [20] * 20 + [40] * 40


def test_a_loss_leaves_seventy_percent_of_the_window():
    scene = Scene(lose=lambda number, _: number == 0)
    scene.write(0, "a", 100 * SEGMENT_BYTES)
    scene.run()
    sent = Counter(at_ms for at_ms, _ in scene.path.sent)
    # Ten at 0. At 20 the first two acknowledgements let out two each; the third makes the loss certain, and 70 % of
    # 10 + 3 stay: 9.1. Of the eleven then on their way, six more acknowledgements leave five: the window has room for
    # five, the lost one first.
    assert (sent[0], sent[20]) == (10, 4 + 5)
    # From then on ten at a time, and one more with each round trip.
    assert [sent[at_ms] for at_ms in (40, 60, 80)] == [10, 11, 12]


def test_after_a_pause_the_window_is_the_first_again():
    scene = Scene()
    scene.write(0, "a", 70 * SEGMENT_BYTES)
    scene.write(1000, "b", 30 * SEGMENT_BYTES)
    assert scene.run() == [("a", 50), ("b", 1030)]


def test_lost_acknowledgements_are_made_up_for_by_later_ones():
    scene = Scene(lose_back=lambda number, _: number in (1, 2))
    for number in range(4):
        scene.write(40 * number, str(number))
    assert scene.run() == [(str(number), 40 * number + 10) for number in range(4)]
    assert scene.stream.retransmitted == 0


@pytest.mark.parametrize("seed", range(8))
def test_everything_arrives_once_and_in_order_whatever_is_lost(seed):
    rng = random.Random(seed)
    loss = rng.choice([0.02, 0.2, 0.5])
    scene = Scene(lose=lambda *_: rng.random() < loss, lose_back=lambda *_: rng.random() < loss)
    names = [str(number) for number in range(60)]
    for number, name in enumerate(names):
        scene.write(40 * number, name, rng.choice([1, 100, 5000, 50_000]))
    assert [name for name, _ in scene.run()] == names


def test_what_is_not_acknowledged_counts_as_held_and_room_is_told():
    scene = Scene()
    told = []
    scene.stream.on_room = lambda: told.append((scene.timers.now_ns() / MS, scene.stream.backlog_bytes))
    scene.write(0, "a", 2000)
    scene.run()
    assert told == [(20, 552), (20, 0)]
