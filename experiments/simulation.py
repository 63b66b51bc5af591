"""Simulated time: threads that run one after the other, in an order that is the same every time.

The services are written as threads that wait through their clock (:class:`common.clock.Clock`). Under
:class:`SimulatedClock` only one of them runs at any moment; when it waits, the next one that can go on does, in the
order in which they became ready, and only when nobody can go on does time move, at once, to the next deadline. So
computing takes no time, waiting takes no real time, and a run depends on its seeds alone.
"""

from __future__ import annotations

import heapq
import itertools
import threading
from collections import deque
from collections.abc import Callable

from common.run_settings import RunSettings
from common.topics import Topic
from common.transport import Answer, InMemoryNetwork, InMemoryTransport, Subscription

START_NS = 1_000_000_000


class SimulationEnded(BaseException):
    """Ends a simulated thread wherever it waits; no ``except Exception`` of a service may stop it.

    The first thread gets it only from an interruption.
    """


class SimulatedClock:
    """The clock, and the scheduler, of a simulation. The thread that makes it is the first to run."""

    def __init__(self) -> None:
        self.interrupted: Callable[[], bool] = lambda: False
        """Asked whenever a thread waits. Once it says so the first thread is next, whatever else is due, and its waits
        raise :class:`SimulationEnded`."""
        self._now_ns = START_NS
        self._order = itertools.count()
        self._timers: list[tuple[int, int, Callable[[], None]]] = []
        self._ready: deque[_Turn] = deque()
        self._turns: dict[threading.Thread, _Turn] = {}
        self._ended = False
        self._running = _Turn()
        self._turns[threading.current_thread()] = self._running
        self._first = self._running

    def now_ns(self) -> int:
        """Simulated time, nanoseconds."""
        return self._now_ns

    def wait_until(self, deadline_ns: int, condition: threading.Condition) -> bool:
        """See :class:`common.clock.Clock`."""
        return deadline_ns > self._now_ns and self._wait(condition, deadline_ns)

    def wait(self, condition: threading.Condition, timeout_s: float | None = None) -> bool:
        """See :class:`common.clock.Clock`."""
        return self._wait(condition, None if timeout_s is None else self._now_ns + round(timeout_s * 1e9))

    def condition(self) -> threading.Condition:
        """See :class:`common.clock.Clock`."""
        return _SimulatedCondition(self)

    def thread(self, target: Callable[[], None], name: str) -> threading.Thread:
        """See :class:`common.clock.Clock`."""
        return _SimulatedThread(self, target, name)

    def call_later(self, delay_ns: int, callback: Callable[[], None]) -> None:
        """Call ``callback`` when ``delay_ns`` have passed, between two turns; it must not wait."""
        heapq.heappush(self._timers, (self._now_ns + delay_ns, next(self._order), callback))

    def end(self) -> None:
        """End all other threads where they wait; called by the thread that made the clock, when it is done."""
        self._ended = True
        others = [turn for turn in self._turns.values() if turn is not self._first]
        for turn in others:
            self._ready = deque([self._first])
            self._running = turn
            turn.baton.release()
            self._first.baton.acquire()

    def _wait(self, condition: threading.Condition, deadline_ns: int | None) -> bool:
        if self._ended:
            raise SimulationEnded
        assert isinstance(condition, _SimulatedCondition)
        turn = self._running
        turn.notified = False
        turn.waits += 1
        condition.waiting.append(turn)
        if deadline_ns is not None:
            waits = turn.waits

            def time_out() -> None:
                if turn.waits == waits and turn in condition.waiting:
                    condition.waiting.remove(turn)
                    self._ready.append(turn)

            heapq.heappush(self._timers, (deadline_ns, next(self._order), time_out))
        self._hand_over(turn)
        return turn.notified

    def _hand_over(self, turn: _Turn) -> None:
        """Let the next thread run; return when it is this one's turn again."""
        following = self._next()
        if following is not turn:
            self._running = following
            following.baton.release()
            turn.baton.acquire()
        if self.interrupted() if turn is self._first else self._ended:
            raise SimulationEnded

    def _next(self) -> _Turn:
        if self.interrupted():
            return self._first
        while not self._ready:
            if not self._timers:
                raise RuntimeError("every simulated thread waits for another one")
            at_ns, _, act = heapq.heappop(self._timers)
            self._now_ns = max(self._now_ns, at_ns)
            act()
        return self._ready.popleft()

    def _begin(self, thread: threading.Thread) -> _Turn:
        turn = self._turns[thread] = _Turn()
        self._ready.append(turn)
        return turn

    def _notify(self, turn: _Turn) -> None:
        turn.notified = True
        self._ready.append(turn)

    def _finish(self, thread: threading.Thread) -> None:
        """A thread's last act: hand over for good."""
        del self._turns[thread]
        following = self._next()
        self._running = following
        following.baton.release()


