"""docs/add-an-algorithm.md, followed literally."""

import inspect
import re
import sys
from pathlib import Path

import pytest

from common.algorithms.table import ALGORITHMS, AlgorithmRow
from experiments.train import Training, train
from tests.conformance import test_algorithms as conformance

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "add-an-algorithm.md").read_text(encoding="utf-8")
SETTINGS, ALGORITHM, ROW = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture
def reinforce(tmp_path, monkeypatch):
    """The page's files, where Python finds them, and its row in the table."""
    folder = tmp_path / "files"
    folder.mkdir()
    (folder / "reinforce_config.py").write_text(SETTINGS, encoding="utf-8")
    (folder / "reinforce.py").write_text(ALGORITHM, encoding="utf-8")
    monkeypatch.syspath_prepend(folder)
    ((name, row),) = eval("{" + ROW + "}", {"AlgorithmRow": AlgorithmRow}).items()
    monkeypatch.setitem(ALGORITHMS, name, row)
    yield name
    for module in ("reinforce", "reinforce_config"):
        sys.modules.pop(module, None)


def checks():
    """Every check of the conformance test, with each set of its other arguments."""
    found = []
    for check_name, check in inspect.getmembers(conformance, inspect.isfunction):
        parameters = set(inspect.signature(check).parameters)
        if check_name.startswith("test_") and {"name", "spec"} <= parameters:
            others = [(None, None)] if parameters == {"name", "spec"} else [("dtype", "float32"), ("dtype", "float16")]
            assert parameters <= {"name", "spec", "dtype"}
            found += [pytest.param(check, *other, id=f"{check_name} {other[1]}") for other in others]
    return found


@pytest.mark.parametrize(("check", "argument", "value"), checks())
@pytest.mark.parametrize("spec", conformance.SPECS.values(), ids=conformance.SPECS)
def test_the_algorithm_passes_the_checks_of_every_algorithm(reinforce, check, argument, value, spec):
    check(name=reinforce, spec=spec, **({argument: value} if argument else {}))


def test_there_are_such_checks():
    assert len(checks()) >= 10


def test_the_services_run_it(reinforce, tmp_path):
    overrides = ("algorithm.preset=dot_reacher", "algorithm.rollout_length=100", "algorithm.replay_capacity=1000")
    run = Training("dot_reacher", tmp_path / "run", algorithm=reinforce, steps=330, overrides=overrides)
    values = train(run)
    assert values["algorithm"] == reinforce
    assert values["updates"] == values["rollouts"]["complete"] == 2
    assert values["policy_version"] == values["updates"]


def test_files_the_page_links_to_exist():
    links = re.findall(r"\]\(([^)#]+)\)", PAGE)
    assert len(links) >= 3
    for link in links:
        assert (ROOT / "docs" / link).exists(), link
