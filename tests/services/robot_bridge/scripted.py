"""A robot, an actor and a clock that do what a test tells them, and the bridge between them."""

from __future__ import annotations

import numpy as np

from common import topics
from common.codec import decode
from common.messages import Acknowledgement, Action, TaskSpec, TimeStep
from common.transport import InMemoryNetwork
from services.robot_bridge.bookkeeping import Totals
from services.robot_bridge.bridge import RobotBridge
from services.robot_bridge.config import RobotBridgeSettings
from services.robot_bridge.tasks.base import Outcome, SensorReading, Task
from tests.services.builders import START_NS, EventClock, Peer, SoloService

CYCLE_S = 0.04
BRIDGE = 1000
"""The bridge's incarnation."""
ACTOR = 50
"""The actor's incarnation."""
PROBE = 0
"""``seq`` of the TimeStep that asks for a first answer."""


class ScriptedTask(Task):
    """A cart in the plane: its command is its velocity. It is at the goal after the cycles it is told."""

    def __init__(
        self,
        clock,
        goal_cycles=(),
        *,
        time_limit=1000,
        reset_steps=0,
        has_goal=True,
        pacing="realtime",
        camera=False,
        channels=3,
    ) -> None:
        self._clock, self._goal_cycles, self._camera = clock, set(goal_cycles), camera
        self._shape = (2, 3, channels) if camera else (0, 0, 0)
        self._position, self._velocity = np.zeros(2), np.zeros(2, np.float32)
        self._cycles = self._frames = 0
        self._now_ns = None
        self.log = []
        """(what, seconds since the clock's start), with the command's values for a command."""
        self.advanced_to_ns = []
        self.on_outcome = {}
        """Cycle -> what happens while the cycle is judged, e.g. the clock goes on."""
        self.reward, self.offset = -1.0, 0.0
        self.spec = TaskSpec(
            task="scripted",
            preset="demo",
            pacing=pacing,
            algorithm_presets={"sac": "dot_reacher"},
            action_low=np.array([-1, -2], np.float32),
            action_high=np.array([1, 2], np.float32),
            proprioception_low=np.full(2, -1, np.float32),
            proprioception_high=np.full(2, 1, np.float32),
            frame_shape=np.array(self._shape),
            frame_stack=2 if camera else 0,
            crop_margin=np.zeros(2, np.int64),
            action_cycle_time_s=CYCLE_S,
            world_seconds_per_cycle=CYCLE_S,
            time_limit_steps=time_limit,
            reset_steps=reset_steps,
            has_goal=has_goal,
        )

    def times(self, what) -> list[float]:
        """When ``what`` was done."""
        return [entry[1] for entry in self.log if entry[0] == what]

    def begin_episode(self) -> None:
        self._note("begin_episode")
        self._start()

    def begin_attempt(self) -> None:
        self._note("begin_attempt")
        self._start()

    def command(self, action) -> None:
        self.log.append(("command", self._clock.seconds, *np.round(action.astype(float), 6)))
        self._velocity = action

    def stop(self) -> None:
        self._note("stop")
        self._velocity = np.zeros(2, np.float32)

    def advance_to(self, now_ns) -> None:
        if self._now_ns is not None:
            self._position += self._velocity * ((now_ns - self._now_ns) / 1e9)
        self._now_ns = now_ns
        self.advanced_to_ns.append(now_ns)

    def read(self) -> SensorReading:
        new = 2 if self._camera else 0
        ids = np.arange(self._frames, self._frames + new)
        self._frames += new
        return SensorReading(
            frames=np.array([np.full(self._shape, i, np.uint8) for i in ids], np.uint8).reshape(new, *self._shape),
            frame_ids=ids,
            frame_capture_ns=np.full(new, self._now_ns or 0),
            proprioception=(self._position + self.offset).astype(np.float32),
        )

    def outcome(self) -> Outcome:
        self._cycles += 1
        self.on_outcome.get(self._cycles, lambda: None)()
        return Outcome(self.reward, terminated=self._cycles in self._goal_cycles)

    def close(self) -> None:
        self._note("close")

    def _start(self) -> None:
        self._position, self._velocity = np.zeros(2), np.zeros(2, np.float32)

    def _note(self, what) -> None:
        self.log.append((what, self._clock.seconds))


