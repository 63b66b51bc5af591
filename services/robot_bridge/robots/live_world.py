"""A world that goes on by the clock in a thread of its own, whatever the action cycle is doing.

What the cycle wants of it are orders, each with the time at which it was given: the thread lets the world go on until
then before it obeys. What the world shows lies ready: the newest packet, and frames in the camera's bounded buffer. So
the cycle takes what is there and never waits for a picture. It waits only where an attempt begins, for the first one.
"""

from __future__ import annotations

import functools
import itertools
import logging
import sys
import traceback
from collections import deque
from collections.abc import Callable

import numpy as np

from common.clock import Clock
from common.errors import RelodError, ServiceError
from services.robot_bridge.robots.lag_watch import LAG_NS, LagWatch
from services.robot_bridge.robots.sensed_world import LONGEST_GAP_NS, SensedWorld, SensorPacket

logger = logging.getLogger(__name__)

LONGEST_WAIT_S = 10.0
"""For the first picture of an attempt; opening OpenGL takes a large part of a second."""
LONG_WAIT_S = 2.0
"""After this the log says what it waits for."""
CLOSING_TAKES_S = 0.5
"""Longest wait for the thread to end, which it does between two packets or pictures; one that hangs is left behind."""
_Order = Callable[[], None]


class LiveWorld:
    """Drives a :class:`SensedWorld`, which is its thread's alone from now on, and does for others what that does."""

    def __init__(self, world: SensedWorld, clock: Clock) -> None:
        """Args:
        world: what lives, from :meth:`begin` on.
        clock: what it lives by.
        """
        self._world, self._clock = world, clock
        self.camera = world.camera
        # Appended to by the cycle's thread, taken from by the world's: a deque needs no lock for that.
        self._orders: deque[tuple[int, _Order]] = deque()
        self._failure: BaseException | None = None
        self._ended = self._given_up = False
        self._lag_watch = LagWatch()
        self._changed = clock.condition()
        """Held for an instant only: to wait, to say that there is an order in a hurry, or that it was carried out."""
        self._hurried = self._placed = 0
        """Orders in a hurry, given and carried out."""
        self._thread = clock.thread(self._run, "simulated world")

    def begin(self) -> None:
        """Begin to live, and wait until there is a packet and a frame.

        Raises:
            ServiceError: there is none after :data:`LONGEST_WAIT_S`; or the world has ended: nothing can be drawn here.
        """
        self._thread.start()
        self._carry_out_at_once(lambda: None)

    @property
    def newest(self) -> SensorPacket:
        """The newest packet of the sensors."""
        return self._world.newest

    @property
    def packets(self) -> int:
        """Packets of the sensors, ever."""
        return self._world.packets

    def counters(self) -> dict[str, float]:
        """What the robot counts."""
        return self._world.counters()

    def advance_to(self, now_ns: int) -> None:
        """Tell that the world has ended, if it has, or falls behind the clock; it goes on by itself.

        Raises:
            ServiceError: what has ended it.
        """
        self._check()
        self._tell_if_behind(now_ns)

    def place(self, goal: np.ndarray, start: np.ndarray, seed: int) -> None:
        """Place goal and robot, and wait until there is a packet and a frame of it.

        Raises:
            ServiceError: there is none after :data:`LONGEST_WAIT_S`, or the world has ended.
        """
        self._carry_out_at_once(functools.partial(self._world.place, goal, start, seed, self._clock.now_ns))

    def command(self, action: np.ndarray) -> None:
        """Let the robot obey ``action`` (A,) from now on."""
        self._orders.append((self._clock.now_ns(), functools.partial(self._world.command, np.array(action))))

    def stop(self) -> None:
        """Let the robot brake and rest."""
        self._orders.append((self._clock.now_ns(), self._world.stop))

    def give_up(self) -> None:
        """Let whoever waits wait no longer; for any thread."""
        self._given_up = True
        with self._changed:
            self._changed.notify_all()

    def close(self) -> None:
        """End the thread; the world stands still from now on."""
        self._ended = True
        with self._changed:
            self._changed.notify_all()
        self._thread.join(CLOSING_TAKES_S)
        if self._thread.is_alive():
            logger.error("the simulated world's thread hangs and is left behind, in\n%s", self._innermost_calls())

    def _carry_out_at_once(self, order: _Order) -> None:
        def carry_out() -> None:
            order()
            with self._changed:
                self._placed += 1
                self._changed.notify_all()

        given_ns = self._clock.now_ns()
        self._orders.append((given_ns, carry_out))
        with self._changed:
            self._hurried += 1
            self._changed.notify_all()
        if not self._carried_out_by(given_ns + round(LONG_WAIT_S * 1e9)):
            logger.warning("waiting for the simulated world's first picture; it is in\n%s", self._innermost_calls())
        if not self._carried_out_by(given_ns + round(LONGEST_WAIT_S * 1e9)):
            raise ServiceError(
                f"the simulated world has shown no picture for {LONGEST_WAIT_S:g} s: it is too slow, or hangs, in\n"
                f"{self._innermost_calls()}"
            )

    def _carried_out_by(self, deadline_ns: int) -> bool:
        """False if the orders in a hurry have not been carried out by then; who has given up does not want to know."""
        with self._changed:
            while self._placed < self._hurried and self._failure is None and not self._given_up:
                if not self._clock.wait_until(deadline_ns, self._changed):
                    break
            carried_out = self._given_up or self._placed == self._hurried
        self._check()
        return carried_out

    def _check(self) -> None:
        if self._failure is not None:
            what = "" if isinstance(self._failure, RelodError) else f"{type(self._failure).__name__}: "
            raise ServiceError(f"the simulated world has ended: {what}{self._failure}") from self._failure

    def _tell_if_behind(self, now_ns: int) -> None:
        world_ns = self._world.now_ns
        if world_ns is None:  # Given up before its time began.
            return
        lag_ns = now_ns - world_ns - self._world.longest_rest_ns
        if self._lag_watch.look(lag_ns, now_ns):
            logger.warning(
                "the simulated world is %.1f s behind the clock: %s, or its camera, is slower than real time, or "
                "hangs; just now it was in\n%s",
                lag_ns * 1e-9,
                type(self._world.robot).__name__,
                self._innermost_calls(),
            )

    def _innermost_calls(self) -> str:
        """Where the world's thread is at this moment, as in a traceback; without the lines, which are on the disk."""
        frame = sys._current_frames().get(self._thread.ident or 0)
        if frame is None:
            return "  (it has ended)"
        calls = ((at.f_code, line) for at, line in traceback.walk_stack(frame))
        inner = itertools.takewhile(lambda call: call[0].co_qualname != self._run.__qualname__, calls)
        places = [f'  File "{code.co_filename}", line {line}, in {code.co_qualname}' for code, line in inner]
        return "\n".join(reversed(places))

    # ------------------------------------------------------------------ the world's thread

    def _run(self) -> None:
        try:
            self._world.camera.open()
            self._world.advance_to(self._clock.now_ns())  # Time begins when the camera can see it.
            while not self._ended:
                self._live_until_now()
                with self._changed:
                    if self._placed == self._hurried and not self._ended:
                        self._clock.wait_until(self._world.next_due_ns, self._changed)
        except (Exception, SystemExit) as failure:
            if not isinstance(failure, RelodError):  # A robot's own fault: whoever wrote it wants to know where.
                logger.exception("the simulated world has ended")
            with self._changed:
                self._failure = failure
                self._changed.notify_all()
        finally:
            self._world.close()

    def _live_until_now(self) -> None:
        now_ns = self._clock.now_ns()
        while self._orders and not self._ended:
            given_ns, carry_out = self._orders.popleft()
            self._live_until(given_ns)
            carry_out()
        self._live_until(now_ns)

    def _live_until(self, then_ns: int) -> None:
        """From what is due to what is due next, however long the world takes for it."""
        while not self._ended:
            clock_ns = self._clock.now_ns()
            # What was before a placement that is waited for need not be made up.
            forgiven_ns = LONGEST_GAP_NS if self._placed == self._hurried else LAG_NS
            self._world.forget_before(clock_ns - forgiven_ns)
            due_ns = min(self._world.next_due_ns, then_ns)
            self._world.advance_to(due_ns, clock_ns)
            if due_ns == then_ns:
                return
