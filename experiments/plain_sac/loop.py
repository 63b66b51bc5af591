"""Soft Actor-Critic on Dot-Reacher in one file, as a textbook has it: what the whole system is compared with.

One loop: act, advance the world, store, update once. No messages, no services, no ring, no speed-ups, nothing of
``common``: only the task's world, and the numbers of its SAC preset, are taken from the project.
"""

from __future__ import annotations

import copy
from collections import deque
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from services.robot_bridge.tasks import load_task

BATCH_SIZE, HIDDEN_SIZE, REPLAY_CAPACITY, MIN_SIZE = 64, 256, 20_000, 200
LEARNING_RATE, TEMPERATURE_LR, TAU, DISCOUNT = 1e-3, 1e-4, 0.03, 1.0
INITIAL_TEMPERATURE = 0.1
LOG_STD_LIMIT = 10.0


def mlp(n_in: int, n_out: int) -> nn.Sequential:
    """Two hidden layers."""
    return nn.Sequential(
        nn.Linear(n_in, HIDDEN_SIZE),
        nn.ReLU(),
        nn.Linear(HIDDEN_SIZE, HIDDEN_SIZE),
        nn.ReLU(),
        nn.Linear(HIDDEN_SIZE, n_out),
    )


class Agent:
    """Twin critics with targets, a tanh-Gaussian actor, a learned temperature (thesis section 3.2)."""

    def __init__(self, n_observation: int, n_action: int) -> None:
        self.actor = mlp(n_observation, 2 * n_action)
        nn.init.zeros_(self.actor[-1].weight)
        nn.init.zeros_(self.actor[-1].bias)
        self.critics = nn.ModuleList(mlp(n_observation + n_action, 1) for _ in range(2))
        self.targets = copy.deepcopy(self.critics)
        self.log_temperature = torch.tensor(np.log(INITIAL_TEMPERATURE), requires_grad=True)
        self.target_entropy = -n_action
        self.actor_adam = torch.optim.Adam(self.actor.parameters(), LEARNING_RATE)
        self.critic_adam = torch.optim.Adam(self.critics.parameters(), LEARNING_RATE)
        self.temperature_adam = torch.optim.Adam([self.log_temperature], TEMPERATURE_LR, betas=(0.5, 0.999))

    def act(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions in [-1, 1] and their log-densities."""
        mean, raw = self.actor(observation).chunk(2, dim=-1)
        gaussian = torch.distributions.Normal(mean, (LOG_STD_LIMIT * torch.tanh(raw)).exp())
        before = gaussian.rsample()
        # log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x))
        squash = 2 * (np.log(2) - before - nn.functional.softplus(-2 * before))
        return torch.tanh(before), (gaussian.log_prob(before) - squash).sum(-1)

    def update(self, batch: list[torch.Tensor]) -> None:
        """One step for critics, actor and temperature; then the targets follow."""
        observation, action, reward, terminated, following = batch
        with torch.no_grad():
            next_action, next_log = self.act(following)
            pair = torch.cat([following, next_action], 1)
            q = torch.min(*(critic(pair)[:, 0] for critic in self.targets))
            target = reward + DISCOUNT * (1 - terminated) * (q - self.log_temperature.exp() * next_log)
        pair = torch.cat([observation, action], 1)
        self._step(self.critic_adam, sum(((critic(pair)[:, 0] - target) ** 2).mean() for critic in self.critics))
        chosen, log_density = self.act(observation)
        pair = torch.cat([observation, chosen], 1)
        q = torch.min(*(critic(pair)[:, 0] for critic in self.critics))
        temperature = self.log_temperature.exp()
        self._step(self.actor_adam, (temperature.detach() * log_density - q).mean())
        self._step(self.temperature_adam, temperature * (-log_density.detach().mean() - self.target_entropy))
        with torch.no_grad():
            for target_value, value in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
                target_value.lerp_(value, TAU)

    @staticmethod
    def _step(adam: torch.optim.Adam, loss: torch.Tensor) -> None:
        adam.zero_grad()
        loss.backward()
        adam.step()


@dataclass
class Result:
    """What a run came to."""

    goal_steps: list[int]
    """Steps of the run, resets included, at each goal."""


def run(seed: int, steps: int) -> Result:
    """Learn Dot-Reacher (preset ``demo``) for ``steps`` action cycles, resets included."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    task = load_task("dot_reacher", rng=np.random.default_rng([seed, 1]))
    spec = task.spec
    cycle_ns = round(spec.action_cycle_time_s * 1e9)
    agent = Agent(len(spec.proprioception_low) + 2, 2)
    replay: deque[tuple[np.ndarray, ...]] = deque(maxlen=REPLAY_CAPACITY)
    now_ns, taken, index, previous = 0, 0, 0, np.zeros(2, np.float32)
    goal_steps: list[int] = []
    task.advance_to(now_ns)
    task.begin_episode()

    def observe() -> np.ndarray:
        scaled = task.read().proprioception / spec.proprioception_high
        return np.concatenate([scaled, previous]).astype(np.float32)

    observation = observe()
    while taken < steps:
        with torch.no_grad():
            action = agent.act(torch.from_numpy(observation))[0].numpy()
        task.command(action)
        now_ns += cycle_ns
        task.advance_to(now_ns)
        outcome = task.outcome()
        previous, taken, index = action, taken + 1, index + 1
        following = observe()
        replay.append((observation, action, np.float32(outcome.reward), np.float32(outcome.terminated), following))
        observation = following
        if len(replay) >= MIN_SIZE:
            rows = rng.integers(0, len(replay), BATCH_SIZE)
            agent.update(
                [torch.from_numpy(np.stack(column)) for column in zip(*(replay[row] for row in rows), strict=True)]
            )
        if outcome.terminated or index == spec.time_limit_steps:
            if outcome.terminated:
                goal_steps.append(taken)
                task.begin_episode()
            else:
                taken += spec.reset_steps
                task.begin_attempt()
            index, previous = 0, np.zeros(2, np.float32)
            observation = observe()
    return Result(goal_steps)
