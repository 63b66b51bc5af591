"""PPO written as plainly as torch allows: what :class:`common.algorithms.ppo.PPO` is compared with.

Advantages by their definition, as sums over what follows; a value for every next observation; contiguous NCHW float
images; one loss with ``backward()`` per network, unfused Adam, distributions from ``torch.distributions``. Its
parameters come from, and go back to, the names of ``PPO.state_dict``.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import nn
from torch.distributions import Normal, TanhTransform, TransformedDistribution

from tests.reference.plain_sac import PlainEncoder, perceptron


def plain_advantages(reward, value, next_value, terminated, rows, discount, gae_lambda):
    """H_t = sum over k of (gamma lambda)^k delta_(t+k), as far as the rows follow each other (eq. 3.16, 3.17)."""
    delta = [
        r + discount * (0.0 if end else after) - before
        for r, before, after, end in zip(reward, value, next_value, terminated, strict=True)
    ]
    sums = []
    for t in range(len(delta)):
        total, k = 0.0, 0
        while True:
            total += (discount * gae_lambda) ** k * delta[t + k]
            at_end = t + k + 1 == len(delta) or terminated[t + k] or rows[t + k + 1] != rows[t + k] + 1
            if at_end:
                break
            k += 1
        sums.append(total)
    return torch.stack(sums)


class PlainPPO:
    """The same algorithm, with the parameters of ``state`` (``PPO.state_dict``)."""

    def __init__(self, spec, config, state, shuffle, noise, dtype):
        self.spec, self.config, self.shuffle, self.noise, self.dtype = spec, config, shuffle, noise, dtype
        actions = len(spec.action_low)
        vector = len(spec.proprioception_low) + actions
        self.encoder = None
        if spec.has_camera:
            self.encoder = PlainEncoder(int(spec.frame_stack * spec.frame_shape[2]), config.encoder_strides).to(dtype)
            vector += 64
        self.actor = perceptron(vector, config.hidden_size, 2 * actions).to(dtype)
        self.critic = perceptron(vector, config.hidden_size, 1).to(dtype)
        for name, parameter in self.named_parameters().items():
            parameter.data.copy_(torch.from_numpy(state[name]))
        self.value_parameters = list(self.critic.parameters())
        if self.encoder is not None:
            self.value_parameters += list(self.encoder.parameters())
        self.critic_adam = torch.optim.Adam(self.value_parameters, config.critic_lr, config.adam_betas)
        self.actor_adam = torch.optim.Adam(self.actor.parameters(), config.actor_lr, config.adam_betas)

    def update(self, rollout):
        config, spec = self.config, self.spec
        images, next_images = self._images(rollout.frames), self._images(rollout.next_frames)
        low, high = spec.proprioception_low, spec.proprioception_high
        applied, previous, chosen = (
            self._unit(action, spec.action_low, spec.action_high)
            for action in (rollout.action, rollout.previous_action, rollout.chosen_action)
        )
        vector = torch.cat([self._unit(rollout.proprioception, low, high), previous], dim=1)
        next_vector = torch.cat([self._unit(rollout.next_proprioception, low, high), applied], dim=1)
        reward = torch.tensor(rollout.reward, dtype=self.dtype)
        old_log_probability = torch.tensor(rollout.log_probability, dtype=self.dtype)
        with torch.no_grad():
            value = self.critic(self._seen(images, vector))[:, 0]
            next_value = self.critic(self._seen(next_images, next_vector))[:, 0]
        advantage = plain_advantages(
            reward, value, next_value, rollout.terminated, rollout.rows, config.discount, config.gae_lambda
        )
        target = advantage + value
        if config.normalise_advantages:
            advantage = (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-8)
        for _ in range(config.epochs):
            order = self.shuffle(len(reward))
            for start in range(0, len(order), config.batch_size):
                batch = order[start : start + config.batch_size]
                self._gradient_step(
                    None if images is None else images[batch],
                    vector[batch],
                    chosen[batch],
                    old_log_probability[batch],
                    advantage[batch],
                    target[batch],
                )

    def _gradient_step(self, images, vector, action, old_log_probability, advantage, target):
        config = self.config
        seen = self._seen(images, vector)
        value_loss = nn.functional.mse_loss(self.critic(seen)[:, 0], target)

        mean, log_std = self.actor(seen.detach()).chunk(2, dim=1)
        low, high = config.log_std_low, config.log_std_high
        std = torch.exp(low + (high - low) * (torch.tanh(log_std) + 1) / 2)
        distribution = TransformedDistribution(Normal(mean, std), [TanhTransform()])
        ratio = torch.exp(distribution.log_prob(action).sum(dim=1) - old_log_probability)
        surrogate = torch.min(
            ratio * advantage, torch.clamp(ratio, 1 - config.clip, 1 + config.clip) * advantage
        ).mean()
        drawn = mean + std * self.noise(*mean.shape)
        slope = torch.log(1 - torch.tanh(drawn) ** 2)
        entropy = -(Normal(mean, std).log_prob(drawn) - slope).sum(dim=1).mean()
        actor_loss = -surrogate - config.entropy_coefficient * entropy

        for loss, adam, parameters in (
            (value_loss, self.critic_adam, self.value_parameters),
            (actor_loss, self.actor_adam, list(self.actor.parameters())),
        ):
            adam.zero_grad()
            loss.backward()
            norm = torch.sqrt(sum((p.grad**2).sum() for p in parameters))
            if config.max_gradient_norm and norm > config.max_gradient_norm:
                for parameter in parameters:
                    parameter.grad *= config.max_gradient_norm / (norm + 1e-6)
            adam.step()

    def named_parameters(self):
        """Return name -> parameter, by PPO's names."""
        named = {}
        if self.encoder is not None:
            named |= {f"encoder.{n}": p for n, p in self.encoder.convolutions.named_parameters()}
        for name, network in (("actor", self.actor), ("critic", self.critic)):
            for i, layer in enumerate(network[::2]):
                named |= {f"{name}.{i}.weight": layer.weight, f"{name}.{i}.bias": layer.bias}
        return named

    def _seen(self, images, vector):
        return vector if self.encoder is None else torch.cat([self.encoder(images), vector], dim=1)

    def _unit(self, values, low, high):
        values, low, high = (torch.tensor(np.array(v), dtype=self.dtype) for v in (values, low, high))
        return 2 * (values - low) / (high - low) - 1

    def _images(self, frames):
        if frames is None:
            return None
        return torch.tensor(np.ascontiguousarray(frames.transpose(0, 3, 1, 2)), dtype=self.dtype) / 255
