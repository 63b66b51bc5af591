"""What one side's user hears of the other side, and when that ends the services here."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from common.console import Console
from deploy.network import Host
from deploy.other_side import ENDED, News
from deploy.watch import OVERTIME_S, EarlyEnd

SILENT_S = 10.0
"""The other launcher has not been heard of for so long: the user is told."""
INTERRUPTED_S = 3.0
"""After Ctrl-C there, the longest time in which the services here should have heard of the run's end."""


class Heard(Protocol):
    """What is known of the other side."""

    there: Host

    @property
    def news(self) -> News | None: ...

    @property
    def has_record(self) -> bool: ...

    @property
    def silent_s(self) -> float: ...


class Listener:
    """Tells this side's user what comes from the other side, and judges whether the run can go on."""

    def __init__(
        self,
        other: Heard,
        console: Console,
        *,
        robot_is_here: bool,
        run_has_begun: Callable[[], bool],
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._other, self._console, self._now_s = other, console, now_s
        self._robot_is_here, self._run_has_begun = robot_is_here, run_has_begun
        self._said = 0
        self._silent = False
        self._ended_s: float | None = None
        self._over = False
        self._left_alone = False

    def early_end(self) -> EarlyEnd | None:
        """Say what is new; return why this side has to end, if it has to."""
        self.listen()
        news = self._other.news
        if news is None or self._ended_s is None:
            return None
        there, since_s = self._other.there, self._now_s() - self._ended_s
        # The news of a short run's end are faster than its record, which tells that it had begun.
        knows = self._robot_is_here or self._other.has_record or since_s > INTERRUPTED_S
        if knows and not self._run_has_begun():
            return EarlyEnd(f"{there} has ended before the run had begun, and so it ends here, too", not news.succeeded)
        limit_s = OVERTIME_S if news.succeeded else INTERRUPTED_S
        if not self._robot_is_here and since_s > limit_s:
            return EarlyEnd(f"{there} ended {since_s:.0f} s ago, and some services here have not heard of it", False)
        return None

    def note_end(self) -> None:
        """This side's services have ended."""
        self._over = True

    @property
    def was_left_alone(self) -> bool:
        """True if the other side ended early, and this side's services went on."""
        return self._left_alone

    def listen(self) -> None:
        """Say what is new on the other side."""
        news, there = self._other.news, self._other.there
        if news is None:
            return
        for text in news.said[self._said :]:
            self._console.error(f"{there}: {text}")
        self._said = max(self._said, len(news.said))
        if news.phase == ENDED and self._ended_s is None:
            self._ended_s = self._now_s()
            self._console.line("\n".join(self._ending(news)))
        silent = self._other.silent_s > SILENT_S
        if silent != self._silent and news.phase != ENDED:
            self._silent = silent
            self._console.error("\n".join(self._silence(news)) if silent else f"the launcher on {there} answers again")

    def _silence(self, news: News) -> list[str]:
        there = self._other.there
        lines = [f"the launcher on {there} has not answered for {SILENT_S:.0f} s; the services here go on"]
        if self._robot_is_here and news.restart and not self._over:
            lines += [
                f"  if only the network is down, the services on {there} go on, too, until it is back",
                "  if that launcher was killed, they ended with it; end here with Ctrl-C, or start them again there:",
            ]
            lines += [f"  {command}" for command in news.restart]
        return lines

    def _ending(self, news: News) -> list[str]:
        lines = [f"{self._other.there} has ended: {news.outcome}"]
        if self._robot_is_here and not news.succeeded and self._run_has_begun() and not self._over:
            self._left_alone = True
            lines += ["  the services here go on, and the robot waits; end here with Ctrl-C, or start again there:"]
            lines += [f"  {command}" for command in news.restart]
        return lines
