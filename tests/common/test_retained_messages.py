"""What the sender holds: what is late is not resent, what is lost is, and no more at a time than the way carries."""

from __future__ import annotations

from collections import deque

import pytest

from common.journal import OrderedReceiver
from common.messages import StreamHead
from common.retained_messages import AcknowledgedTime, RepairWindow, RetainedMessages

S = 1_000_000_000
MS = 1_000_000
NOTHING = ()


def retained(count=0, max_age_s=60.0, max_bytes=10_000_000, size=10, every_s=1.0, one_connection=True):
    """Return a store of ``count`` messages, message i retained at i * ``every_s``."""
    messages = RetainedMessages(round(max_age_s * S), max_bytes, one_connection=one_connection)
    send(messages, count, size=size, every_s=every_s)
    return messages


def send(messages, count, size=10, every_s=0.0, at_s=0.0):
    """Retain ``count`` messages more; each tells its number in its first two bytes."""
    for i in range(count):
        payload = messages.next_seq.to_bytes(2, "big") + bytes(size - 2)
        messages.retain(messages.next_seq, payload, round((at_s + i * every_s) * S))


def sent_again(messages, *ranges, at_s):
    """Return the numbers of what is due."""
    return [int.from_bytes(payload[:2], "big") for payload in messages.due(iter(ranges), round(at_s * S))]


def answer(messages, next_seq, *ranges, at_s):
    """Acknowledge; return the numbers of what is sent again."""
    messages.acknowledge(next_seq, ranges, round(at_s * S))
    return sent_again(messages, *ranges, at_s=at_s)


# ------------------------------------------------------------------ what is held


def test_an_empty_store_holds_nothing_from_the_next_number_on():
    messages = retained()
    assert (len(messages), messages.oldest_seq, messages.next_seq, messages.retained_bytes) == (0, 0, 0, 0)


def test_what_was_sent_is_held():
    messages = retained(3)
    assert (len(messages), messages.oldest_seq, messages.next_seq, messages.retained_bytes) == (3, 0, 3, 30)


@pytest.mark.parametrize("seq", [0, 1, 3, 4])
def test_numbers_are_contiguous(seq):
    messages = retained(2)
    with pytest.raises(ValueError, match=f"seq: expected 2, got {seq}"):
        messages.retain(seq, b"x", 0)
    assert len(messages) == 2


def test_an_acknowledgement_frees_all_before_it():
    messages = retained(5)
    messages.acknowledge(3, NOTHING, 5 * S)
    assert (len(messages), messages.oldest_seq, messages.next_seq, messages.retained_bytes) == (2, 3, 5, 20)
    assert messages.given_up == 0


@pytest.mark.parametrize("next_seq", [0, 2, 3])
def test_an_old_acknowledgement_changes_nothing(next_seq):
    messages = retained(5)
    messages.acknowledge(3, NOTHING, 5 * S)
    messages.acknowledge(next_seq, NOTHING, 6 * S)
    assert (messages.oldest_seq, messages.given_up) == (3, 0)


def test_an_acknowledgement_of_more_than_was_sent_frees_all():
    messages = retained(5)
    messages.acknowledge(2**62, NOTHING, 5 * S)
    assert (len(messages), messages.oldest_seq, messages.next_seq) == (0, 5, 5)


def test_a_message_that_is_acknowledged_before_it_is_retained_is_not_held():
    messages = retained(3)
    messages.acknowledge(4, NOTHING, 5 * S)  # number 3 is on its way
    messages.retain(3, b"d", 0)
    assert (messages.oldest_seq, messages.next_seq, len(messages), messages.retained_bytes) == (4, 4, 0, 0)


def test_what_is_sent_after_an_acknowledgement_of_more_than_there_can_be_is_held():
    messages = retained(3)
    messages.acknowledge(100, NOTHING, 5 * S)
    for seq in (3, 4, 5):
        messages.retain(seq, b"x", 0)
    assert (messages.oldest_seq, messages.next_seq, len(messages)) == (4, 6, 2)