def action_of(seq) -> np.ndarray:
    """The command that answers TimeStep ``seq``."""
    return np.array([seq / 64, -seq / 64], np.float32)


class Scene:
    """A bridge with a scripted task on a fake clock, and an actor that answers as told.

    ``answers`` says for a TimeStep how long after its publication answers to it arrive: a number, None for none, or
    several. The probe is always answered at once, so the first attempt begins at the clock's start. ``task`` holds
    arguments of :class:`ScriptedTask`.
    """

    def __init__(self, directory, answers=0.01, task=None, totals=None, **settings) -> None:
        self.clock = EventClock()
        self.task = ScriptedTask(self.clock, **(task or {}))
        self.network = InMemoryNetwork()
        self.service = SoloService(topics.ROBOT_BRIDGE, self.network, directory, self.clock, incarnation=BRIDGE)
        self.service.peers = {topics.ACTOR: "running", topics.REPLAY: "running"}
        self.settings = RobotBridgeSettings(**{"pacing": self.task.spec.pacing, **settings})
        self.bridge = RobotBridge(self.service, self.task, self.settings, totals or Totals())
        self.actor = Peer(self.network)
        self.announced = decode(self.actor.transport.query(topics.SPEC), TaskSpec)
        self.answers = answers if callable(answers) else lambda time_step: answers
        self.probe_answer = 0.0
        self.actor_times = lambda: (0, 0, 0, 0, -1)
        """What answers say of the actor's clock: received, began, sent, offset and its bound; -1: not known."""
        self.time_steps: list[TimeStep] = []
        self.published_s: list[float] = []
        """When each of ``time_steps`` was published."""
        self.finished = self.actor.messages(topics.FINISHED)
        self.actor.transport.subscribe(topics.TIME_STEP, self._receive)
        self.actor.transport.subscribe(topics.FINISHED, lambda _: self._end())

    def run(self) -> list[TimeStep]:
        """Run the bridge to its end; return the TimeSteps it published."""
        self.bridge.run()
        return self.time_steps

    def answer(self, seq, action=None, *, incarnation=BRIDGE, actor_incarnation=ACTOR) -> None:
        """Let an answer to TimeStep ``seq`` arrive now."""
        action = action_of(seq) if action is None else np.array(action, np.float32)
        self.actor.send(
            topics.ACTION, Action(actor_incarnation, incarnation, seq, action, -1.0, 3, *self.actor_times())
        )

    def command(self, name):
        """Command the bridge."""
        return self.actor.command(topics.ROBOT_BRIDGE, name)

    @property
    def counts(self):
        """What the bridge has counted."""
        return self.bridge.counts

    def _receive(self, payload) -> None:
        time_step = decode(payload, TimeStep, self.announced.dimensions)
        self.time_steps.append(time_step)
        self.published_s.append((time_step.published_ns - START_NS) / 1e9)
        if time_step.is_last:
            return
        delays = self.probe_answer if time_step.seq == PROBE else self.answers(time_step)
        delays = delays if isinstance(delays, list | tuple) else [delays]
        for delay_s in delays:
            if delay_s is not None:
                self.clock.after(delay_s, lambda: self.answer(time_step.seq))

    def _end(self) -> None:
        self.service.peers = dict.fromkeys(self.service.peers, "drained")
        ack = Acknowledgement(BRIDGE, self.counts.produced, np.zeros((0, 2), np.int64), 0.0)
        self.actor.send(topics.TIME_STEP_ACK, ack)
