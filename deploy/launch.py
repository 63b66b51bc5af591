"""``python -m deploy.launch MODE --task TASK``: runs the four services, from their configurations to the summary.

It starts the same commands that a user types by hand (``--write-config`` prints them). A service that dies is
reported at once, with the command that brings it back; the others go on.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from common.errors import RelodError
from common.stop_signals import StopSignals


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line; return the exit code."""
    logging.basicConfig(level=logging.WARNING, format="deploy.launch: %(message)s")
    with StopSignals() as stop:
        # Imported only now, because it takes a moment in which Ctrl-C should be heard.
        from common.console import Console
        from deploy.options import parse_options
        from deploy.run import launch, write_configurations
        from deploy.side import launch_side

        try:
            options = parse_options(arguments)
            if options.write_config:
                return write_configurations(options, options.write_config)
            if options.side:
                return launch_side(options, options.side, stop, Console())
            return launch(options, stop, Console())
        except RelodError as error:
            print(f"deploy.launch: error: {error}", file=sys.stderr)
        except OSError as error:
            print(f"deploy.launch: error: {error.filename or 'system'}: {error.strerror}", file=sys.stderr)
    return 1


def leave(code: int) -> NoReturn:
    """End this process at once: shutting Python down under a thread that still loads the drawing library crashes."""
    with contextlib.suppress(OSError):  # nobody may be reading any more
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    leave(main())
