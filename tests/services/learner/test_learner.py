"""The learner updates from what comes, pushes the newest policy, and goes on after a restart."""

from dataclasses import replace

import numpy as np
import pytest

from common import topics
from common.algorithms.ppo import PPO
from common.algorithms.ppo_config import PPOConfig
from common.algorithms.sac import SAC
from common.algorithms.sac_config import SACConfig
from common.clock import FakeClock
from common.codec import decode
from common.messages import Finished, PolicyWeights
from common.policies import policy_from_weights
from common.transport import InMemoryNetwork
from services.learner.checkpoint import CHECKPOINT_FILE, POLICY_FILE, restore
from services.learner.config import LearnerSettings
from services.learner.learner import LAST_UPDATE_S, Learner
from tests.helpers import eventually, make_spec
from tests.reference.tasks import make_minibatch
from tests.services.builders import Peer, SoloService

SPEC = make_spec(camera=False)
CONFIG = SACConfig(hidden_size=32, batch_size=8, policy_push_interval=5)
SETTINGS = LearnerSettings()


def make_algorithm(seed=0, config=CONFIG):
    return SAC(SPEC, config, seed=seed, precision="float32")


class ListedMinibatches:
    """A source of ``count`` random minibatches; then it tells the service to stop."""

    def __init__(self, count, between=lambda given: None, seed=0) -> None:
        self._count, self._between = count, between
        self._rng = np.random.default_rng(seed)
        self.given, self.dropped, self.started, self.stopped = 0, 0, False, False

    def start(self) -> None:
        self.started = True

    def stop(self) -> None:
        self.stopped = True

    def get(self, timeout_s):
        self._between(self.given)
        if self.given == self._count:
            self.service.stop("no more minibatches")
            return None
        self.given += 1
        return make_minibatch(SPEC, self._rng, batch_size=8)


class Scene:
    """A learner that runs on the test's thread until its minibatches are used up."""

    def __init__(
        self,
        directory,
        count,
        between=lambda given: None,
        algorithm=None,
        version=0,
        config=CONFIG,
        settings=SETTINGS,
    ) -> None:
        self.clock = FakeClock()
        self.network = InMemoryNetwork()
        self.service = SoloService(topics.LEARNER, self.network, directory, self.clock)
        self.peer = Peer(self.network)
        self.policies = self.peer.messages(topics.POLICY)
        self.algorithm = algorithm or make_algorithm(config=config)
        self.source = ListedMinibatches(count, between)
        self.source.service = self.service
        self.learner = Learner(self.service, self.algorithm, config, settings, self.source, version)

    def run(self):
        self.learner.run()
        return self