def test_messages_older_than_the_limit_are_given_up():
    messages = retained(5, max_age_s=3.0)  # at 4 s, message 0 is 4 s old and message 1 just 3 s
    assert (messages.oldest_seq, messages.given_up) == (1, 1)
    messages.retain(5, b"x", 8 * S + 1)  # messages 1 to 4 are older than 3 s; 5 s after the fourth
    assert (messages.oldest_seq, messages.given_up, len(messages)) == (5, 5, 1)


def test_messages_beyond_the_memory_limit_are_given_up_oldest_first():
    messages = retained(10, max_bytes=35)
    assert (messages.oldest_seq, messages.given_up, messages.retained_bytes) == (7, 7, 30)


def test_the_memory_limit_itself_is_allowed():
    assert retained(3, max_bytes=30).given_up == 0


def test_the_newest_message_is_held_however_large_it_is():
    messages = retained(3, max_bytes=10_000)
    messages.retain(3, b"x" * 20_000, 3 * S)
    assert (len(messages), messages.oldest_seq, messages.given_up, messages.retained_bytes) == (1, 3, 3, 20_000)


# ------------------------------------------------------------------ lost, or late


def test_what_is_late_is_not_sent_again():
    """Known from the head, and behind everything that has arrived: it may still be on its way."""
    messages = retained(10, every_s=0.04)
    assert answer(messages, 4, (4, 10), at_s=0.4) == []
    assert answer(messages, 6, (6, 10), at_s=0.5) == []


def test_what_a_later_message_has_overtaken_is_sent_again_at_once_in_order():
    messages = retained(10, every_s=0.04)
    assert answer(messages, 1, (1, 3), (5, 6), (8, 8), at_s=0.4) == [1, 2, 5]


def test_the_range_before_a_gap_tells_what_has_arrived_too():
    messages = retained(10, every_s=0.04)
    assert answer(messages, 1, (1, 3), (5, 10), at_s=0.4) == [1, 2]  # 4 has come, so 1 and 2 are lost


def test_a_repair_is_not_sent_again_while_it_may_be_on_its_way():
    messages = retained(10, every_s=0.04)
    assert answer(messages, 1, (1, 2), (10, 10), at_s=0.40) == [1]
    assert answer(messages, 1, (1, 2), (10, 10), at_s=0.45) == []


def test_a_repair_that_a_later_message_has_overtaken_is_sent_again():
    messages = retained(10, every_s=0.04)
    assert answer(messages, 1, (1, 2), (10, 10), at_s=0.40) == [1]
    send(messages, 1, at_s=0.44)
    assert answer(messages, 1, (1, 2), (11, 11), at_s=0.50) == [1]


def test_a_repair_on_a_connection_of_its_own_is_overtaken_by_repairs_only():
    messages = retained(10, every_s=0.04, one_connection=False)
    assert answer(messages, 1, (1, 2), (3, 4), (10, 10), at_s=0.40) == [1, 3]
    send(messages, 1, at_s=0.44)
    assert answer(messages, 1, (1, 2), (3, 4), (11, 11), at_s=0.50) == []
    assert answer(messages, 1, (1, 2), (11, 11), at_s=0.60) == [1]  # the repair of 3 has come


def test_of_what_nothing_is_known_is_sent_again_after_the_time_out():
    messages = retained(1)  # nothing has been measured: 1 s
    assert answer(messages, 0, (0, 1), at_s=1 - 1e-9) == []
    assert answer(messages, 0, (0, 1), at_s=1) == [0]


def test_the_time_out_doubles_with_each_repair():
    messages = retained(1)
    sent = [s / 4 for s in range(400) if answer(messages, 0, (0, 1), at_s=s / 4)]
    assert sent == [1, 3, 7, 15, 31, 47, 63, 79, 95]  # after 1, 2, 4, 8, 16 s, and not less often


def test_the_time_out_is_measured_and_begins_anew_with_each_news():
    messages = retained(3, every_s=0)
    messages.acknowledge(1, NOTHING, round(0.2 * S))  # measured: 0.2 + 4 * 0.1 = 0.6 s
    assert answer(messages, 1, (1, 3), at_s=0.8 - 1e-9) == []
    assert answer(messages, 1, (1, 3), at_s=0.8) == [1]


