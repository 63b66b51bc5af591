"""The commands in the documents: one way to call Python, and programs that there are."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for folder in (".", "docs", "experiments")
    for path in ROOT.glob(f"{folder}/*.md" if folder == "." else f"{folder}/**/*.md")
)


def text(page):
    return (ROOT / page).read_text(encoding="utf-8")


def test_the_readme_says_once_how_to_get_python():
    assert text("README.md").count(". .venv/bin/activate") == 1
    assert "README.md" in PAGES
    assert "docs/minimum-time.md" in PAGES


@pytest.mark.parametrize("page", PAGES)
def test_python_is_called_by_its_name_and_its_programs_exist(page):
    assert ".venv/bin/python" not in text(page)
    for module in re.findall(r"python -m ([a-z_.]+)", text(page)):
        assert importlib.util.find_spec(module.rstrip(".")), module
