"""A program's output: a status line that is rewritten in a terminal, and sparse elsewhere."""

import io
import os

import pytest

from common.console import PLAIN_PERIOD_S, Console


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_s_status_line_is_rewritten_and_makes_room() -> None:
    out, errors = Terminal(), io.StringIO()
    console = Console(out, errors)
    console.status("one")
    console.status("two")
    console.error("replay has died")
    assert out.getvalue() == "\rone\x1b[K\rtwo\x1b[K\r\x1b[K"
    assert errors.getvalue() == "replay has died\n"


def test_elsewhere_the_status_is_a_line_now_and_then() -> None:
    now_s = 0.0
    out = io.StringIO()
    console = Console(out, io.StringIO(), now_s=lambda: now_s)
    for now_s in (0.0, 1.0, PLAIN_PERIOD_S + 1.0, PLAIN_PERIOD_S + 2.0):
        console.status(f"at {now_s:g}")
    console.line("end")
    assert out.getvalue() == "at 0\nat 11\nend\n"


def test_an_output_without_a_letter_shows_the_rest() -> None:
    shown = io.BytesIO()
    console = Console(io.TextIOWrapper(shown, encoding="ascii"), io.StringIO())
    console.line("3 \u00b1 1")
    console.line("end")
    assert shown.getvalue() == b"3 ? 1\nend\n"


def test_an_output_that_is_full_is_told_once() -> None:
    errors = io.StringIO()
    with open("/dev/full", "w", encoding="utf-8") as out:
        console = Console(out, errors)
        for _ in range(3):
            console.line("nobody reads this")
    assert errors.getvalue() == "nothing more is shown: the output cannot be written: No space left on device\n"


def test_without_outputs_nothing_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout", None)
    monkeypatch.setattr("sys.stderr", None)
    console = Console()
    console.status("going on")
    console.error("an error")


def test_a_reader_who_has_left_is_no_error() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as out:
        console = Console(out, io.StringIO())
        console.line("nobody reads this")
        console.line("nor this")
