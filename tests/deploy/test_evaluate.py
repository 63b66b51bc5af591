"""The deterministic policy's evaluation, in lockstep: what counts, and what it reads."""

from pathlib import Path

import numpy as np
import pytest
import tomli_w

from common.codec import encode
from common.frame_encoding import FrameEncoding, encode_frames, pixels_of
from common.messages import TaskSpec
from common.pending_actions import observed_spec
from common.policies import ChosenAction, Observation, pack_weights
from common.policies.weights import initial_parameters
from deploy import evaluate
from deploy.evaluate import MAX_ATTEMPTS, EvaluatedEpisode, Evaluation, evaluation_text
from services.robot_bridge.tasks import load_task
from tests.deploy.test_run_record import RUN


class Steering:
    """Drives the dot to the middle, or does nothing."""

    version = 1

    def __init__(self, gain: float) -> None:
        self._gain = gain
        self.previous_actions: list[list[float]] = []
        self.frames: list[np.ndarray | None] = []

    def act(self, observation: Observation, rng: np.random.Generator, deterministic: bool = False) -> ChosenAction:
        assert deterministic
        self.previous_actions.append(observation.previous_action.tolist())
        self.frames.append(observation.frames)
        if len(observation.proprioception) < 4:
            return ChosenAction(np.zeros(2, np.float32), 0.0)
        position, velocity = observation.proprioception[:2], observation.proprioception[2:]
        # Far beyond the bounds: the evaluation clips like the bridge does.
        return ChosenAction((-self._gain * (position + 2 * velocity)).astype(np.float32), 0.0)


def evaluation(
    policy: Steering,
    name: str = "dot_reacher",
    seed: int = 0,
    encoding: FrameEncoding = FrameEncoding.RAW,
    **overrides: float,
) -> Evaluation:
    rng = np.random.default_rng(0)
    return Evaluation(load_task(name, overrides=overrides, rng=rng), policy, rng, seed, encoding)


def test_the_policy_sees_what_the_runs_encoding_leaves_of_the_frames() -> None:
    seen = {}
    for encoding in FrameEncoding:
        policy = Steering(gain=0.0)
        evaluation(policy, "visual_dot_reacher", encoding=encoding, time_limit=3).run_episode(0)
        seen[encoding] = np.concatenate(policy.frames)
    raw, jpeg = seen[FrameEncoding.RAW], seen[FrameEncoding.JPEG444]
    np.testing.assert_array_equal(seen[FrameEncoding.ZSTD], raw)
    np.testing.assert_array_equal(jpeg[-1], pixels_of(encode_frames(raw[-1:], FrameEncoding.JPEG444))[0])
    assert (jpeg != raw).any()


def test_a_policy_that_reaches_the_goal_pays_a_step_at_a_time() -> None:
    policy = Steering(gain=2.0)
    episode = evaluation(policy).run_episode(0)
    assert episode.completed
    assert episode.attempts == 1
    assert episode.episode_return == -episode.length
    assert episode.length == len(policy.previous_actions)
    assert policy.previous_actions[0] == [0.0, 0.0]


def test_resets_are_paid_for_and_a_hopeless_policy_is_given_up() -> None:
    episode = evaluation(Steering(gain=0.0), time_limit=5, reset_steps=3).run_episode(0)
    assert episode == EvaluatedEpisode(0, -8.0 * MAX_ATTEMPTS, 8 * MAX_ATTEMPTS, MAX_ATTEMPTS, completed=False)


def test_a_task_without_goal_has_one_attempt_and_free_resets() -> None:
    task = evaluation(Steering(gain=0.0), "noise_frames", time_limit=4, height=8, width=8)
    assert task.run_episode(0) == EvaluatedEpisode(0, -4.0, 4, 1, completed=True)


def test_start_states_depend_on_seed_and_number_alone() -> None:
    fast, slow = evaluation(Steering(gain=2.0)), evaluation(Steering(gain=0.3))
    fast.run_episode(0)
    slow.run_episode(0)
    assert fast.run_episode(1) == evaluation(Steering(gain=2.0)).run_episode(1)
    different = evaluation(Steering(gain=2.0), seed=1)
    assert [fast.run_episode(n).length for n in range(9)] != [different.run_episode(n).length for n in range(9)]


def test_the_first_frame_of_an_attempt_fills_the_stack() -> None:
    policy = Steering(gain=0.0)
    evaluation(policy, "visual_dot_reacher", time_limit=3).run_episode(0)
    for attempt in range(2):
        first, second = policy.frames[3 * attempt], policy.frames[3 * attempt + 1]
        assert first is not None
        assert second is not None
        assert (first[0] == first[2]).all()
        assert (second[0] == first[0]).all()
    assert (np.asarray(policy.frames[0]) != np.asarray(policy.frames[3])).any()


def test_the_text_tells_mean_error_and_time_outs() -> None:
    episodes = [
        EvaluatedEpisode(0, -10.0, 10, 1, completed=True),
        EvaluatedEpisode(1, -30.0, 30, 2, completed=True),
        EvaluatedEpisode(2, -50.0, 50, 20, completed=False),
    ]
    text = evaluation_text(episodes)
    # Standard deviation 20, standard error 20 / sqrt(3).
    assert "return     -30.00 ± 11.55 (standard error)" in text
    assert "3, without time-out 33.3 %" in text
    assert "given up   1" in text
    assert "± " not in evaluation_text(episodes[:1])


