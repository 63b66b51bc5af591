"""``python -m services.actor --config FILE``: computes actions."""

from __future__ import annotations

import logging

from threadpoolctl import threadpool_limits

from common import topics
from common.algorithms.presets import resolve_config
from common.cpu_tuning import keep_freed_memory
from common.pending_actions import observed_spec
from common.policies import initial_policy
from common.priority import ACTOR_PRIORITY, run_before_others
from common.run_service import end_process, run_service
from common.service import Service
from services.actor.actor import Actor
from services.actor.config import ActorConfig

logger = logging.getLogger(__name__)


def serve(service: Service, config: ActorConfig) -> None:
    """Learn from the bridge what the task is, build the initial policy, act."""
    spec = service.query_spec()
    if spec is None:
        return
    keep_freed_memory()
    # Two threads that wait for each other on a contended core are a hundred times slower than one.
    threadpool_limits(config.actor.threads)
    if spec.has_camera:
        import torch  # only the policies of camera tasks compute with it

        torch.set_num_threads(config.actor.threads)
    name = config.algorithm.name
    algorithm = resolve_config(
        name, config.algorithm.preset or spec.algorithm_presets.get(name, ""), config.algorithm.overrides
    )
    policy = initial_policy(
        observed_spec(spec, algorithm.pending_actions),
        algorithm.hidden_size,
        algorithm.encoder_strides,
        config.run.seed,
        zero_initialised_head=algorithm.zero_initialised_head,
    )
    actor = Actor(service, spec, policy, config.actor, pending_actions=algorithm.pending_actions)
    if config.actor.real_time_priority and spec.pacing == "realtime":
        # Not before torch has been imported, which is seconds of computing.
        logger.info("%s", run_before_others(ACTOR_PRIORITY))
    actor.run()


if __name__ == "__main__":
    end_process(run_service(topics.ACTOR, ActorConfig, serve, description=__doc__))
