"""Soft Actor-Critic written as plainly as torch allows: what the fast one is compared with.

Two critics as separate modules, contiguous NCHW float images, ``backward()`` on everything, unfused Adam. It computes
what :class:`common.algorithms.sac.SAC` says it computes, in particular the features once per update. Its parameters
come from, and go back to, the names of ``SAC.state_dict``.
"""

from __future__ import annotations

import copy

import numpy as np
import torch
from torch import nn
from torch.distributions import Normal, TanhTransform, TransformedDistribution


class PlainEncoder(nn.Module):
    """Convolutions, softmax over positions, expected positions."""

    def __init__(self, channels, strides):
        super().__init__()
        sizes = [channels, *[32] * len(strides)]
        self.convolutions = nn.ModuleList(
            nn.Conv2d(n_in, 32, 3, stride, bias=i < len(strides) - 1)
            for i, (n_in, stride) in enumerate(zip(sizes, strides, strict=False))
        )

    def forward(self, images):
        maps = images
        for i, convolution in enumerate(self.convolutions):
            maps = convolution(maps)
            if i < len(self.convolutions) - 1:
                maps = torch.relu(maps)
        rows, columns = maps.shape[2:]
        probabilities = torch.softmax(maps.reshape(*maps.shape[:2], rows * columns), dim=2).reshape(maps.shape)
        x = torch.linspace(-1, 1, columns, dtype=maps.dtype)
        y = torch.linspace(-1, 1, rows, dtype=maps.dtype)
        expected_x = (probabilities.sum(dim=2) * x).sum(dim=2)
        expected_y = (probabilities.sum(dim=3) * y).sum(dim=2)
        return torch.stack([expected_x, expected_y], dim=2).reshape(len(maps), -1)


def perceptron(n_in, hidden, n_out):
    return nn.Sequential(
        nn.Linear(n_in, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, n_out)
    )


