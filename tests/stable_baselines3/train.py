"""``make test-stable-baselines3``: a stock learner trains on Dot-Reacher, and what it has learnt is measured.

Stable-Baselines3's SAC with its default settings, which knows nothing of this project but the task's id. Fails if the
policy does not reach the goal more often than before it learnt.
"""

from __future__ import annotations

import sys
import time
from importlib.metadata import version

import gymnasium
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

TASK = "relod/DotReacher-v0"
STEPS = 5000
ATTEMPTS = 50
"""For each measurement, each from its own random start."""


def main() -> int:
    """Train, print what came of it, and return the exit code."""
    print(f"stable-baselines3 {version('stable-baselines3')}, gymnasium {version('gymnasium')}, {TASK}", flush=True)
    untrained = SAC("MlpPolicy", TASK, seed=0)
    before = describe("before", untrained)

    started = time.monotonic()
    model = SAC("MlpPolicy", "relod/DotReacher-v0", seed=0)
    model.learn(5000)
    seconds = time.monotonic() - started
    print(f"{model.num_timesteps} steps, {model._n_updates} updates in {seconds:.0f} s", flush=True)

    after = describe("after", model)
    if model.num_timesteps != STEPS or after <= before:
        print(f"FAILED: expected {STEPS} steps, and more goals than before", file=sys.stderr)
        return 1
    return 0


def describe(when: str, model: SAC) -> int:
    """Run attempts without exploration, print how they went, and return how many reached the goal."""
    task = Monitor(gymnasium.make(TASK))
    goals, lengths = 0, []
    for seed in range(ATTEMPTS):
        observation, info = task.reset(seed=seed)
        ended = False
        while not ended:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = task.step(action)
            ended = terminated or truncated
        goals += info["is_success"]
        lengths.append(info["episode"]["l"])
    task.close()
    mean = sum(lengths) / ATTEMPTS
    print(f"{when:<7}{goals} of {ATTEMPTS} attempts reach the goal, {mean:.1f} steps each on average", flush=True)
    return goals


if __name__ == "__main__":
    sys.exit(main())
