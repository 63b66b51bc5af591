"""The robot bridge: sensors, actuators, reward and reset, in action cycles.

One cycle, in real time::

    publish TimeStep t ─▶ apply the action that answers it, on arrival ─▶ deadline: the world has gone on meanwhile
        ▲                                                                     │
        └──── observe, judge, count; record the command in force at the end ◀─┘

Nothing in it waits for the network, the disk or a lock that someone slow can hold. In lockstep the deadline is the
answer, and the world's time moves by one cycle per step.
"""

from __future__ import annotations

import logging
from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np

from common import topics
from common.clock import CycleKeeper, Lateness
from common.codec import encode
from common.inbox import Arrived
from common.messages import Action, ActionSource, Finished, Float32Array
from common.service import Service
from common.surviving_counts import SurvivingCounts
from services.robot_bridge.answers import Answers
from services.robot_bridge.bookkeeping import CycleCounts, EpisodeResult, Ledger, Totals
from services.robot_bridge.camera_watch import CameraWatch
from services.robot_bridge.config import RobotBridgeSettings
from services.robot_bridge.engagement import Engagement
from services.robot_bridge.tasks.base import Task
from services.robot_bridge.time_steps import CommandInForce, TimeStepStream, announced_spec
from services.robot_bridge.watchdog import Watchdog

logger = logging.getLogger(__name__)

WARM_UP_CYCLES = 1000
"""``overruns_after_1000`` counts from here."""
REPUBLISH_NS = 1_000_000_000
"""In lockstep, a TimeStep is published again after this long without an answer."""
SURVIVING_COUNTS = tuple(field.name for counted in (Totals, CycleCounts) for field in fields(counted))
"""What is known of a killed bridge to the last TimeStep."""