def test_what_is_late_is_not_sent_again_however_late_while_others_arrive():
    messages = retained(100, every_s=0)
    assert [answer(messages, seq, (seq, 100), at_s=seq / 4) for seq in range(1, 100)] == [[]] * 99


def test_an_outage_is_not_taken_for_the_time_that_messages_take():
    messages = retained(3, every_s=0)
    messages.acknowledge(1, NOTHING, round(0.1 * S))  # 0.1 + 4 * 0.05 = 0.3, at least 0.5 s
    messages.acknowledge(2, NOTHING, 10 * S)  # sent before 9.9 s of silence
    assert answer(messages, 2, (2, 3), at_s=10.5 - 1e-9) == []
    assert answer(messages, 2, (2, 3), at_s=10.5) == [2]


def test_what_may_have_come_in_two_ways_overtakes_nothing():
    """Karn's rule: message 0 arrives after its repair was sent, but was it the repair?"""
    messages = retained(2, every_s=0)
    assert answer(messages, 0, (0, 2), at_s=1) == [0]
    assert answer(messages, 1, (1, 2), at_s=1.05) == [1]  # of message 1 nothing is known for 1.05 s
    assert answer(messages, 1, (1, 2), at_s=2.05) == []


def test_what_is_not_held_is_not_sent_again():
    messages = retained(10, every_s=0)
    assert answer(messages, 4, (0, 6), (9, 1000), at_s=0.1) == [4, 5]


@pytest.mark.parametrize("ranges", [[], [(3, 3)], [(5, 2)], [(-5, 0)], [(10, 20)], [(2**62, 2**62 + 5)]])
def test_ranges_that_ask_for_nothing_get_nothing(ranges):
    assert answer(retained(10, every_s=0), 0, *ranges, at_s=10) == []


def test_overlapping_ranges_send_a_message_once():
    messages = retained(6, every_s=0)
    assert answer(messages, 0, (0, 3), (1, 4), (0, 4), (6, 6), at_s=0.1) == [0, 1, 2, 3]


def test_an_acknowledgement_while_resending_ends_it():
    messages = retained(6, every_s=0)
    messages.acknowledge(0, [(0, 5), (6, 6)], S)
    due = messages.due(iter([(0, 5)]), S)
    assert next(due)[:2] == bytes([0, 0])
    messages.acknowledge(4, [(4, 5), (6, 6)], S)
    assert [payload[1] for payload in due] == [4]


def test_a_new_receiver_gets_what_its_predecessor_took_with_it():
    messages = retained(6, every_s=0)
    assert answer(messages, 2, (2, 3), (6, 6), at_s=0.1) == [2]
    messages.acknowledge(2, [(4, 5), (6, 6)], round(0.2 * S))  # all but 4 has come, and is not taken over
    assert answer(messages, 2, (2, 6), at_s=0.3) == [2, 3, 4, 5]


# ------------------------------------------------------------------ how much at a time


def test_the_time_out_follows_rfc_6298():
    time = AcknowledgedTime()
    assert time.timeout_ns == S
    time.measure(2 * S)  # smoothed 2, variation 1
    assert time.timeout_ns == 6 * S
    time.measure(2 * S)  # variation 0.75
    assert time.timeout_ns == 5 * S
    time.measure(4 * S)  # variation 0.75 + (2 - 0.75) / 4 = 1.0625, smoothed 2.25
    assert time.timeout_ns == 6.5 * S


def test_the_time_out_has_a_least_value():
    time = AcknowledgedTime()
    time.measure(10 * MS)  # 10 + 4 * 5 = 30 ms
    assert time.timeout_ns == 500 * MS


def test_the_window_doubles_until_a_loss_and_then_grows_by_a_message_per_window():
    window = RepairWindow(200.0)
    for _ in range(2):
        window.arrived(100)
    assert window.size_bytes == 400
    window.lost(100, order=3, newest_order=7)
    assert window.size_bytes == 200
    for _ in range(2):
        window.arrived(100)
    assert window.size_bytes == pytest.approx(200 + 50 + 40)  # 100 * 100 / 200, 100 * 100 / 250


