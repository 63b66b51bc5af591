"""Values of command-line options that several programs have."""

from __future__ import annotations

import argparse
from pathlib import Path


def output_folder(text: str) -> Path:
    """A folder to write into, for :mod:`argparse`: an empty text, as of a variable that is not set, is none."""
    if not text:
        raise argparse.ArgumentTypeError("expected a folder, got an empty text; the current one is .")
    return Path(text)