class RobotBridge:
    """Runs a task's action cycle against the actor's answers until the run's steps are done."""

    def __init__(
        self,
        service: Service,
        task: Task,
        settings: RobotBridgeSettings,
        totals: Totals,
        latched: str | None = None,
        surviving_counts: SurvivingCounts | None = None,
    ) -> None:
        self._service, self._task, self._settings = service, task, settings
        self._clock, self._spec = service.clock, announced_spec(task.spec, settings.encoding)
        self._realtime = settings.pacing == "realtime"
        self._cycle_ns = round(self._spec.action_cycle_time_s * 1e9)
        self._keeper = CycleKeeper(self._cycle_ns)
        self._watchdog = Watchdog(round(settings.stop_after * 1e9))
        self._watchdog.latched = latched
        self._camera_watch = CameraWatch(round(settings.camera_stall_after * 1e9))
        self._ledger = Ledger(self._spec, totals)
        self.counts = CycleCounts()
        self._surviving_counts = surviving_counts
        self._keep_counts()
        self._time_steps = TimeStepStream(service, self._spec, settings, self.counts)
        self._answers = Answers(service, self._spec, self.counts)
        self._finished_publisher = service.transport.publisher(topics.FINISHED)
        self._last_return: float | None = None
        self._engagement = Engagement(service, settings, self._watchdog, self._waits_for_camera)
        self._needs_new_goal = True
        self._attempt_first_seq = 0
        self._in_force = self._no_command()
        self._world_ns = self._clock.now_ns()
        service.counters = self.counters
        service.details = self.details
        service.on_stop = task.give_up
        service.serve_commands(
            {"pause": lambda: self._latch("pause"), "e_stop": lambda: self._latch("e_stop"), "resume": self._resume}
        )
        service.transport.serve(topics.SPEC, lambda _: encode(self._spec))

    def run(self) -> None:
        """Act until the run's steps are done or the service is asked to stop; then hand over what is on its way."""
        self._time_steps.journal.start()
        self._service.state = "running"
        try:
            self._run_attempts()
            if self._service.failure is None:
                # A bridge that a newer one has replaced must not end the newer one's run.
                self._finish("stopped" if self._service.stopping.is_set() else "steps")
        finally:
            self._time_steps.journal.stop()

    # ------------------------------------------------------------------ attempts

    def _run_attempts(self) -> None:
        if self._realtime and not self._over():
            self._task.start(self._clock)
            self._world_ns = self._clock.now_ns()
        self._task.advance_to(self._world_ns)
        try:
            while not self._over():
                if self._engagement.holds():
                    self._run_attempt()
                else:
                    self._engage()
        finally:
            self._task.close()

    def _run_attempt(self) -> None:
        self._begin_attempt()
        terminated = truncated = False
        while not (terminated or truncated or self._over()):
            if not self._wait_for_cycle_end():
                return
            terminated, truncated = self._end_cycle()
        if truncated:
            self._reset()

    def _begin_attempt(self) -> None:
        self._advance_world()
        if self._needs_new_goal:
            self._task.begin_episode()
            self._needs_new_goal = False
        else:
            self._task.begin_attempt()
        if self._service.stopping.is_set():  # The robot may not be where the attempt begins.
            return
        placed_ns = self._clock.now_ns()
        if self._realtime and placed_ns >= self._keeper.deadline_ns:
            self._count_lateness(self._keeper.next(placed_ns))
            self._keeper.start(placed_ns)
        self._publish_first()

    def _publish_first(self) -> None:
        """Publish the first TimeStep of an attempt."""
        self._ledger.begin_attempt()
        self._attempt_first_seq = self.counts.produced
        self._in_force = self._no_command()
        self._watchdog.restart(self._clock.now_ns())
        self._observe(reward=0.0, terminated=False, truncated=False)

    def _end_cycle(self) -> tuple[bool, bool]:
        """Judge the cycle that ends now and publish what it led to; return whether the attempt has ended, and how."""
        self._advance_world()
        self._answers.end_cycle(self.counts.produced - 1, self._clock.now_ns())
        answered = self._in_force.source is ActionSource.POLICY
        self.counts.unanswered += not answered
        outcome = self._task.outcome()
        truncated, episode = self._ledger.end_cycle(outcome.reward, outcome.terminated, self._camera_stalls())
        self._observe(outcome.reward, outcome.terminated, truncated)
        if answered:
            self._in_force = replace(self._in_force, source=ActionSource.HELD)
        elif self._settings.on_missing_action == "zero" and self._in_force.source is ActionSource.HELD:
            self._command(self._no_command().action, ActionSource.ZERO, self._in_force.answered_seq)
        if episode:
            self._record_episode(episode)
        self._needs_new_goal = outcome.terminated or episode is not None
        return outcome.terminated, truncated

    def _reset(self) -> None:
        """Let the reset of a time-out take its time; actions that come meanwhile answer what is over."""
        self._attempt_first_seq = self.counts.produced
        self._task.stop()
        for _ in range(self._spec.reset_steps):
            if self._over():
                return
            if self._realtime:
                while not self._service.stopping.is_set() and self._clock.now_ns() < self._keeper.deadline_ns:
                    self._sleep_until(self._keeper.deadline_ns)
                    self._take_actions()
            self._count_cycle()
            self._advance_world()
            self._ledger.end_reset_cycle()
            self._keep_counts()

    # ------------------------------------------------------------------ one cycle

    def _wait_for_cycle_end(self) -> bool:
        """Apply actions as they come until the cycle is over; False if the run is to stop."""
        ended = self._wait_for_deadline() if self._realtime else self._wait_for_answer()
        if ended:
            self._count_cycle()
        return ended

    def _wait_for_deadline(self) -> bool:
        while True:
            self._take_actions()
            now_ns = self._clock.now_ns()
            if self._watchdog.expire(now_ns):
                logger.warning("no fresh action for %.2f s: the robot is stopped", self._settings.stop_after)
                self._stop_robot()
            if self._service.stopping.is_set():
                return False
            if now_ns >= self._keeper.deadline_ns and not self._waits_longer():
                return True
            deadlines = self._keeper.deadline_ns, self._watchdog.deadline_ns
            self._sleep_until(min(deadline for deadline in deadlines if deadline > now_ns))

    def _waits_longer(self) -> bool:
        """With ``wait``, the cycle lasts until its action has come; the watchdog is the limit."""
        if self._settings.on_missing_action != "wait":
            return False
        if self._in_force.source is not ActionSource.POLICY and not self._watchdog.stopped:
            return True
        # What was waited for is not the bridge's own lateness.
        self._keeper.stretch(self._in_force.applied_ns)
        return False

    def _wait_for_answer(self) -> bool:
        published_ns = self._clock.now_ns()
        while self._in_force.answered_seq != self.counts.produced - 1:
            if self._service.stopping.is_set():
                return False
            self._sleep_until(published_ns + REPUBLISH_NS)
            self._take_actions()
            if self._clock.now_ns() - published_ns >= REPUBLISH_NS:
                published_ns = self._clock.now_ns()
                self._time_steps.republish()
        return True

    def _sleep_until(self, deadline_ns: int) -> None:
        with self._service.wake:
            if not (self._answers or self._must_stop() or self._service.stopping.is_set()):
                self._clock.wait_until(deadline_ns, self._service.wake)

    def _count_cycle(self) -> None:
        counts = self.counts
        counts.cycles += 1
        if not self._realtime:
            self._world_ns += self._cycle_ns
            return
        self._count_lateness(self._keeper.next(self._clock.now_ns()))

    def _count_lateness(self, lateness: Lateness) -> None:
        counts = self.counts
        if lateness.overrun:
            counts.overruns += 1
            counts.overruns_after_1000 += counts.cycles > WARM_UP_CYCLES
            counts.skipped_cycles += lateness.skipped
            if lateness.skipped:
                logger.warning("an action cycle ended %.0f ms late", lateness.late_ns / 1e6)

    def _advance_world(self) -> None:
        """The world has gone on until now; in lockstep, `now` is counted in cycles."""
        if self._realtime:
            self._world_ns = self._clock.now_ns()
        self._task.advance_to(self._world_ns)

    # ------------------------------------------------------------------ actions

    def _take_actions(self) -> None:
        if self._must_stop():
            self._stop_robot()
        for arrived, step in self._answers.take():
            applied = False
            if self._is_wanted(arrived, step.published_ns):
                applied = self._apply(arrived)
            else:
                self.counts.refused_actions += 1
            self._answers.record(arrived, step, self._in_force.applied_ns if applied else None)

    def _must_stop(self) -> bool:
        """True if a latch has been set that the robot does not know of yet."""
        return self._watchdog.latched is not None and self._in_force.source is not ActionSource.STOP

    def _is_wanted(self, arrived: Arrived[Action], published_ns: int) -> bool:
        """True for a fresh answer to this attempt, newer than what is in force."""
        newest_answered = max(self._in_force.answered_seq, self._attempt_first_seq - 1)
        if arrived.message.answered_seq <= newest_answered:
            return False
        if not self._realtime:
            return self._watchdog.latched is None
        return self._watchdog.accept(published_ns, arrived.at_ns)

    def _apply(self, arrived: Arrived[Action]) -> bool:
        """Let the robot obey; False for the answer that only shows that the ring is closed."""
        self._engagement.answered = True
        if self._engagement.asking:
            return False
        clipped = np.clip(arrived.message.action, self._spec.action_low, self._spec.action_high)
        self._command(clipped, ActionSource.POLICY, arrived.message.answered_seq)
        return True

    def _command(self, action: Float32Array, source: ActionSource, answered_seq: int) -> None:
        self._advance_world()
        self._task.command(action)
        self._in_force = CommandInForce(action, source, answered_seq, self._clock.now_ns())

    def _stop_robot(self) -> None:
        self._advance_world()
        self._task.stop()
        # The number of the last answer stays: what it answers must not be applied again.
        self._in_force = replace(self._no_command(), source=ActionSource.STOP, answered_seq=self._in_force.answered_seq)

    def _no_command(self) -> CommandInForce:
        zeros = np.zeros(len(self._spec.action_low), np.float32)
        zeros = np.clip(zeros, self._spec.action_low, self._spec.action_high)
        return CommandInForce(zeros, ActionSource.ZERO, -1, self._clock.now_ns())

    # ------------------------------------------------------------------ observations

    def _observe(self, reward: float, terminated: bool, truncated: bool) -> None:
        reading = self._task.read()
        if self._engagement.asking:
            # What the camera has seen while the robot waited would only hold the question up.
            reading = reading.without_old_frames()
        time_step = self._time_steps.publish(
            reading,
            self._in_force,
            self._ledger,
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            # Before it leaves: of a bridge that is killed now, nobody must see more than it has counted.
            keep_counts=self._keep_counts,
        )
        self._answers.expect(time_step, self._time_steps.sent_ns)

    def _camera_stalls(self) -> bool:
        """True while the newest camera frame is too old to act by."""
        return self._camera_watch.look(self._task.newest_frame_ns(), self._world_ns)

    def _waits_for_camera(self) -> bool:
        """True while no attempt may start for want of a camera frame that is new enough."""
        # In lockstep the camera's time stands still while anyone waits: attempts bring it on, however short they are.
        if not self._realtime or self._task.newest_frame_ns() is None:
            return False
        self._advance_world()
        return self._camera_stalls()

    # ------------------------------------------------------------------ beginning and end

    def _over(self) -> bool:
        return self._service.stopping.is_set() or self._ledger.totals.steps >= self._settings.steps

    def _engage(self) -> None:
        """Wait for actor, replay and camera, then publish one observation; its answer shows that the ring is closed."""
        self._task.stop()
        if not self._engagement.may_ask():
            self._service.pause(0.05)
            return
        # An attempt of a single TimeStep, of which no transition comes: no step is counted and the robot stands still.
        self._engagement.ask()
        self._advance_world()
        self._publish_first()
        until_ns = self._clock.now_ns() + round(self._settings.stop_after * 1e9)
        while not self._engagement.answered and self._clock.now_ns() < until_ns:
            if self._service.stopping.is_set():
                return
            self._sleep_until(until_ns)
            self._take_actions()
        self._engagement.asked()
        self._keeper.start(self._clock.now_ns())

    def _finish(self, reason: str) -> None:
        finished = encode(Finished(self._service.incarnation, self.counts.produced, reason))
        sent_ns = 0
        totals = self._ledger.totals
        logger.info("finished (%s): %d steps, %d episodes", reason, totals.steps, totals.episodes)

        def work() -> None:
            nonlocal sent_ns
            if self._clock.now_ns() - sent_ns > 0.2e9:
                sent_ns = self._clock.now_ns()
                self._finished_publisher.put(finished)

        self._service.drain(lambda: self._time_steps.journal.unacknowledged == 0, work)

    def _record_episode(self, episode: EpisodeResult) -> None:
        self._last_return = episode.undiscounted_return
        self._service.record.row(
            "episodes",
            {
                "episode": episode.episode,
                "return": episode.undiscounted_return,
                "length": episode.length,
                "attempts": episode.attempts,
                "steps": episode.steps,
                "acted_steps": episode.acted_steps,
                "experience_time_s": round(episode.steps * self._spec.action_cycle_time_s, 3),
            },
        )

    # ------------------------------------------------------------------ commands and counts

    # Commands come on a receiving thread: they only set the latch, the cycle's thread moves the robot.

    def _latch(self, reason: str) -> str:
        self._watchdog.latch(reason)
        logger.warning("%s: the robot stops", reason)
        self._service.write_record()  # at once: a restarted bridge must know of an emergency stop
        with self._service.wake:
            self._service.wake.notify_all()
        return f"{reason}: the robot stops; `resume` lets it go on"

    def _resume(self) -> str:
        self._watchdog.release(self._clock.now_ns())
        logger.warning("resumed: the robot may move")
        return "resumed"

    def _keep_counts(self) -> None:
        if self._surviving_counts:
            self._surviving_counts.set((*vars(self._ledger.totals).values(), *vars(self.counts).values()))

    def counters(self) -> dict[str, float]:
        """Counts and gauges for the heartbeat and the record."""
        return {
            **asdict(self._ledger.totals),
            **asdict(self.counts),
            "resent": self._time_steps.journal.resent,
            "unacknowledged": self._time_steps.journal.unacknowledged,
            "given_up": self._time_steps.journal.given_up,
            "stops": self._watchdog.stops,
            "camera_stalls": self._camera_watch.stalls,
            **self._task.counters(),
            **({} if self._last_return is None else {"last_return": self._last_return}),
        }

    def details(self) -> dict[str, Any]:
        """What else the summary needs to know."""
        return {
            "task": self._spec.task,
            "preset": self._spec.preset,
            "pacing": self._spec.pacing,
            "has_goal": self._spec.has_goal,
            "seed": self._service.run.seed,
            "steps_total": self._settings.steps,
            "latched": self._watchdog.latched,
            "waits_for": self._engagement.waits_for,
            "unanswered_first_observations": self._engagement.unanswered,
            "surviving_counts": self._surviving_counts.description() if self._surviving_counts else None,
        }
