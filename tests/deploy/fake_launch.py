"""``fake_launch.py BEHAVIOURS ARGUMENTS``: the launcher, with stand-ins for the services.

BEHAVIOURS is JSON: service -> behaviour of ``fake_service.py``; ``wait`` for those that are not named. However short a
trace is, it is not over before all services have said their first word.
"""

import json
import sys
from pathlib import Path

from common.topics import SERVICES
from deploy import launch, run
from deploy.network import NetworkConditions, link_process

behaviours = json.loads(sys.argv[1])
FAKE = str(Path(__file__).with_name("fake_service.py"))


def fake_command(service: str, config_path: Path) -> list[str]:
    run_dir = config_path.parents[1]
    return [sys.executable, "-S", "-E", FAKE, service, str(run_dir), behaviours.get(service, "wait")]


trace_over = link_process.trace_over


def trace_over_at_last(conditions: NetworkConditions, age_ns: int) -> str | None:
    run_dir = Path(sys.argv[sys.argv.index("--run-dir") + 1])
    all_spoke = len(list(run_dir.glob("parts/*.json"))) == len(SERVICES)
    return trace_over(conditions, age_ns) if all_spoke else None


run.service_command = fake_command
link_process.trace_over = trace_over_at_last
launch.leave(launch.main(sys.argv[2:]))
