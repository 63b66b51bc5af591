"""Deadlines are absolute, lateness is told, and the fake clock moves only when told."""

import threading

import pytest

from common.clock import CycleKeeper, FakeClock, Lateness, SkewedClock, SystemClock

MS = 1_000_000


def started(period_ms=40, tolerance=0.1, at_ms=1000):
    keeper = CycleKeeper(period_ms * MS, tolerance)
    keeper.start(at_ms * MS)
    return keeper


def test_the_first_deadline_is_one_period_after_the_start():
    assert started(at_ms=1000).deadline_ns == 1040 * MS


def test_being_late_does_not_shift_the_deadlines_after_it():
    keeper = started()
    for now_ms, deadline_ms in ((1041, 1080), (1099, 1120), (1120, 1160), (1163, 1200)):
        keeper.next(now_ms * MS)
        assert keeper.deadline_ns == deadline_ms * MS


def test_many_cycles_a_little_late_do_not_drift():
    keeper = started()
    for cycle in range(1, 10_001):
        keeper.next(keeper.deadline_ns + 3 * MS)
        assert keeper.deadline_ns == (1000 + 40 * (cycle + 1)) * MS


def test_meeting_a_deadline_early_or_exactly_is_not_late():
    assert started().next(1040 * MS) == Lateness(0, False, 0)
    assert started().next(1030 * MS) == Lateness(-10 * MS, False, 0)


@pytest.mark.parametrize(
    ("late_ns", "overrun"), [(0, False), (4 * MS - 1, False), (4 * MS, False), (4 * MS + 1, True), (39 * MS, True)]
)
def test_an_overrun_is_a_deadline_missed_by_more_than_a_tenth_of_the_period(late_ns, overrun):
    lateness = started(period_ms=40).next(1040 * MS + late_ns)
    assert lateness == Lateness(late_ns, overrun, 0)


def test_the_tolerance_is_a_share_of_the_period():
    assert not started(period_ms=100, tolerance=0.25).next(1125 * MS).overrun
    assert started(period_ms=100, tolerance=0.25).next(1125 * MS + 1).overrun
    assert started(period_ms=100, tolerance=0.0).next(1100 * MS + 1).overrun


@pytest.mark.parametrize(
    ("now_ms", "skipped", "deadline_ms"),
    [
        (1079, 0, 1080),  # 39 ms late: the next deadline can still be met
        (1080, 1, 1120),  # a whole period: it cannot
        (1081, 1, 1120),
        (1119, 1, 1120),
        (1120, 2, 1160),
        (2040, 25, 2080),
    ],
)
def test_whole_periods_that_were_missed_are_given_up(now_ms, skipped, deadline_ms):
    keeper = started()
    assert keeper.next(now_ms * MS).skipped == skipped
    assert keeper.deadline_ns == deadline_ms * MS


def test_the_next_deadline_is_always_ahead_and_on_the_grid():
    keeper = started(period_ms=7, at_ms=0)
    now = 0
    for late in (0, 1, 6, 7, 8, 13, 14, 15, 70, 1000, 3):
        now = keeper.deadline_ns + late * MS
        keeper.next(now)
        assert now < keeper.deadline_ns <= now + 7 * MS
        assert keeper.deadline_ns % (7 * MS) == 0


def test_a_stretched_cycle_moves_the_deadlines_and_is_not_late():
    keeper = started()
    keeper.stretch(1055 * MS)
    assert keeper.deadline_ns == 1055 * MS
    assert keeper.next(1055 * MS) == Lateness(0, False, 0)
    assert keeper.deadline_ns == 1095 * MS


def test_stretching_never_shortens_a_cycle():
    keeper = started()
    keeper.stretch(1010 * MS)
    assert keeper.deadline_ns == 1040 * MS


@pytest.mark.parametrize("period_ns", [0, -1])
def test_a_period_takes_time(period_ns):
    with pytest.raises(ValueError, match="expected more than 0"):
        CycleKeeper(period_ns)


def test_the_fake_clock_stands_still_until_it_is_told():
    clock = FakeClock(5)
    assert clock.now_ns() == clock.now_ns() == 5
    clock.advance(0.25)
    assert clock.now_ns() == 250_000_005


def test_the_fake_clock_never_goes_back():
    clock = FakeClock(100)
    clock.advance_to(300)
    clock.advance_to(200)
    assert clock.now_ns() == 300


def test_waiting_on_the_fake_clock_takes_exactly_the_time_to_the_deadline():
    clock, condition = FakeClock(100), threading.Condition()
    with condition:
        assert clock.wait_until(700, condition) is False
        assert clock.now_ns() == 700
        assert clock.wait_until(650, condition) is False
        assert clock.now_ns() == 700


def test_the_system_clock_goes_on():
    clock = SystemClock()
    before = clock.now_ns()
    assert clock.now_ns() >= before


def test_the_system_clock_does_not_wait_for_what_has_passed():
    clock, condition = SystemClock(), threading.Condition()
    with condition:
        assert clock.wait_until(clock.now_ns(), condition) is False
        assert clock.wait_until(clock.now_ns() - 10**18, condition) is False


def test_the_system_clock_waits_until_the_deadline():
    clock, condition = SystemClock(), threading.Condition()
    deadline_ns = clock.now_ns() + 5 * MS
    with condition:
        while clock.now_ns() < deadline_ns:
            assert clock.wait_until(deadline_ns, condition) is False  # nobody notifies
    assert clock.now_ns() >= deadline_ns


def test_the_system_clock_returns_when_it_is_notified():
    clock, condition = SystemClock(), threading.Condition()

    def notify():
        with condition:
            condition.notify()

    with condition:
        thread = threading.Thread(target=notify)
        thread.start()  # it gets the lock only while this thread waits
        assert clock.wait_until(clock.now_ns() + 10**11, condition) is True
    thread.join()


# ------------------------------------------------------------------ another computer's clock


def test_a_skewed_clock_is_off_by_its_offset_and_gains_its_drift():
    beneath = FakeClock(1_000)
    clock = SkewedClock(beneath, offset_s=3.0, drift_ppm=50.0)
    assert clock.now_ns() == 3_000_001_000
    beneath.advance(100.0)
    assert clock.now_ns() == 103_000_001_000 + 5 * MS  # 50 us a second


def test_a_skewed_clock_jumps_when_told():
    clock = SkewedClock(FakeClock(1_000), drift_ppm=-20.0)
    clock.jump(2.5)
    assert clock.now_ns() == 2_500_001_000
    clock.jump(-4.0)
    assert clock.now_ns() == -1_499_999_000


@pytest.mark.parametrize("drift_ppm", [-300.0, 0.0, 50.0, 499.0])
def test_who_waits_on_a_skewed_clock_wakes_when_it_shows_the_deadline(drift_ppm):
    beneath = FakeClock(123_456_789)
    clock = SkewedClock(beneath, offset_s=1.7, drift_ppm=drift_ppm)
    condition = clock.condition()
    for _ in range(100):
        deadline_ns = clock.now_ns() + 40 * MS + 7
        with condition:
            assert clock.wait_until(deadline_ns, condition) is False
        assert deadline_ns <= clock.now_ns() <= deadline_ns + 1


def test_a_skewed_clock_notifies_and_times_out_as_the_one_beneath():
    clock = SkewedClock(SystemClock(), offset_s=5.0)
    condition, woken = clock.condition(), []

    def notify():
        with condition:
            condition.notify()

    with condition:
        thread = clock.thread(notify, "notify")
        thread.start()
        woken.append(clock.wait(condition))
        woken.append(clock.wait(condition, 0.001))
    thread.join()
    assert woken == [True, False]
