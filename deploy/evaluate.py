"""``python -m deploy.evaluate RUN_DIR``: how good a run's policy is without its noise, in lockstep.

The run's newest policy acts with the centre of its distribution on the run's task, in this process: no network, no
delay, no learning. Start states depend on ``--seed`` and the episode's number alone, so two policies are compared on
the same ones.
"""

from __future__ import annotations

import argparse
import math
import sys
import traceback
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from common.codec import decode
from common.config import load_config
from common.console import Console
from common.errors import ConfigError, MessageError, RelodError, ServiceError
from common.frame_encoding import FrameEncoding, encode_frames, pixels_of
from common.frame_stack import FrameStack
from common.messages import Float32Array, PolicyWeights, UInt8Array
from common.pending_actions import PendingActions, observed_spec
from common.policies import Observation, Policy, pending_actions_of, policy_from_weights
from common.record import write_atomically
from common.stop_signals import INTERRUPTED, StopSignals
from common.topics import LEARNER, ROBOT_BRIDGE
from deploy.mirror import BRIDGE_CONFIGURATION
from deploy.record_folders import find_file
from services.robot_bridge.bookkeeping import STEP_REWARD_IN_RESET, Ledger
from services.robot_bridge.config import RobotBridgeConfig
from services.robot_bridge.tasks import Task, load_task

MAX_ATTEMPTS = 20
"""A policy that has not reached the goal after this many attempts is not waited for any longer."""


@dataclass(frozen=True)
class EvaluatedEpisode:
    """A row of ``evaluation.csv``."""

    episode: int
    episode_return: float
    """Sum of rewards, resets included."""
    length: int
    """Steps, resets included."""
    attempts: int
    completed: bool
    """False if it was given up after :data:`MAX_ATTEMPTS`; return and length are those until then."""


@dataclass(frozen=True)
class _StepIdentity:
    """What frame stack and pending actions want to know of a time step."""

    incarnation: int
    seq: int
    attempt: int
    step_index: int


class Evaluation:
    """Runs episodes of a task with a policy."""

    def __init__(
        self,
        task: Task,
        policy: Policy,
        rng: np.random.Generator,
        seed: int,
        encoding: FrameEncoding = FrameEncoding.RAW,
        pending_actions: int = 0,
    ) -> None:
        """Args:
        task: built with ``rng``, its only source of randomness.
        policy: what acts.
        rng: reset for each episode.
        seed: of the episodes' start states.
        encoding: of the camera frames in the run; the policy sees what it leaves of them.
        pending_actions: that the policy wants to see.
        """
        self._task, self._policy, self._rng, self._seed, self._encoding = task, policy, rng, seed, encoding
        self._ledger = Ledger(task.spec)
        self._cycle_ns = round(task.spec.action_cycle_time_s * 1e9)
        self._now_ns = 0
        self._seq = 0
        self._stack: FrameStack[UInt8Array] | None = None
        if task.spec.has_camera:
            self._stack = FrameStack(task.spec.frame_stack)
        self._pending = PendingActions(pending_actions, task.spec.dimensions.A) if pending_actions else None
        task.advance_to(self._now_ns)

    def run_episode(self, number: int) -> EvaluatedEpisode:
        """Run episode ``number`` to its end."""
        spec, before = self._task.spec, self._ledger.totals
        self._rng.bit_generator.state = np.random.default_rng([self._seed, number]).bit_generator.state
        self._task.begin_episode()
        episode_return, attempts, completed = 0.0, 0, False
        while not completed and attempts < MAX_ATTEMPTS:
            if attempts:
                self._task.begin_attempt()
            attempts += 1
            attempt_return, completed = self._run_attempt()
            episode_return += attempt_return
        after = self._ledger.totals
        acted = after.acted_steps - before.acted_steps
        reset = (after.steps - before.steps) - acted if spec.has_goal else 0
        return EvaluatedEpisode(
            episode=number,
            episode_return=episode_return + STEP_REWARD_IN_RESET * reset,
            length=acted + reset,
            attempts=attempts,
            completed=completed,
        )

    def _run_attempt(self) -> tuple[float, bool]:
        """Act until the attempt ends; return the sum of its rewards and whether the episode has ended with it."""
        self._ledger.begin_attempt()
        action = np.zeros(self._task.spec.dimensions.A, np.float32)
        attempt_return = 0.0
        while True:
            action = self._act(action)
            self._advance()
            outcome = self._task.outcome()
            attempt_return += outcome.reward
            truncated, episode = self._ledger.end_cycle(outcome.reward, outcome.terminated)
            if not (outcome.terminated or truncated):
                continue
            if truncated:
                self._reset()
            return attempt_return, episode is not None

    def _act(self, previous_action: Float32Array) -> Float32Array:
        """Command the policy's action on what the sensors show now; return what was commanded."""
        spec, reading = self._task.spec, self._task.read()
        frames, proprioception = None, reading.proprioception
        step = _StepIdentity(0, self._seq, self._ledger.attempt, self._ledger.step_index)
        if self._stack:
            pixels = pixels_of(encode_frames(reading.frames, self._encoding))
            stack = self._stack.add(step, reading.frame_ids.tolist(), list(pixels))
            frames = np.stack(stack.frames) if stack else None
        if self._pending:
            proprioception = self._pending.observe(step, proprioception)
        observation = Observation(frames, proprioception, previous_action)
        chosen = self._policy.act(observation, self._rng, deterministic=True)
        if self._pending:
            self._pending.note(step.incarnation, 0, step.seq, chosen.action)
        self._seq += 1
        action: Float32Array = np.clip(chosen.action, spec.action_low, spec.action_high)
        self._task.command(action)
        return action

    def _reset(self) -> None:
        self._task.stop()
        for _ in range(self._task.spec.reset_steps):
            self._advance()
            self._ledger.end_reset_cycle()

    def _advance(self) -> None:
        self._now_ns += self._cycle_ns
        self._task.advance_to(self._now_ns)


