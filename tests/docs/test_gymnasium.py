"""docs/gymnasium.md, followed literally."""

import doctest
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "gymnasium.md").read_text()


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)


def test_the_examples_print_what_the_page_says():
    examples = doctest.DocTestParser().get_doctest("\n".join(blocks("pycon")), {}, "docs/gymnasium.md", None, None)
    assert len(examples.examples) > 10
    complaints = []
    results = doctest.DocTestRunner().run(examples, out=complaints.append)
    assert results.failed == 0, "".join(complaints)


@pytest.mark.parametrize("block", blocks("python"))
def test_the_stock_learner_is_trained_as_the_page_says(block):
    script = (ROOT / "tests" / "stable_baselines3" / "train.py").read_text()
    assert "".join(f"    {line}\n" for line in block.splitlines()) in script


def test_there_is_a_stock_learner_on_the_page():
    assert len(blocks("python")) == 1
