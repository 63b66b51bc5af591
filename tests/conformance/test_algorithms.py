"""What every algorithm of the table promises to the learner."""

from __future__ import annotations

import io
import itertools
import warnings
from dataclasses import fields, replace

import numpy as np
import pytest

from common.algorithms import ALGORITHMS, load_algorithm
from common.algorithms.base import Algorithm
from common.algorithms.presets import presets_of
from common.errors import ConfigError, MessageError
from common.policies import policy_from_weights
from tests.reference.tasks import make_minibatch, make_observation, make_spec

SPECS = {"no camera": make_spec(), "camera": make_spec((32, 36, 3))}


@pytest.fixture(params=ALGORITHMS)
def name(request):
    return request.param


@pytest.fixture(params=SPECS)
def spec(request):
    return SPECS[request.param]


def make_algorithm(name, spec, seed=0, hidden_size=16):
    preset = next(iter(presets_of(name).values()))
    config = replace(preset, hidden_size=hidden_size, encoder_strides=(2, 2, 1, 1))
    return load_algorithm(name)(spec, config, seed=seed)


def minibatches(spec, count, seed=0):
    rng = np.random.default_rng(seed)
    return [make_minibatch(spec, rng) for _ in range(count)]


def stored_and_loaded(state):
    """Return the state after a trip through a file that may not contain pickles."""
    file = io.BytesIO()
    np.savez(file, **state)
    file.seek(0)
    with np.load(file, allow_pickle=False) as loaded:
        return {key: loaded[key] for key in loaded.files}


def assert_equal_states(one, other):
    assert one.keys() == other.keys()
    for key in one:
        np.testing.assert_array_equal(one[key], other[key], err_msg=key)
        assert one[key].dtype == other[key].dtype, key


def test_it_implements_the_interface(name, spec):
    assert issubclass(load_algorithm(name), Algorithm)
    assert make_algorithm(name, spec).updates == 0


def test_equal_seeds_learn_equally_and_others_do_not(name, spec):
    one, same, other = (make_algorithm(name, spec, seed) for seed in (3, 3, 4))
    for minibatch in minibatches(spec, 3):
        for algorithm in (one, same, other):
            algorithm.update(minibatch)
    assert_equal_states(one.state_dict(), same.state_dict())
    different = one.state_dict(), other.state_dict()
    assert any(not np.array_equal(different[0][key], different[1][key]) for key in different[0])


def test_updates_after_a_checkpoint_are_bit_identical(name, spec):
    original, resumed = make_algorithm(name, spec, seed=0), make_algorithm(name, spec, seed=1)
    before, after = minibatches(spec, 3), minibatches(spec, 3, seed=9)
    for minibatch in before:
        original.update(minibatch)
    resumed.load_state_dict(stored_and_loaded(original.state_dict()))
    assert resumed.updates == 3
    assert_equal_states(original.state_dict(), resumed.state_dict())
    for minibatch in after:
        original.update(minibatch)
        resumed.update(minibatch)
    assert resumed.updates == 6
    assert_equal_states(original.state_dict(), resumed.state_dict())


def test_a_checkpoint_before_the_first_update_is_complete_too(name, spec):
    original, resumed = make_algorithm(name, spec, seed=0), make_algorithm(name, spec, seed=1)
    resumed.load_state_dict(stored_and_loaded(original.state_dict()))
    for minibatch in minibatches(spec, 2):
        original.update(minibatch)
        resumed.update(minibatch)
    assert_equal_states(original.state_dict(), resumed.state_dict())


def test_a_state_is_a_copy(name, spec):
    algorithm = make_algorithm(name, spec)
    state = algorithm.state_dict()
    kept = {key: value.copy() for key, value in state.items()}
    algorithm.update(minibatches(spec, 1)[0])
    assert_equal_states(state, kept)


def test_a_checkpoint_of_another_network_is_refused_and_changes_nothing(name, spec):
    algorithm = make_algorithm(name, spec)
    before = algorithm.state_dict()
    wider = make_algorithm(name, spec, hidden_size=24).state_dict()
    incomplete = {key: value for key, value in before.items() if not key.endswith("random_state")}
    for wrong in (wider, incomplete, before | {"surplus": np.zeros(3)}):
        with pytest.raises(ConfigError, match="checkpoint"):
            algorithm.load_state_dict(wrong)
        assert_equal_states(algorithm.state_dict(), before)