def write_run(run_dir: Path, pending_actions: int = 0) -> TaskSpec:
    """A run whose policy is the initial one."""
    tables = {
        "run": {"id": "run1", "directory": str(run_dir)},
        "transport": {"listen_real_time": "tcp/127.0.0.1:1", "listen_bulk": "tcp/127.0.0.1:2"},
        "task": {"name": "dot_reacher", "time_limit": 5, "reset_steps": 0},
    }
    (run_dir / "config").mkdir()
    (run_dir / "config" / "robot_bridge.toml").write_text(tomli_w.dumps(tables), encoding="utf-8")
    spec = load_task("dot_reacher", rng=np.random.default_rng(0)).spec
    weights = pack_weights(
        initial_parameters(observed_spec(spec, pending_actions), 16, (), np.random.default_rng(0)),
        version=3,
        updates=150,
        algorithm="sac",
        hidden_size=16,
        encoder_strides=(),
        dtype="float32",
    )
    (run_dir / "policy.msgpack").write_bytes(encode(weights))
    return spec


@pytest.mark.parametrize("pending_actions", [0, 3])
def test_the_command_evaluates_a_run_with_its_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], pending_actions: int
) -> None:
    write_run(tmp_path, pending_actions)
    assert evaluate.main([str(tmp_path), "--episodes", "2"]) == 0
    out = capsys.readouterr().out
    assert "policy 3, 150 updates" in out
    # The initial policy's centre is no action at all: 20 attempts of 5 steps.
    assert "return     -100.00" in out
    rows = (tmp_path / "evaluation.csv").read_text().splitlines()
    assert rows == ["episode,return,length,attempts,completed", "0,-100.0,100,20,0", "1,-100.0,100,20,0"]


@pytest.mark.parametrize("missing", ["policy.msgpack", "config/robot_bridge.toml", ""])
def test_what_is_missing_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], missing: str) -> None:
    write_run(tmp_path)
    run_dir = tmp_path
    if missing:
        (tmp_path / missing).unlink()
    else:
        run_dir = tmp_path / "nowhere"
    assert evaluate.main([str(run_dir)]) == 1
    assert (missing or "no such run directory") in capsys.readouterr().err


@pytest.mark.parametrize(
    ("fetched", "service", "host", "own"),
    [
        ("config/robot_bridge.toml", "robot_bridge", "local", "learner"),
        ("policy.msgpack", "learner", "remote", "actor"),
    ],
)
def test_the_other_computer_s_file_is_found_among_those_fetched_and_else_said_to_be_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], fetched: str, service: str, host: str, own: str
) -> None:
    write_run(tmp_path)
    RUN.write(tmp_path)
    (tmp_path / "config" / f"{own}.toml").touch()
    copy = tmp_path / "hosts" / host / fetched
    copy.parent.mkdir(parents=True)
    (tmp_path / fetched).rename(copy)
    assert evaluate.main([str(tmp_path), "--episodes", "1"]) == 0
    assert (tmp_path / "evaluation.csv").exists()
    copy.unlink()
    capsys.readouterr()
    assert evaluate.main([str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert f"{tmp_path / fetched} is missing: the {service} ran on the computer {host!r}; copy the file from" in said


def test_a_damaged_policy_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_run(tmp_path)
    (tmp_path / "policy.msgpack").write_bytes(b"\x00")
    assert evaluate.main([str(tmp_path)]) == 1
    assert "PolicyWeights" in capsys.readouterr().err


def test_a_task_that_fails_is_named_and_the_episodes_before_are_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_run(tmp_path)
    run_episode = Evaluation.run_episode

    def fail(self: Evaluation, number: int) -> EvaluatedEpisode:
        if number == 2:
            raise ZeroDivisionError("nowhere to go")
        return run_episode(self, number)

    monkeypatch.setattr(Evaluation, "run_episode", fail)
    assert evaluate.main([str(tmp_path), "--episodes", "5"]) == 1
    said = capsys.readouterr()
    assert said.err.endswith(
        "deploy.evaluate: error: dot_reacher has failed after 2 episodes: ZeroDivisionError: nowhere to go\n"
    )
    assert "in fail" in said.err  # where
    assert "episodes   2, " in said.out
    assert not (tmp_path / "evaluation.csv").exists()  # That of an earlier evaluation stays.


class Remembering:
    """Chooses another action each time, far inside the bounds; keeps what it sees."""

    version = 1

    def __init__(self) -> None:
        self.proprioceptions: list[list[float]] = []
        self.chosen: list[list[float]] = []

    def act(self, observation: Observation, rng: np.random.Generator, deterministic: bool = False) -> ChosenAction:
        self.proprioceptions.append(observation.proprioception.tolist())
        action = np.array([len(self.chosen) + 1, 0], np.float32) / 1024
        self.chosen.append(action.tolist())
        return ChosenAction(action, 0.0)


def test_a_policy_that_wants_its_pending_actions_sees_those_of_the_attempt() -> None:
    policy, rng = Remembering(), np.random.default_rng(0)
    task = load_task("dot_reacher", overrides={"time_limit": 3, "reset_steps": 0}, rng=rng)
    Evaluation(task, policy, rng, 0, pending_actions=2).run_episode(0)
    zeros, chosen = [0.0, 0.0], policy.chosen
    expected = [zeros + zeros, chosen[0] + zeros, chosen[1] + chosen[0], zeros + zeros, chosen[3] + zeros]
    assert [seen[4:] for seen in policy.proprioceptions[:5]] == expected
    assert all(len(seen) == 4 + 2 * 2 for seen in policy.proprioceptions)
