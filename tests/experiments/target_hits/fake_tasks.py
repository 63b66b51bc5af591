"""Worlds small enough to know by heart. Grid workers import them by ``fake=tests....fake_tasks:Class``."""

from dataclasses import dataclass, replace

import numpy as np

from common.config import setting
from services.robot_bridge.tasks.base import Outcome, SensorReading, Task
from tests.helpers import make_spec

MODULE = "tests.experiments.target_hits.fake_tasks"


@dataclass(frozen=True)
class FakeSettings:
    time_limit: int = setting(50, low=1)
    reset_steps: int = setting(4, low=0)
    farthest: int = setting(3, low=1)
    """Line: largest distance of a start from the goal."""


class FakeTask(Task):
    """What all of them share: one cycle a call, nothing to read."""

    SETTINGS = FakeSettings
    PRESETS = {"demo": {}, "thesis": {"reset_steps": 5}}  # noqa: RUF012 - as declared in Task

    HIGHEST = 1.0

    def __init__(self, settings, *, name="fake", preset="demo", pacing="lockstep", rng=None):
        self._settings, self._rng = settings, rng
        self.spec = replace(
            make_spec(camera=False),
            task=name,
            preset=preset,
            pacing=pacing,
            action_low=np.array([-1], np.float32),
            action_high=np.array([self.HIGHEST], np.float32),
            action_cycle_time_s=0.04,
            reset_steps=settings.reset_steps,
            time_limit_steps=settings.time_limit,
            has_goal=True,
        )
        self.log = []
        self._now_ns = None

    def begin_episode(self):
        self.log.append("episode")
        self._start()

    def begin_attempt(self):
        self.log.append("attempt")
        self._start()

    def command(self, action):
        self._action = action

    def stop(self):
        self._action = np.zeros(1, np.float32)

    def advance_to(self, now_ns):
        if self._now_ns is not None:
            assert now_ns - self._now_ns == 40_000_000
            self._live_a_cycle()
        self._now_ns = now_ns

    def outcome(self):
        return Outcome(reward=-1.0, terminated=self._at_goal())

    def read(self) -> SensorReading:
        raise AssertionError("the sensors are not to be read: a camera would render")


class Countdown(FakeTask):
    """The goal is reached a number of cycles after each start, whatever is done: 3, 7, 2, 3, 7, 2, ..."""

    CYCLES = (3, 7, 2)

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self._begun = 0

    def _start(self):
        self._left = self.CYCLES[self._begun % len(self.CYCLES)]
        self._begun += 1

    def _live_a_cycle(self):
        self._left -= 1

    def _at_goal(self):
        return self._left == 0


class Line(FakeTask):
    """A point on a line, 1 to ``farthest`` above the goal; it moves by its command, -1 to 1 a cycle."""

    def _start(self):
        self.position = float(self._rng.integers(1, self._settings.farthest + 1))

    def _live_a_cycle(self):
        self.position += float(self._action[0])

    def _at_goal(self):
        return abs(self.position) < 0.5


class Nowhere(Line):
    """The goal is never reached."""

    def _at_goal(self):
        return False


class Forgetful(Countdown):
    """Not the same from the same start: each start needs one cycle more than the one before."""

    def _start(self):
        self._begun += 1
        self._left = self._begun


class Fragile(Line):
    """Breaks at the 5th reset."""

    def begin_attempt(self):
        super().begin_attempt()
        if self.log.count("attempt") == 5:
            raise RuntimeError("the gripper came off")


class AtOnce(Line):
    """The goal is reached in the first step from everywhere."""

    def _at_goal(self):
        return True


class Autopilot(Line):
    """The goal is reached in the 4th step from everywhere, whatever is done."""

    def _start(self):
        super()._start()
        self._left = 4

    def _live_a_cycle(self):
        self._left -= 1

    def _at_goal(self):
        return self._left == 0


class Generous(Line):
    """Rewards being near the goal."""

    def outcome(self):
        return replace(super().outcome(), reward=1.0 / (1.0 + abs(self.position)))


class NotANumber(Line):
    """Its reward is NaN, but only once it has been reset for the first time."""

    def outcome(self):
        return replace(super().outcome(), reward=float("nan") if "attempt" in self.log else -1.0)


class Prize(Line):
    """The goal costs nothing."""

    def outcome(self):
        outcome = super().outcome()
        return replace(outcome, reward=0.0 if outcome.terminated else -1.0)