def test_read_only_minibatches_are_fine_and_none_is_changed(name, spec):
    algorithm, (minibatch, kept) = make_algorithm(name, spec), minibatches(spec, 1) + minibatches(spec, 1)
    arrays = {f.name: getattr(minibatch, f.name) for f in fields(minibatch)}
    for array in arrays.values():
        if array is not None:
            array.flags.writeable = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        algorithm.update(minibatch)
    for key, array in arrays.items():
        np.testing.assert_array_equal(array, getattr(kept, key))


def test_an_update_in_slices_is_the_update_to_the_last_bit(name, spec):
    at_once, in_slices = make_algorithm(name, spec), make_algorithm(name, spec)
    for updates, minibatch in enumerate(minibatches(spec, 2)):
        slices, metrics = in_slices.update_in_slices(minibatch), in_slices.metrics()
        if slices is None:
            pytest.skip("its update is short")
        for _ in slices:
            assert in_slices.updates == updates
            assert in_slices.metrics() == metrics
        at_once.update(minibatch)
        assert_equal_states(at_once.state_dict(), in_slices.state_dict())
        assert at_once.metrics() == in_slices.metrics()


def test_an_update_given_up_after_any_slice_can_be_made_up_for(name, spec):
    minibatch = minibatches(spec, 1)[0]
    expected, algorithm = make_algorithm(name, spec), make_algorithm(name, spec)
    expected.update(minibatch)
    before, given_up, moved = algorithm.state_dict(), 0, False
    while True:
        slices = algorithm.update_in_slices(minibatch)
        if slices is None:
            pytest.skip("its update is short")
        assert_equal_states(algorithm.state_dict(), before)
        if sum(1 for _ in itertools.islice(slices, given_up + 1)) <= given_up:
            break
        moved |= not np.array_equal(algorithm.state_dict()["actor.1.weight"], before["actor.1.weight"])
        algorithm.load_state_dict(before)
        given_up += 1
    assert moved  # there was something to go back from
    assert_equal_states(algorithm.state_dict(), expected.state_dict())


def test_metrics_are_finite_numbers_and_absent_before_the_first_update(name, spec):
    algorithm = make_algorithm(name, spec)
    assert algorithm.metrics() == {}
    algorithm.update(minibatches(spec, 1)[0])
    metrics = algorithm.metrics()
    assert metrics
    assert all(isinstance(value, float) and np.isfinite(value) for value in metrics.values())


@pytest.mark.parametrize("dtype", ["float32", "float16"])
def test_pushed_weights_make_a_policy_that_acts(name, spec, dtype):
    algorithm = make_algorithm(name, spec)
    for minibatch in minibatches(spec, 2):
        algorithm.update(minibatch)
    weights = algorithm.policy_weights(7, dtype)
    assert (weights.version, weights.updates, weights.algorithm, weights.dtype) == (7, 2, name, dtype)
    policy, rng = policy_from_weights(spec, weights), np.random.default_rng(0)
    assert policy.version == 7
    chosen = policy.act(make_observation(spec, rng), rng)
    assert chosen.action.shape == spec.action_low.shape
    assert np.isfinite(chosen.action).all()
    assert np.isfinite(chosen.log_probability)


def test_what_has_diverged_is_not_pushed_any_more(name, spec):
    algorithm = make_algorithm(name, spec)
    state = algorithm.state_dict()
    state["actor.1.weight"][:] = np.nan
    algorithm.load_state_dict(state)
    algorithm.update(minibatches(spec, 1)[0])
    with pytest.raises(MessageError, match=r"after 1 updates .* has diverged"):
        algorithm.encoded_policy(1, "float32")


def test_pushed_weights_are_those_of_the_moment(name, spec):
    algorithm = make_algorithm(name, spec)
    beginning = algorithm.state_dict()
    for state in (None, beginning):
        algorithm.update(minibatches(spec, 1)[0])
        if state is not None:
            algorithm.load_state_dict(state)
        weights, now = algorithm.policy_weights(1, "float32"), algorithm.state_dict()
        expected = b"".join(now[parameter].tobytes() for parameter in weights.names[:-1])
        assert weights.buffer.tobytes()[: len(expected)] == expected
        assert np.array_equal(now["actor.2.weight"], beginning["actor.2.weight"]) == (state is not None)


def test_pushed_weights_do_not_change_with_later_updates(name, spec):
    algorithm = make_algorithm(name, spec)
    weights = algorithm.policy_weights(1, "float32")
    kept = weights.buffer.copy()
    algorithm.update(minibatches(spec, 1)[0])
    np.testing.assert_array_equal(weights.buffer, kept)
