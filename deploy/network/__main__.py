"""``python -m deploy.network``: tools for the emulated network."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence

from common.errors import RelodError
from common.stop_signals import INTERRUPTED
from deploy.network.check import add_check_arguments, run_check


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m deploy.network", description="Tools for the emulated network.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    check = commands.add_parser(
        "check",
        help="hold each backend against the [network] table",
        description="Hold each way of emulating a network against the [network] table, with traffic of its own.",
    )
    add_check_arguments(check)
    parsed = parser.parse_args(arguments)
    try:
        return run_check(parsed)
    except RelodError as error:
        print(f"deploy.network: error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    # Being told to end is no reason to leave namespaces behind, nor is being started where Ctrl-C is ignored.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.default_int_handler)
    sys.exit(main())
