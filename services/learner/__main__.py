"""``python -m services.learner --config FILE``: updates the policy."""

from __future__ import annotations

import logging
import os
from functools import partial
from pathlib import Path

from common import topics
from common.run_service import end_process, run_service
from common.service import Service
from services.learner.config import LearnerConfig

logger = logging.getLogger(__name__)

NOTHING_LEARNT = {"updates": 0.0, "policy_pushes": 0.0, "policy_version": 0.0}
"""Counts of a learner that has not begun: importing torch takes seconds, and the run may be over before."""


def serve(service: Service, config: LearnerConfig) -> None:
    """Learn from the bridge what the task is, build the algorithm, update."""
    service.counters = NOTHING_LEARNT.copy
    settings, name = config.learner, config.algorithm.name
    # Before torch is imported, which takes seconds of computing: not even that may delay the bridge.
    os.nice(settings.nice)
    from common.algorithms import load_algorithm
    from common.algorithms.presets import resolve_config
    from common.cpu_tuning import tune_process
    from common.frame_ring import RING_FILE, RingReader
    from common.pending_actions import observed_spec
    from services.learner.checkpoint import restore
    from services.learner.device import open_device, too_little_memory_explained
    from services.learner.device_frames import DeviceRingReader
    from services.learner.learner import Learner
    from services.learner.minibatches import MappedMinibatches, MinibatchSource, ReceivedMinibatches

    logger.info("%s", tune_process(settings.threads or None))
    device = open_device(settings.device)
    algorithm_class = load_algorithm(name)
    spec = service.query_spec()
    if spec is None:
        return
    preset = config.algorithm.preset or spec.algorithm_presets.get(name, "")
    algorithm_config = resolve_config(name, preset, config.algorithm.overrides)
    spec = observed_spec(spec, algorithm_config.pending_actions)
    directory = Path(config.run.directory)
    with too_little_memory_explained(device):
        algorithm = algorithm_class(
            spec, algorithm_config, seed=config.run.seed, device=settings.device, precision=settings.precision
        )
        version = restore(directory, algorithm)
        source: MinibatchSource
        random_crop = algorithm_config.random_crop
        if settings.access == "map":
            open_ring = partial(DeviceRingReader, device=device) if settings.frames_on_device else RingReader
            source = MappedMinibatches(
                service, spec, settings.prefetch, directory / RING_FILE, open_ring, random_crop=random_crop
            )
        else:
            source = ReceivedMinibatches(service, spec, settings.prefetch, random_crop=random_crop)
        Learner(service, algorithm, algorithm_config, settings, source, version).run()


if __name__ == "__main__":
    end_process(run_service(topics.LEARNER, LearnerConfig, serve, description=__doc__))
