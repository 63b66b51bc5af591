"""What a learning algorithm is to the learner: minibatches in, policies out, a complete state for checkpoints."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from common.algorithms.config import AlgorithmConfig
from common.codec import decode
from common.messages import PolicyWeights, TaskSpec
from common.minibatch import Minibatch
from common.networks.precision import Precision

Arrays = dict[str, npt.NDArray[Any]]
"""Flat name -> array, as ``numpy.savez`` stores it: a checkpoint needs no pickle."""


class Algorithm(ABC):
    """Interface of every algorithm; the learner's loop around it is::

    algorithm = load_algorithm(name)(spec, config, seed=seed)
    while True:
        algorithm.update(next_minibatch())
        if algorithm.updates % config.policy_push_interval == 0:
            push(algorithm.encoded_policy(version, config.weights_dtype))
    """

    updates: int
    """Minibatches learnt from, those before a resumed checkpoint included."""

    @abstractmethod
    def __init__(
        self,
        spec: TaskSpec,
        config: AlgorithmConfig,
        *,
        seed: int,
        device: str = "cpu",
        precision: Precision = "auto",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """Create an algorithm with random networks.

        Args:
            spec: the task.
            config: the algorithm's settings.
            seed: of the initial networks and of all later randomness.
            device: torch device of the networks.
            precision: number format of the expensive layers; ``auto`` is bfloat16 where the processor has it.
            dtype: number format of the parameters; float64 for comparisons.
        """

    @abstractmethod
    def update(self, minibatch: Minibatch) -> None:
        """Learn from one minibatch: of an :class:`OnPolicyConfig`, from a rollout, its transitions in order.

        Keeps no reference to the arrays. Off-policy it does not wait for the device.
        """

    def update_in_slices(self, minibatch: Minibatch) -> Iterator[None] | None:
        """Return :meth:`update` in slices: each ``next`` computes one, and the iterator's end is the update's.

        For an update that takes longer than a stop may wait, a second: the learner looks around between slices, and may
        give the update up there, going back to the state before it. None, as here, where :meth:`update` is short.
        Before the first ``next`` nothing changes; before the end, neither ``updates`` nor :meth:`metrics`.
        """
        return None

    @abstractmethod
    def metrics(self) -> dict[str, float]:
        """Return losses and the like of the latest update; empty before the first. Waits for the device."""

    @abstractmethod
    def encoded_policy(self, version: int, dtype: str) -> bytes:
        """Return the payload of the policy's PolicyWeights, as number ``version``, in ``float32`` or ``float16``.

        Raises:
            MessageError: what was learnt is not finite; the text says since when.
        """

    def policy_weights(self, version: int, dtype: str) -> PolicyWeights:
        """Return what a receiver of :meth:`encoded_policy` decodes."""
        return decode(self.encoded_policy(version, dtype), PolicyWeights)

    @abstractmethod
    def state_dict(self) -> Arrays:
        """Return a copy of everything the next update depends on."""

    @abstractmethod
    def load_state_dict(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from :meth:`state_dict`; the next updates are the same to the last bit.

        Raises:
            ConfigError: the arrays belong to other networks; nothing was changed.
        """


def random_seeds(seed: int) -> tuple[np.random.Generator, int]:
    """Return independent sources for the initial networks (a generator) and for the updates (a seed)."""
    networks, updates = np.random.SeedSequence(seed).spawn(2)
    return np.random.default_rng(networks), int(updates.generate_state(1, np.uint64)[0] >> 1)
