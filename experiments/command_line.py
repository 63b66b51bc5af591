"""What the command lines of the experiments have in common: how errors and an early Ctrl-C are told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from common.console import Console
from common.errors import RelodError
from common.stop_signals import INTERRUPTED


def exit_code(program: str, option: str, folder: Path, console: Console, run: Callable[[], int]) -> int:
    """Run a program; tell what ends it, and return its exit code.

    Args:
        program: its name.
        option: that chooses its folder, e.g. ``--out``.
        folder: of its results.
        console: where to tell.
        run: does the work and returns the exit code. Once it can be interrupted with something to keep, it sees to
            that itself.
    """
    try:
        return run()
    except KeyboardInterrupt:
        console.line("interrupted before anything was begun")
        return INTERRUPTED
    except RelodError as error:
        console.error(f"{program}: error: {error}")
    except OSError as error:
        console.error(f"{program}: error: {_os_error_text(error, option, folder)}")
    return 1


def _os_error_text(error: OSError, option: str, folder: Path) -> str:
    """What the system refused, and by which option it can be changed if it is about the folder of the results."""
    chosen = f"{option} {folder}"
    if error.filename is None:  # A file is open already; what is written without pause is in that folder.
        return f"{chosen}: {error.strerror}; choose another folder with {option}"
    path, directory = Path(error.filename).absolute(), folder.absolute()
    if path == directory:
        return f"{chosen}: {error.strerror}; choose another folder with {option}"
    if path.is_relative_to(directory) or directory.is_relative_to(path):
        return f"{chosen}: {error.filename}: {error.strerror}; choose another folder with {option}"
    return f"{error.filename}: {error.strerror}"
