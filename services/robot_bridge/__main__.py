"""``python -m services.robot_bridge --config FILE``: tethered to the robot, runs its action cycle.

``python -m services.robot_bridge --task T --preview DIR`` draws a simulated robot's task instead.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import NoReturn

from common.stop_signals import StopSignals

PREVIEW_OPTIONS = ("--preview", "--task")
"""Whoever gives one of these wants to see a task and no service."""


def main(arguments: Sequence[str]) -> NoReturn:
    """Serve, or draw a preview, as the command line says; then end the process."""
    if any(argument.partition("=")[0] in PREVIEW_OPTIONS for argument in arguments):
        with StopSignals() as stop:
            # Not before: it takes a moment in which Ctrl-C should be heard, and a bridge whose task has no simulated
            # robot needs no MuJoCo.
            from services.robot_bridge import preview

            code = preview.main(arguments, stop)
        sys.exit(code)
    from common import topics
    from common.run_service import end_process, run_service
    from services.robot_bridge.config import RobotBridgeConfig
    from services.robot_bridge.serve import serve

    end_process(run_service(topics.ROBOT_BRIDGE, RobotBridgeConfig, serve, arguments, description=__doc__))


if __name__ == "__main__":
    main(sys.argv[1:])
