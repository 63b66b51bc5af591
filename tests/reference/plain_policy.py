"""Acting written as plainly as torch allows: what the policies of :mod:`common.policies` are compared with.

The whole network in torch, float images in NCHW, distributions from ``torch.distributions``; the network that is
trained acts, and its result is detached. It computes the same action and the same log-probability, from the same
parameters.
"""

from __future__ import annotations

import numpy as np
import torch
from torch.distributions import Normal, TanhTransform, TransformedDistribution

from tests.reference.plain_sac import PlainEncoder, perceptron


class PlainPolicy:
    """The policy with the parameters of :mod:`common.policies.weights`."""

    def __init__(self, spec, parameters, encoder_strides, hidden_size):
        self.spec = spec
        self.encoder = None
        vector = len(spec.proprioception_low) + len(spec.action_low)
        if spec.has_camera:
            self.encoder = PlainEncoder(int(spec.frame_stack * spec.frame_shape[2]), encoder_strides)
            named = self.encoder.convolutions.named_parameters()
            self._load(named, parameters, "encoder")
            vector += 64
        self.actor = perceptron(vector, hidden_size, 2 * len(spec.action_low))
        layers = enumerate(self.actor[::2])
        self._load(((f"{i}.{n}", p) for i, layer in layers for n, p in layer.named_parameters()), parameters, "actor")
        self.log_std_low, self.log_std_high = parameters["log_std_bounds"].tolist()

    def act(self, observation, deterministic=False):
        """Return (action, log-probability), physical units."""
        spec = self.spec
        vector = torch.cat(
            [
                self._unit(observation.proprioception, spec.proprioception_low, spec.proprioception_high),
                self._unit(observation.previous_action, spec.action_low, spec.action_high),
            ]
        )[None]
        if self.encoder is not None:
            top, left = (int(n) for n in spec.crop_margin)
            images = np.concatenate([frame.transpose(2, 0, 1) for frame in observation.frames])
            height, width = images.shape[1:]
            cropped = torch.as_tensor(images).float()[None, :, top : height - top, left : width - left] / 255
            vector = torch.cat([self.encoder(cropped), vector], dim=1)
        mean, log_std = self.actor(vector).chunk(2, dim=1)
        low, high = self.log_std_low, self.log_std_high
        std = torch.exp(low + (high - low) * (torch.tanh(log_std) + 1) / 2)
        squash = TanhTransform(cache_size=1)
        distribution = TransformedDistribution(Normal(mean, std), [squash])
        unit_action = squash(mean) if deterministic else distribution.rsample()
        log_probability = distribution.log_prob(unit_action).sum().item()
        action_low, action_high = torch.as_tensor(spec.action_low), torch.as_tensor(spec.action_high)
        action = action_low + (unit_action[0] + 1) / 2 * (action_high - action_low)
        return action.detach().numpy(), log_probability

    @staticmethod
    def _load(named, parameters, prefix):
        for name, parameter in named:
            parameter.data.copy_(torch.tensor(np.array(parameters[f"{prefix}.{name}"])))

    @staticmethod
    def _unit(values, low, high):
        values, low, high = (torch.as_tensor(np.array(v)) for v in (values, low, high))
        return 2 * (values - low) / (high - low) - 1
