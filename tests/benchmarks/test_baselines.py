"""What ours is compared with computes the same: a baseline that does something else would make any number look good."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import replay
from benchmarks.scene import recorded_experience, trained_parameters
from common.algorithms.sac_config import SACConfig
from common.frame_ring import RingReader
from common.policies import pack_weights, policy_from_weights
from tests.reference.plain_policy import PlainPolicy
from tests.reference.tasks import make_observation, make_spec

CONFIG = SACConfig(hidden_size=32, encoder_strides=(2, 2, 1, 1))
SPECS = {"camera": make_spec((32, 36, 3), crop_margin=(2, 3)), "state": make_spec()}


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
def test_the_plain_policy_acts_as_ours_does(spec):
    parameters, strides = trained_parameters(spec, CONFIG), CONFIG.encoder_strides if spec.has_camera else ()
    weights = pack_weights(
        parameters,
        version=1,
        updates=1,
        algorithm="sac",
        hidden_size=32,
        encoder_strides=strides,
        dtype="float32",
    )
    ours, plain = policy_from_weights(spec, weights), PlainPolicy(spec, parameters, CONFIG.encoder_strides, 32)
    rng = np.random.default_rng(0)
    for _ in range(3):
        observation = make_observation(spec, rng)
        chosen = ours.act(observation, rng, deterministic=True)
        action, log_probability = plain.act(observation, deterministic=True)
        np.testing.assert_allclose(action, chosen.action, atol=1e-5)
        assert log_probability == pytest.approx(chosen.log_probability, abs=1e-4)
        assert np.ptp([plain.act(observation)[0] for _ in range(3)], axis=0).min() > 0  # it explores


def test_the_plain_replay_holds_and_crops_what_the_ring_does():
    spec = SPECS["camera"]
    spec = replace(spec, action_low=-np.ones(2, np.float32), action_high=np.ones(2, np.float32))
    with ExitStack() as resources:
        reader = RingReader(replay.fill_ring(resources, spec, transitions=200))
        plain = replay.fill_plain_replay(spec, transitions=200)
        rows = np.arange(1, reader.rows_appended)
        rows = rows[reader.valid_pairs(rows)]
        assert len(rows) == plain.count == 200
        ours = reader.gather(rows, (28, 30), (1, 4)).minibatch
        images, next_images, *vectors = plain.gather(np.arange(200), 1, 4, 28, 30)
        reader.close()
    for mine, other in ((ours.frames, images), (ours.next_frames, next_images)):
        np.testing.assert_allclose(other.permute(0, 2, 3, 1).numpy() * 255, mine, atol=1e-3)
    names = ("proprioception", "previous_action", "action", "reward", "terminated", "next_proprioception")
    for name, values in zip(names, vectors, strict=True):
        np.testing.assert_array_equal(getattr(ours, name), values)


def test_recorded_experience_has_attempts_of_their_length_and_a_frame_a_step():
    stream = recorded_experience(make_spec((8, 8, 3)))
    steps = [next(stream).time_step for _ in range(302)]
    assert [step.seq for step in steps if step.is_first] == [0, 151]
    assert [step.seq for step in steps if step.is_last] == [150, 301]
    assert {len(step.frames) for step in steps} == {1}
