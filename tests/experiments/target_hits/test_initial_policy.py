"""The initial policy is tanh of N(0, 1) on the task's own scale."""

import itertools

import numpy as np

from experiments.target_hits.initial_policy import initial_actions
from tests.experiments.target_hits.fake_tasks import FakeSettings, Line
from tests.helpers import make_spec


class Lopsided(Line):
    HIGHEST = 3.0


def draw(spec, count=50_000, seed=0):
    return np.array(list(itertools.islice(initial_actions(spec, np.random.default_rng(seed)), count)))


def test_actions_are_the_tanh_of_a_standard_normal_on_the_scale_of_the_bounds():
    actions = draw(Lopsided(FakeSettings()).spec)  # from -1 to 3: centre 1, half width 2
    assert (actions.dtype, actions.shape) == (np.float32, (50_000, 1))
    normal = np.arctanh((actions.astype(np.float64) - 1) / 2)
    assert abs(normal.mean()) < 0.02
    assert abs(normal.std() - 1) < 0.02
    assert abs((np.abs(normal) < 1).mean() - 0.6827) < 0.01


def test_components_and_steps_are_independent():
    actions = draw(make_spec(camera=False))
    assert abs(np.corrcoef(actions[:, 0], actions[:, 1])[0, 1]) < 0.02
    assert abs(np.corrcoef(actions[1:, 0], actions[:-1, 0])[0, 1]) < 0.02


def test_the_seed_decides():
    spec = make_spec(camera=False)
    np.testing.assert_array_equal(draw(spec, 2000, seed=3), draw(spec, 2000, seed=3))
    assert not np.array_equal(draw(spec, 10, seed=3), draw(spec, 10, seed=4))