def load_run(run_dir: Path, config_path: Path | None, seed: int) -> tuple[Evaluation, Task, PolicyWeights]:
    """Build the task and the policy of a run.

    Raises:
        RelodError: the run has no configuration or no policy, or they do not fit together.
    """
    if not run_dir.is_dir():
        raise ConfigError(f"{run_dir}: no such run directory")
    path = config_path or find_file(
        run_dir, BRIDGE_CONFIGURATION, ROBOT_BRIDGE, "name the bridge's configuration with --config FILE"
    )
    config = load_config(RobotBridgeConfig, path)
    rng = np.random.default_rng(seed)
    task = load_task(config.task.name, config.task.preset, config.task.overrides, config.tasks.rows, rng=rng)
    policy_path = find_file(run_dir, "policy.msgpack", LEARNER, "the learner has not saved a policy")
    try:
        weights = decode(policy_path.read_bytes(), PolicyWeights)
    except MessageError as error:
        raise ConfigError(f"{policy_path} cannot be used: {error}") from error
    encoding = FrameEncoding(config.robot_bridge.encoding)
    pending_actions = pending_actions_of(weights, task.spec)
    policy = policy_from_weights(observed_spec(task.spec, pending_actions), weights)
    return Evaluation(task, policy, rng, seed, encoding, pending_actions), task, weights


def evaluation_text(episodes: Sequence[EvaluatedEpisode]) -> str:
    """Return what the episodes say, as a short table."""
    at_once = sum(episode.completed and episode.attempts == 1 for episode in episodes)
    given_up = sum(not episode.completed for episode in episodes)
    rows = [
        ("return", _mean_and_error([episode.episode_return for episode in episodes])),
        ("length", _mean_and_error([episode.length for episode in episodes])),
        ("episodes", f"{len(episodes)}, without time-out {100 * at_once / len(episodes):.1f} %"),
    ]
    if given_up:
        rows.append(("given up", f"{given_up}, each after {MAX_ATTEMPTS} attempts; they count as they were then"))
    return "\n".join(f"{label:<11}{text}" for label, text in rows)


def write_csv(path: Path, episodes: Sequence[EvaluatedEpisode]) -> None:
    """Write the episodes' rows."""
    header = "episode,return,length,attempts,completed"
    rows = [
        f"{row['episode']},{row['episode_return']},{row['length']},{row['attempts']},{int(row['completed'])}"
        for row in map(asdict, episodes)
    ]
    write_atomically(path, "\n".join([header, *rows]) + "\n")


def _evaluate(options: argparse.Namespace, stop: StopSignals, console: Console) -> int:
    evaluation, task, weights = load_run(options.run_dir, options.config, options.seed)
    console.line(f"{task.spec.task} ({task.spec.preset}), policy {weights.version}, {weights.updates} updates")
    episodes: list[EvaluatedEpisode] = []
    try:
        while len(episodes) < options.episodes and not stop.asked:
            episodes.append(evaluation.run_episode(len(episodes)))
            console.status(f"{len(episodes)}/{options.episodes} episodes")
        task.close()
    except Exception as error:
        if episodes:
            console.line(evaluation_text(episodes))
        if isinstance(error, RelodError):
            raise
        traceback.print_exc()  # Whoever wrote the task wants to know where.
        what = f"{task.spec.task} has failed after {len(episodes)} episodes"
        raise ServiceError(f"{what}: {type(error).__name__}: {error}") from error
    if episodes:
        path = options.run_dir / "evaluation.csv"
        write_csv(path, episodes)
        console.line(evaluation_text(episodes))
        console.line(str(path))
    return INTERRUPTED if stop.asked else 0


def _mean_and_error(values: Sequence[float]) -> str:
    mean = float(np.mean(values))
    if len(values) < 2:
        return f"{mean:.2f}"
    return f"{mean:.2f} ± {float(np.std(values, ddof=1)) / math.sqrt(len(values)):.2f} (standard error)"


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate from the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m deploy.evaluate", description="Evaluate a run's policy.")
    parser.add_argument("run_dir", type=Path, metavar="RUN_DIR", help="folder of the run's record")
    parser.add_argument("--episodes", type=int, default=100, metavar="N", help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the start states (default: %(default)s)")
    parser.add_argument("--config", type=Path, metavar="FILE", help="the bridge's configuration (default: RUN_DIR's)")
    options = parser.parse_args(arguments)
    if options.episodes < 1:
        parser.error(f"--episodes {options.episodes}: expected at least 1")
    if options.seed < 0:
        parser.error(f"--seed {options.seed}: expected at least 0")
    try:
        with StopSignals() as stop:
            return _evaluate(options, stop, Console())
    except RelodError as error:
        print(f"deploy.evaluate: error: {error}", file=sys.stderr)
    except OSError as error:
        print(f"deploy.evaluate: error: {error.filename or 'system'}: {error.strerror}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
