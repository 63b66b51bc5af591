"""``fake_launch.py BEHAVIOURS ARGUMENTS``: the launcher, with stand-ins for the services.

BEHAVIOURS is JSON: service -> behaviour of ``fake_service.py``; ``wait`` for those that are not named.
"""

import json
import sys
from pathlib import Path

from deploy import launch, run

behaviours = json.loads(sys.argv[1])
FAKE = str(Path(__file__).with_name("fake_service.py"))


def fake_command(service: str, config_path: Path) -> list[str]:
    run_dir = config_path.parents[1]
    return [sys.executable, "-S", "-E", FAKE, service, str(run_dir), behaviours.get(service, "wait")]


run.service_command = fake_command
launch.leave(launch.main(sys.argv[2:]))