def after_each_push(scene_of):
    """Run a scene whose every push arrives before the next update: none is skipped."""
    scene = None

    def wait(given):
        eventually(lambda: len(scene.policies) >= scene.algorithm.updates // CONFIG.policy_push_interval)

    scene = scene_of(wait)
    return scene.run()


def pushed(scene):
    return [(policy.version, policy.updates) for policy in scene.policies]


def test_each_minibatch_is_one_update_and_every_fifth_update_is_pushed(tmp_path):
    scene = after_each_push(lambda wait: Scene(tmp_path, 12, wait))
    assert scene.algorithm.updates == 12
    assert pushed(scene) == [(1, 5), (2, 10)]
    counters = scene.learner.counters()
    assert (counters["updates"], counters["policy_version"], counters["policy_pushes"]) == (12, 2, 2)
    assert scene.source.started
    assert scene.source.stopped


def test_a_pushed_policy_is_the_algorithms_and_nothing_of_the_critics(tmp_path):
    scene = after_each_push(lambda wait: Scene(tmp_path, 5, wait))
    weights = scene.policies[0]
    expected = scene.algorithm.policy_weights(1, "float32")
    assert (weights.digest, weights.dtype, weights.algorithm) == (expected.digest, "float32", "sac")
    assert not [name for name in weights.names if "critic" in name or "target" in name]
    assert policy_from_weights(SPEC, weights).version == 1


def test_half_precision_halves_the_bytes(tmp_path):
    config = replace(CONFIG, weights_dtype="float16")
    scene = after_each_push(lambda wait: Scene(tmp_path, 5, wait, config=config))
    full = scene.algorithm.policy_weights(1, "float32")
    assert scene.policies[0].dtype == "float16"
    assert scene.policies[0].buffer.nbytes * 2 == full.buffer.nbytes


def test_a_policy_is_newer_than_any_the_actor_has(tmp_path):
    def scene_of(wait):
        scene = Scene(tmp_path, 10, wait)
        scene.service.reported[topics.ACTOR, "policy_version"] = 41
        return scene

    assert pushed(after_each_push(scene_of)) == [(42, 5), (43, 10)]


def test_waiting_for_minibatches_is_no_update(tmp_path):
    scene = Scene(tmp_path, 0)
    empty = [None] * 5
    scene.source.get = lambda timeout_s: empty.pop() if empty else scene.service.stop("enough")
    scene.run()
    assert scene.algorithm.updates == 0


def test_the_run_ends_with_the_bridges_word(tmp_path):
    def finish(given):
        if given == 3:
            scene.service.finished_message = Finished(1, 100, "steps")

    scene = Scene(tmp_path, 50, finish)
    scene.run()
    assert scene.algorithm.updates == 4
    assert scene.service.state == "drained"


def test_a_learner_that_fails_asks_for_nothing_more(tmp_path):
    scene = Scene(tmp_path, 5)
    scene.algorithm.update = lambda minibatch: 1 / 0
    with pytest.raises(ZeroDivisionError):
        scene.run()
    assert scene.source.stopped


def test_losses_are_told_once_a_second(tmp_path):
    scene = Scene(tmp_path, 3, lambda given: scene.clock.advance(0.6))
    scene.run()
    counters = scene.learner.counters()
    assert np.isfinite(counters["critic_loss"])
    assert counters["updates_per_s"] == pytest.approx(1 / 1.2)  # since it was told before


# ---------------------------------------------------------------------- checkpoints


def test_the_end_of_a_run_leaves_a_checkpoint_and_the_policy(tmp_path):
    scene = Scene(tmp_path, 7).run()
    weights = decode((tmp_path / POLICY_FILE).read_bytes(), PolicyWeights)
    assert weights.updates == 7
    assert weights.digest == scene.algorithm.policy_weights(1, "float32").digest
    algorithm = make_algorithm(seed=9)
    assert restore(tmp_path, algorithm) == weights.version
    assert algorithm.updates == 7
    assert not list(tmp_path.glob(".*"))  # nothing half-written is left


def test_a_restarted_learner_goes_on_to_the_last_bit(tmp_path):
    rng = np.random.default_rng(3)
    minibatches = [make_minibatch(SPEC, rng, batch_size=8) for _ in range(5)]
    first = Scene(tmp_path, 7).run()
    second = make_algorithm(seed=9)
    restore(tmp_path, second)
    for minibatch in minibatches:
        first.algorithm.update(minibatch)
        second.update(minibatch)
    expected, got = first.algorithm.state_dict(), second.state_dict()
    assert expected.keys() == got.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(got[name], value, err_msg=name)


def test_a_restarted_learner_pushes_at_once_and_goes_on_counting(tmp_path):
    first = after_each_push(lambda wait: Scene(tmp_path, 12, wait))
    assert pushed(first)[-1] == (2, 10)
    algorithm = make_algorithm(seed=9)
    version = restore(tmp_path, algorithm)

    def wait(given):
        eventually(lambda: len(second.policies) >= 1 + (algorithm.updates >= 15))

    second = Scene(tmp_path, 3, wait, algorithm, version)
    second.run()
    assert pushed(second) == [(3, 12), (4, 15)]


def test_without_a_checkpoint_a_learner_begins_anew(tmp_path):
    assert restore(tmp_path, make_algorithm()) == 0
    scene = after_each_push(lambda wait: Scene(tmp_path, 4, wait))
    assert pushed(scene) == []  # nothing before the first interval


def test_a_checkpoint_is_written_every_now_and_then(tmp_path):
    def between(given):
        if given == 2:
            assert not (tmp_path / CHECKPOINT_FILE).exists()
            scene.clock.advance(30.0)
        if given == 3:
            eventually((tmp_path / CHECKPOINT_FILE).exists)
            algorithm = make_algorithm()
            restore(tmp_path, algorithm)
            assert algorithm.updates == 3

    scene = Scene(tmp_path, 4, between)
    scene.run()


def test_a_checkpoint_is_written_on_command(tmp_path):
    replies = []

    def between(given):
        if given == 1:
            replies.append(scene.peer.command(topics.LEARNER, "checkpoint"))
        if given == 2:
            eventually((tmp_path / CHECKPOINT_FILE).exists)

    scene = Scene(tmp_path, 3, between)
    scene.run()
    assert replies[0].accepted


# ---------------------------------------------------------------------- updates in slices

SLICED = PPOConfig(hidden_size=16, rollout_length=8, batch_size=4, epochs=3, replay_capacity=100)
SLICES = 2 + 2 + 3 * 2
"""Of a rollout whose transitions do not follow each other: values, next values, gradient steps."""


class SlicedScene(Scene):
    """A PPO learner; the test is called before each slice, with the number of the update and of the slice."""

    def __init__(self, directory, count, before_slice=lambda update, number: None, **settings) -> None:
        super().__init__(
            directory, count, self._wait, PPO(SPEC, SLICED, seed=0), 0, SLICED, LearnerSettings(**settings)
        )
        self.slices, self.states = 0, [self.algorithm.state_dict()]
        whole = self.algorithm.update_in_slices

        def update_in_slices(minibatch):
            for number, _ in enumerate(whole(minibatch)):
                before_slice(self.algorithm.updates, number)
                yield
                self.slices += 1

        self.algorithm.update_in_slices = update_in_slices

    def _wait(self, given) -> None:
        eventually(lambda: len(self.policies) >= self.algorithm.updates)
        self.states.append(self.algorithm.state_dict())


def at_once(count, seed=0):
    """The algorithm after ``count`` rollouts of the source, each learnt from in one call."""
    algorithm, rng = PPO(SPEC, SLICED, seed=0), np.random.default_rng(seed)
    for _ in range(count):
        algorithm.update(make_minibatch(SPEC, rng, batch_size=8))
    return algorithm


def assert_equal(got, expected):
    assert got.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(got[name], value, err_msg=name)


def saved(directory):
    """What a learner that is started in ``directory`` goes on from: version, algorithm, and the policy beside it."""
    algorithm = PPO(SPEC, SLICED, seed=9)
    version = restore(directory, algorithm)
    return version, algorithm, decode((directory / POLICY_FILE).read_bytes(), PolicyWeights)


def test_what_is_pushed_after_the_slices_is_what_one_call_learns(tmp_path):
    scene = SlicedScene(tmp_path, 3).run()
    assert scene.slices == 3 * SLICES
    assert pushed(scene) == [(1, 1), (2, 2), (3, 3)]
    for updates, weights in enumerate(scene.policies, start=1):
        assert weights.digest == at_once(updates).policy_weights(updates, "float32").digest
    assert_equal(scene.algorithm.state_dict(), at_once(3).state_dict())


def test_a_stop_command_between_slices_is_obeyed_before_the_next_one(tmp_path):
    def stop(update, number):
        if (update, number) == (1, 7):
            assert not np.array_equal(scene.algorithm.state_dict()["actor.0.weight"], scene.states[2]["actor.0.weight"])
            assert scene.peer.command(topics.LEARNER, "stop").accepted

    scene = SlicedScene(tmp_path, 5, stop)
    scene.run()
    assert scene.slices == SLICES + 7
    assert scene.algorithm.updates == 1
    assert pushed(scene) == [(1, 1)]
    # What is left on disk is whole: the last complete update, and its policy under the version it was pushed with.
    version, algorithm, policy = saved(tmp_path)
    assert (version, policy.version, policy.updates) == (1, 1, 1)
    assert policy.digest == scene.policies[0].digest
    assert_equal(algorithm.state_dict(), at_once(1).state_dict())


def test_after_a_stop_in_an_update_the_same_rollout_is_learnt_from_as_if_nothing_had_happened(tmp_path):
    scene = SlicedScene(tmp_path, 5, lambda update, number: number == 8 and update == 1 and scene.service.stop("test"))
    scene.run()
    _, algorithm, _ = saved(tmp_path)
    rng = np.random.default_rng(0)
    _, second = (make_minibatch(SPEC, rng, batch_size=8) for _ in range(2))
    algorithm.update(second)
    assert_equal(algorithm.state_dict(), at_once(2).state_dict())


def test_a_checkpoint_asked_for_in_an_update_is_that_of_its_end(tmp_path):
    def ask(update, number):
        assert update > 0 or not (tmp_path / CHECKPOINT_FILE).exists()
        if (update, number) == (0, 5):
            assert scene.peer.command(topics.LEARNER, "checkpoint").accepted
        if (update, number) == (1, 0):
            eventually((tmp_path / CHECKPOINT_FILE).exists)
            version, algorithm, policy = saved(tmp_path)
            assert (version, policy.version) == (1, 1)
            assert_equal(algorithm.state_dict(), at_once(1).state_dict())
            seen.append(update)

    seen = []
    scene = SlicedScene(tmp_path, 2, ask)
    scene.run()
    assert seen == [1]


@pytest.mark.parametrize(
    ("reason", "goes_on_s", "updates"),
    [("steps", LAST_UPDATE_S - 0.1, 1), ("steps", LAST_UPDATE_S, 0), ("stopped", 0.0, 0)],
)
def test_the_end_of_the_steps_lets_a_running_update_end_if_that_is_soon(tmp_path, reason, goes_on_s, updates):
    def finish(update, number):
        if number == 4:
            scene.service.finished_message = Finished(1, 100, reason)
        if number == 6:
            scene.clock.advance(goes_on_s)

    scene = SlicedScene(tmp_path, 5, finish)
    scene.run()
    assert scene.algorithm.updates == updates
    assert_equal(saved(tmp_path)[1].state_dict(), at_once(updates).state_dict())
    assert scene.service.state == "drained"


def test_the_least_time_of_an_update_is_that_of_all_its_slices(tmp_path):
    scene = SlicedScene(tmp_path, 3, lambda update, number: scene.clock.advance(0.1), min_update_s=2.0)
    began_ns = scene.clock.now_ns()
    scene.run()
    assert scene.clock.now_ns() - began_ns == 3 * 2_000_000_000
