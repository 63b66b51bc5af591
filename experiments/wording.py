"""Numbers in sentences."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """``1 step``, ``2 steps``."""
    return f"{number} {plural(number, noun)}"


def plural(number: int, noun: str) -> str:
    """``step`` after 1, ``steps`` after any other number."""
    return noun if number == 1 else f"{noun}s"