class PlainSAC:
    """The same algorithm, with the parameters of ``state`` (``SAC.state_dict``)."""

    def __init__(self, spec, config, state, noise, dtype):
        self.spec, self.config, self.noise, self.dtype = spec, config, noise, dtype
        actions = len(spec.action_low)
        vector = len(spec.proprioception_low) + actions
        self.encoder = None
        if spec.has_camera:
            self.encoder = PlainEncoder(int(spec.frame_stack * spec.frame_shape[2]), config.encoder_strides)
            self.encoder.to(dtype)
            vector += 64
        self.actor = perceptron(vector, config.hidden_size, 2 * actions).to(dtype)
        self.critics = nn.ModuleList(perceptron(vector + actions, config.hidden_size, 1) for _ in range(2)).to(dtype)
        self.target_encoder = copy.deepcopy(self.encoder)
        self.target_critics = copy.deepcopy(self.critics)
        self.log_temperature = nn.Parameter(torch.zeros((), dtype=dtype))
        for name, parameter in self.named_parameters().items():
            parameter.data.copy_(torch.from_numpy(self._theirs(name, state)))
        critic_parameters = list(self.critics.parameters())
        if self.encoder is not None:
            critic_parameters += list(self.encoder.parameters())
        self.critic_adam = torch.optim.Adam(critic_parameters, config.critic_lr, config.adam_betas)
        self.actor_adam = torch.optim.Adam(self.actor.parameters(), config.actor_lr, config.adam_betas)
        self.temperature_adam = torch.optim.Adam(
            [self.log_temperature], config.temperature_lr, config.temperature_betas
        )
        self.losses = {}

    def update(self, minibatch):
        config = self.config
        images, next_images = self._images(minibatch.frames), self._images(minibatch.next_frames)
        low, high = self.spec.proprioception_low, self.spec.proprioception_high
        action = self._unit(minibatch.action, self.spec.action_low, self.spec.action_high)
        previous_action = self._unit(minibatch.previous_action, self.spec.action_low, self.spec.action_high)
        vector = torch.cat([self._unit(minibatch.proprioception, low, high), previous_action], dim=1)
        next_vector = torch.cat([self._unit(minibatch.next_proprioception, low, high), action], dim=1)
        reward = torch.tensor(minibatch.reward, dtype=self.dtype)
        terminated = torch.tensor(minibatch.terminated, dtype=self.dtype)
        temperature = self.log_temperature.exp()

        observation = self._join(self.encoder, images, vector)
        with torch.no_grad():
            next_action, next_log_probability = self._act(self._join(self.encoder, next_images, next_vector))
            target_observation = self._join(self.target_encoder, next_images, next_vector)
            q1, q2 = self._values(self.target_critics, target_observation, next_action)
            value = torch.minimum(q1, q2) - temperature * next_log_probability
            target = reward + config.discount * (1 - terminated) * value
        q1, q2 = self._values(self.critics, observation, action)
        critic_loss = nn.functional.mse_loss(q1, target) + nn.functional.mse_loss(q2, target)
        self.critic_adam.zero_grad()
        critic_loss.backward()
        self.gradients = self._gradients("critic", "encoder")
        self.critic_adam.step()

        new_action, log_probability = self._act(observation.detach())
        q1, q2 = self._values(self.critics, observation.detach(), new_action)
        actor_loss = (temperature.detach() * log_probability - torch.minimum(q1, q2)).mean()
        self.actor_adam.zero_grad()
        actor_loss.backward()
        self.gradients |= self._gradients("actor")
        self.actor_adam.step()

        temperature_loss = -(temperature * (log_probability.detach() - len(self.spec.action_low))).mean()
        self.temperature_adam.zero_grad()
        temperature_loss.backward()
        self.temperature_adam.step()

        with torch.no_grad():
            pairs = [(self.critics, self.target_critics, config.critic_tau)]
            if self.encoder is not None:
                pairs.append((self.encoder, self.target_encoder, config.encoder_tau))
            for source, target_module, tau in pairs:
                for p, t in zip(source.parameters(), target_module.parameters(), strict=True):
                    t.copy_(tau * p + (1 - tau) * t)
        self.losses = {"critic_loss": critic_loss.item(), "actor_loss": actor_loss.item()}

    def named_parameters(self):
        """Return name -> parameter; the names are SAC's, with ``:0`` or ``:1`` for one of its two critics."""
        named = {"log_temperature": self.log_temperature}
        for prefix, encoder in (("encoder", self.encoder), ("target_encoder", self.target_encoder)):
            if encoder is not None:
                named |= {f"{prefix}.{n}": p for n, p in encoder.convolutions.named_parameters()}
        for i, layer in enumerate(self.actor[::2]):
            named |= {f"actor.{i}.weight": layer.weight, f"actor.{i}.bias": layer.bias}
        for prefix, critics in (("critic", self.critics), ("target_critic", self.target_critics)):
            for twin, critic in enumerate(critics):
                for i, layer in enumerate(critic[::2]):
                    named[f"{prefix}.weight{i}:{twin}"] = layer.weight
                    named[f"{prefix}.bias{i}:{twin}"] = layer.bias
        return named

    def difference(self, theirs, mine):
        """Return name -> (their array, mine), in my layout, for two dictionaries by SAC's and by my names."""
        return {name: (self._theirs(name, theirs), np.asarray(value)) for name, value in mine.items()}

    def _gradients(self, *prefixes):
        named = self.named_parameters().items()
        return {n: p.grad.numpy().copy() for n, p in named if n.split(".")[0] in prefixes}

    @staticmethod
    def _theirs(name, arrays):
        """Return one of SAC's arrays in my layout: a critic of the two, weights as (outputs, inputs)."""
        base, _, twin = name.partition(":")
        array = arrays[base]
        if not twin:
            return array
        return array[int(twin)].T if "weight" in base else array[int(twin), 0]

    def _unit(self, values, low, high):
        values, low, high = (torch.tensor(np.array(v), dtype=self.dtype) for v in (values, low, high))
        return 2 * (values - low) / (high - low) - 1

    def _images(self, frames):
        if frames is None:
            return None
        return torch.tensor(np.ascontiguousarray(frames.transpose(0, 3, 1, 2)), dtype=self.dtype) / 255

    @staticmethod
    def _join(encoder, images, vector):
        return vector if encoder is None else torch.cat([encoder(images), vector], dim=1)

    @staticmethod
    def _values(critics, observation, action):
        inputs = torch.cat([observation, action], dim=1)
        return [critic(inputs)[:, 0] for critic in critics]

    def _act(self, observation):
        mean, log_std = self.actor(observation).chunk(2, dim=1)
        low, high = self.config.log_std_low, self.config.log_std_high
        std = torch.exp(low + (high - low) * (torch.tanh(log_std) + 1) / 2)
        action_before_tanh = mean + std * self.noise(*mean.shape)
        squash = TanhTransform(cache_size=1)
        action = squash(action_before_tanh)
        distribution = TransformedDistribution(Normal(mean, std), [squash])
        return action, distribution.log_prob(action).sum(dim=1)
