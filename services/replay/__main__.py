"""``python -m services.replay --config FILE``: keeps experience and gives out minibatches."""

from __future__ import annotations

from common import topics
from common.algorithms.presets import resolve_config
from common.run_service import end_process, run_service
from common.service import Service
from services.replay.config import ReplayConfig
from services.replay.replay import Replay


def serve(service: Service, config: ReplayConfig) -> None:
    """Learn from the bridge what the task is, open the ring, serve."""
    spec = service.query_spec()
    if spec is None:
        return
    algorithm = resolve_config(
        config.algorithm.name,
        config.algorithm.preset or spec.algorithm_presets.get(config.algorithm.name, ""),
        config.algorithm.overrides,
    )
    Replay(service, spec, algorithm, config.replay).run()


if __name__ == "__main__":
    end_process(run_service(topics.REPLAY, ReplayConfig, serve, description=__doc__))
