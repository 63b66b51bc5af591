"""One side of a comparison, in a process of its own: ``python -m benchmarks.side_program MODULE:FUNCTION OPTIONS``.

The function prepares everything and warms it up; then each line on the standard input asks for one round of
measurement, answered by one line of JSON on the standard output. The process ends with its standard input, so it
never outlives who asked.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import traceback
from contextlib import ExitStack
from typing import Any, TextIO

from benchmarks.side import Prepared, UnavailableError


def main() -> int:
    """Prepare the side named on the command line and serve rounds until the standard input ends."""
    # Ctrl-C ends the process that asks, and this one by the end of its standard input.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Whatever prints, in whatever library: the answers have a channel of their own.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    module, _, function = sys.argv[1].partition(":")
    with ExitStack() as resources:
        try:
            prepare = getattr(importlib.import_module(module), function)
            side: Prepared = prepare(resources, **json.loads(sys.argv[2]))
            _answer(answers, {"result": side.result})
            for _ in sys.stdin:
                _answer(answers, {"samples": side.measure()})
        except UnavailableError as error:
            _answer(answers, {"unavailable": str(error)})
        except Exception as error:
            _answer(answers, {"error": f"{type(error).__name__}: {error}"})
            traceback.print_exc()
            return 1
    return 0


def _answer(answers: TextIO, values: dict[str, Any]) -> None:
    answers.write(json.dumps(values) + "\n")
    answers.flush()


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    os._exit(code)  # torch takes seconds to be torn down
