"""``python tied_command.py PARENT_PID COMMAND...``: becomes COMMAND, which gets SIGTERM if the parent dies.

The launcher starts the services through it, so that none of them is left behind when the launcher is killed; a study
starts the launcher through it. It is a program of its own because a launcher with threads must not run Python code
between fork and exec.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Tie this process to its parent, then become the command."""
    parent_pid, command = int(sys.argv[1]), sys.argv[2:]
    # Linux keeps the setting over exec, also over that of `ip netns exec`.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != parent_pid:  # it died before it could be told to signal
        sys.exit("the process that started this one has ended")
    # What the parent has blocked would stay blocked in the command, which then could not be ended in order.
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    try:
        os.execvp(command[0], command)
    except OSError as error:
        sys.exit(f"{command[0]}: cannot be started: {error.strerror}")


if __name__ == "__main__":
    main()
