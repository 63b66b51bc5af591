"""Replay as most code does it: both stacks of every transition stored, floats made before the crop."""

from __future__ import annotations

import numpy as np
import torch


class PlainReplay:
    """Stores transitions (o, a, r, o') in arrays, images as (S * C, H, W) bytes."""

    def __init__(self, spec, capacity):
        height, width, channels = (int(n) for n in spec.frame_shape)
        images = (capacity, int(spec.frame_stack) * channels, height, width)
        proprioception, action = (capacity, len(spec.proprioception_low)), (capacity, len(spec.action_low))
        self.images, self.next_images = np.zeros(images, np.uint8), np.zeros(images, np.uint8)
        self.proprioception = np.zeros(proprioception, np.float32)
        self.next_proprioception = np.zeros(proprioception, np.float32)
        self.previous_action, self.action = np.zeros(action, np.float32), np.zeros(action, np.float32)
        self.reward, self.terminated = np.zeros(capacity, np.float32), np.zeros(capacity, np.float32)
        self.count = 0

    def add(self, stack, before, next_stack, after):
        """Store the transition from TimeStep ``before`` to ``after``; stacks are S frames (H, W, C), oldest first."""
        at = self.count % len(self.reward)
        self.images[at], self.next_images[at] = self._stacked(stack), self._stacked(next_stack)
        self.proprioception[at], self.next_proprioception[at] = before.proprioception, after.proprioception
        self.previous_action[at], self.action[at] = before.action, after.action
        self.reward[at], self.terminated[at] = after.reward, after.terminated
        self.count += 1

    def sample(self, rng, batch_size, height, width):
        """Return a random minibatch: tensors, images cropped to (height, width) at one random offset."""
        rows = rng.integers(0, min(self.count, len(self.reward)), batch_size)
        top = rng.integers(0, self.images.shape[2] - height + 1)
        left = rng.integers(0, self.images.shape[3] - width + 1)
        return self.gather(rows, top, left, height, width)

    def gather(self, rows, top, left, height, width):
        """Return the transitions ``rows``, images as floats in [0, 1], cropped at (top, left)."""

        def cropped(images):
            floats = torch.as_tensor(images[rows]).float() / 255
            return floats[:, :, top : top + height, left : left + width].contiguous()

        vectors = (self.proprioception, self.previous_action, self.action, self.reward, self.terminated)
        return (
            cropped(self.images),
            cropped(self.next_images),
            *(torch.as_tensor(array[rows]) for array in (*vectors, self.next_proprioception)),
        )

    @property
    def bytes(self):
        """Bytes of all arrays."""
        return sum(array.nbytes for array in vars(self).values() if isinstance(array, np.ndarray))

    @staticmethod
    def _stacked(stack):
        return np.concatenate([frame.transpose(2, 0, 1) for frame in stack])
