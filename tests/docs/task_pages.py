"""What the pages that add a task have in common: blocks of code, and the checks that every task has to pass."""

import inspect
import re
from pathlib import Path

import numpy as np
import pytest

from tests.conformance import test_tasks as conformance

ROOT = Path(__file__).resolve().parents[2]


class Page:
    """A document in ``docs/``."""

    def __init__(self, name):
        self.text = (ROOT / "docs" / name).read_text(encoding="utf-8")

    def block(self, language, containing=""):
        """The page's one block of code in ``language`` that contains some text."""
        found = [c for c in re.findall(rf"```{language}\n(.*?)```", self.text, re.DOTALL) if containing in c]
        assert len(found) == 1, f"{len(found)} blocks of {language} contain {containing!r}"
        return found[0]

    def missing_files(self):
        """Links that lead to no file; there have to be some that do."""
        links = re.findall(r"\]\(([^)#]+)\)", self.text)
        assert len(links) >= 4
        return [link for link in links if not (ROOT / "docs" / link).exists()]


def conformance_checks(*presets):
    """Every check of the conformance test that is made for each task of the table, with each set of its arguments."""
    checks = []
    for check_name, check in inspect.getmembers(conformance, inspect.isfunction):
        parameters = set(inspect.signature(check).parameters)
        if not check_name.startswith("test_") or "name" not in parameters:
            continue
        marks = [mark.args for mark in getattr(check, "pytestmark", []) if mark.name == "parametrize"]
        if marks == [(("name", "preset"), conformance.PRESETS)]:
            names, values = ("preset",), [(preset,) for preset in presets]
        elif not marks:
            names, values = (), [()]
        elif "name" in np.ravel([names for names, _ in marks]):
            continue  # it names the tasks that it is about
        else:
            ((names, values),) = marks
        assert parameters == {"name", *names}
        checks += [pytest.param(check, dict(zip(names, v, strict=True)), id=f"{check_name}{v}") for v in values]
    return checks
