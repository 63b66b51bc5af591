"""Replay and an actor without camera run where torch is not installed."""

from __future__ import annotations

import subprocess
import sys

SCRIPT = """
import sys
sys.modules["torch"] = None  # any import of torch now raises ImportError

import numpy as np
from common.algorithms import ALGORITHMS
from common.algorithms.presets import presets_of, resolve_config
from common.policies import initial_policy, pack_weights, policy_from_weights
from common.policies.weights import initial_parameters
from tests.reference.tasks import make_observation, make_spec

for name in ALGORITHMS:
    assert "dot_reacher" in presets_of(name)
config = resolve_config("sac", "dot_reacher", {"batch_size": 32})
spec, rng = make_spec(), np.random.default_rng(0)
observation = make_observation(spec, rng)
initial_policy(spec, config.hidden_size, config.encoder_strides, seed=0).act(observation, rng)
parameters = initial_parameters(spec, 16, (), rng)
weights = pack_weights(
    parameters, version=1, updates=1, algorithm="sac", hidden_size=16, encoder_strides=(), dtype="float16"
)
action = policy_from_weights(spec, weights).act(observation, rng).action
assert action.shape == (2,)
initial_policy(spec, 256, (), seed=0).act(observation, rng)
assert not {"llvmlite", "numba"} & set(sys.modules)
initial_policy(spec, 512, (), seed=0)  # compiled now, not when the first policy comes
assert "llvmlite" in sys.modules and "numba" not in sys.modules
"""


def test_presets_and_policies_without_camera_work_with_torch_blocked():
    result = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