class _Turn:
    """One thread's place in the order."""

    def __init__(self) -> None:
        self.baton = threading.Lock()
        """Released to whoever's turn it is, who takes it."""
        self.baton.acquire()
        self.notified = False
        self.waits = 0
        """Waits begun; a time-out of an earlier one means nothing."""


class _SimulatedCondition(threading.Condition):
    """A condition without a lock: nobody else runs while it is held."""

    def __init__(self, clock: SimulatedClock) -> None:
        super().__init__()
        self._clock = clock
        self.waiting: deque[_Turn] = deque()

    def __enter__(self) -> bool:
        return True

    def __exit__(self, *_: object) -> None:
        pass

    def wait(self, timeout: float | None = None) -> bool:
        return self._clock.wait(self, timeout)

    def notify(self, n: int = 1) -> None:
        for _ in range(min(n, len(self.waiting))):
            self._clock._notify(self.waiting.popleft())

    def notify_all(self) -> None:
        self.notify(len(self.waiting))


class _SimulatedThread(threading.Thread):
    """A thread that runs only when it is its turn."""

    def __init__(self, clock: SimulatedClock, target: Callable[[], None], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._clock, self._work = clock, target
        self._ended = clock.condition()
        self._has_ended = False

    def start(self) -> None:
        self._turn = self._clock._begin(self)
        super().start()

    def run(self) -> None:
        self._turn.baton.acquire()
        try:
            if not self._clock._ended:
                self._work()
        except SimulationEnded:
            pass
        finally:
            self._has_ended = True
            self._ended.notify_all()
            self._clock._finish(self)

    def join(self, timeout: float | None = None) -> None:
        if not self._has_ended:
            self._clock.wait(self._ended, timeout)

    def is_alive(self) -> bool:
        return self.ident is not None and not self._has_ended


class SimulatedNetwork(InMemoryNetwork):
    """Carries messages between the services of a simulation; some take their time."""

    def __init__(self, clock: SimulatedClock) -> None:
        super().__init__()
        self._clock = clock
        self.delays_ns: dict[str, int | Callable[[], int]] = {}
        """Topic -> time from publication (of a query: from the answer) to arrival, each time or always; 0 if absent."""
        self.question_delays_ns: dict[str, int | Callable[[], int]] = {}
        """Topic of a query -> time from the question to its arrival."""

    def transport_of(self, service: str, run: RunSettings) -> InMemoryTransport:
        """Join the mesh as ``service``, which makes no difference here."""
        return self.transport(run)

    def deliver(
        self, topic: Topic, payload: bytes, sender: InMemoryTransport, subscriptions: list[Subscription]
    ) -> None:
        """See :class:`InMemoryNetwork`."""
        deliver = super().deliver
        delay_ns = _drawn(self.delays_ns.get(topic.name, 0))
        if delay_ns:
            self._clock.call_later(delay_ns, lambda: deliver(topic, payload, sender, subscriptions))
        else:
            deliver(topic, payload, sender, subscriptions)

    def ask(self, topic: Topic, payload: bytes, answer: Answer, timeout_s: float) -> bytes | None:
        """See :class:`InMemoryNetwork`; whoever asks waits meanwhile."""
        there_ns = _drawn(self.question_delays_ns.get(topic.name, 0))
        back_ns = _drawn(self.delays_ns.get(topic.name, 0))
        if there_ns + back_ns > timeout_s * 1e9:
            self._pass(round(timeout_s * 1e9))
            return None
        self._pass(there_ns)
        answered = answer(payload)
        self._pass(back_ns)
        return answered

    def _pass(self, delay_ns: int) -> None:
        if delay_ns:
            self._clock.wait_until(self._clock.now_ns() + delay_ns, self._clock.condition())


def _drawn(delay_ns: int | Callable[[], int]) -> int:
    return delay_ns() if callable(delay_ns) else delay_ns