def test_losses_among_what_was_sent_before_the_window_shrank_are_one():
    window = RepairWindow(800.0)
    for order in (3, 4, 7):
        window.lost(100, order, newest_order=7)
    assert window.size_bytes == 400
    window.lost(100, order=8, newest_order=9)
    assert window.size_bytes == 200


def test_the_window_holds_a_message():
    window = RepairWindow(150.0)
    window.lost(100, order=1, newest_order=1)
    assert window.size_bytes == 100


def test_repairs_on_their_way_fit_the_window():
    messages = retained(101, size=64 << 10, every_s=0)  # the window is 4 of them at first
    assert answer(messages, 0, (0, 100), (101, 101), at_s=0.1) == [0, 1, 2, 3]
    assert answer(messages, 0, (0, 100), (101, 101), at_s=0.2) == []
    assert answer(messages, 2, (2, 100), (101, 101), at_s=0.3) == [4, 5, 6, 7]  # two have come: 6
    assert answer(messages, 8, (8, 100), (101, 101), at_s=0.4) == list(range(8, 20))  # six more: 12


def test_a_lost_repair_halves_the_window_and_goes_first():
    messages = retained(101, size=64 << 10, every_s=0)
    assert answer(messages, 0, (0, 100), (101, 101), at_s=0.1) == [0, 1, 2, 3]
    # 1, 2 and 3 have come: 7, and halved for the lost 0.
    assert answer(messages, 0, (0, 1), (4, 100), (101, 101), at_s=0.2) == [0, 4, 5]


def test_what_only_seems_lost_is_tried_with_one_message():
    messages = retained(100, every_s=0)
    assert answer(messages, 0, (0, 100), at_s=2) == [0]
    assert answer(messages, 1, (1, 100), at_s=2.1) == [1, 2]
    assert answer(messages, 3, (3, 100), at_s=2.2) == [3, 4, 5, 6]


def test_when_nothing_is_missing_the_window_is_forgotten():
    messages = retained(11, size=64 << 10, every_s=0)
    assert answer(messages, 0, (0, 10), (11, 11), at_s=0.1) == [0, 1, 2, 3]
    assert answer(messages, 11, at_s=0.2) == []
    send(messages, 11, size=64 << 10, at_s=0.3)
    assert answer(messages, 11, (11, 21), (22, 22), at_s=0.4) == [11, 12, 13, 14]


def test_what_was_given_up_on_its_way_leaves_room():
    messages = retained(9, size=64 << 10, every_s=0, max_bytes=9 * 65536)
    assert answer(messages, 0, (0, 8), (9, 9), at_s=0.1) == [0, 1, 2, 3]
    send(messages, 2, size=64 << 10, at_s=0.1)
    assert messages.given_up == 2
    assert answer(messages, 0, (2, 8), (9, 9), at_s=0.2) == [4, 5]


def test_a_full_list_of_gaps_says_nothing_of_what_is_behind_it():
    messages = retained(131, size=3000, every_s=0)
    odd = [(seq, seq + 1) for seq in range(1, 130, 2)]  # 65 gaps, of which 64 are named
    assert answer(messages, 1, *odd[1:], (131, 131), at_s=0.1) == list(range(3, 130, 2))
    answer(messages, 1, *odd[:-1], (131, 131), at_s=0.2)
    assert answer(messages, 1, *odd[:-1], (131, 131), at_s=0.2) == []
    send(messages, 1, size=3000, at_s=0.3)
    assert 129 in answer(messages, 127, (127, 128), (129, 130), (132, 132), at_s=0.4)


# ------------------------------------------------------------------ over a way that is narrow, or broken for a while

TICK_MS = 20
SIZE = 6000
EVERY_TICKS = 2
"""A message each 40 ms: 150 kB/s."""
ANSWER_TICKS = 5
BUFFER_BYTES = 320 * 1024


class Narrow:
    """A stream over a connection that carries so many bytes a second, and drops what finds its buffer full."""

    def __init__(self, bytes_per_s, one_connection=True):
        self.sender = RetainedMessages(1000 * S, 10**9, one_connection=one_connection)
        self.receiver = OrderedReceiver()
        self.bytes_per_s = bytes_per_s
        self.ticks = self.fresh = self.resent = self.dropped = 0
        self._buffer = deque()
        self._credit = 0.0

    def run(self, seconds, silent=False, fresh=True):
        """Go on for a while; return when it was known that nothing is missing any more, in seconds, or None."""
        complete = None
        for tick in range(round(seconds * 1000 / TICK_MS)):
            self.ticks += 1
            now_ns = self.ticks * TICK_MS * MS
            if fresh and self.ticks % EVERY_TICKS == 0:
                self._put(self.fresh)
                self.sender.retain(self.fresh, self.fresh.to_bytes(2, "big") + bytes(SIZE - 2), now_ns)
                self.fresh += 1
            if silent:
                continue
            self._carry()
            if self.ticks % ANSWER_TICKS == 0:
                self._answer(now_ns)
                if complete is None and self.receiver.received_all:
                    complete = tick * TICK_MS / 1000
        return complete

    def _put(self, seq):
        if SIZE * (len(self._buffer) + 1) > BUFFER_BYTES:
            self.dropped += 1
        else:
            self._buffer.append(seq)

    def _carry(self):
        self._credit = min(self._credit + self.bytes_per_s * TICK_MS / 1000, self.bytes_per_s)
        while self._buffer and self._credit >= SIZE:
            self._credit -= SIZE
            seq = self._buffer.popleft()
            self.receiver.accept(1, seq, seq)

    def _answer(self, now_ns):
        self.receiver.note_head(StreamHead(1, self.sender.oldest_seq, self.sender.next_seq))
        self.receiver.take_ready()
        acknowledgement = self.receiver.acknowledgement()
        self.sender.acknowledge(acknowledgement.next_seq, acknowledgement.missing, now_ns)
        for payload in self.sender.due(iter(acknowledgement.missing.tolist()), now_ns):
            self.resent += 1
            self._put(int.from_bytes(payload[:2], "big"))


@pytest.mark.parametrize("one_connection", [True, False])
def test_a_way_that_just_carries_the_stream_sees_no_repairs_however_full_it_is(one_connection):
    way = Narrow(150_000, one_connection)
    way.run(1)
    way.run(2, silent=True)  # 50 messages wait from now on: 2 s, far more than was measured before
    way.run(60)
    assert (way.dropped, way.resent, way.receiver.duplicates) == (0, 0, 0)


@pytest.mark.parametrize("one_connection", [True, False])
def test_too_narrow_a_way_sees_no_storm_and_in_the_end_everything_comes(one_connection):
    """120 of 150 kB/s, for two minutes."""
    way = Narrow(120_000, one_connection)
    way.run(120)
    assert way.dropped > 0.1 * way.fresh  # 20 % at least, less what the buffer still holds and the first seconds
    assert way.resent < 0.25 * way.fresh
    assert way.run(60, fresh=False) is not None
    assert way.receiver.duplicates <= 3
    assert len(way.sender) == 0


def test_an_outage_on_a_wide_way_is_repaired_within_a_few_acknowledgements():
    """Of 250 messages of 6 kB the buffer holds 54 and 196 are lost, besides repairs that come in too large a burst."""
    way = Narrow(10_000_000)
    way.run(5)
    way.run(10, silent=True)
    recovered = way.run(5)
    assert recovered <= 1.0
    assert 196 <= way.dropped <= 300
    assert (way.resent, way.receiver.duplicates) == (way.dropped, 0)


def test_an_outage_at_the_end_of_a_stream_is_repaired_too():
    """Nothing new overtakes what was lost: it is found by the time-out, and one message at first is tried."""
    way = Narrow(10_000_000)
    way.run(5)
    way.run(10, silent=True)
    assert way.run(5, fresh=False) <= 3.0
    assert (way.resent, way.receiver.duplicates) == (way.dropped, 0)


def test_repairs_of_a_way_with_little_to_spare_come_in_time_and_once():
    """170 kB/s, and 5 s of outage: 72 messages (432 kB) are lost, and 20 kB/s are left for them."""
    way = Narrow(170_000)
    way.run(5)
    way.run(5, silent=True)
    assert way.run(120) <= 60
    assert way.receiver.duplicates == 0
