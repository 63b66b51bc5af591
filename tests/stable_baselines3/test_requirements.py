"""What a stock learner's environment must have for this project's tasks, found without making that environment."""

import importlib.metadata
import json
import re
import subprocess
import sys
from pathlib import Path

_LOCK = Path(__file__).with_name("requirements.lock")
_THIS_PROJECT = "relod"
_PLAY = """
import importlib.metadata, json, sys
before = set(sys.modules)
import gymnasium
environment = gymnasium.make("relod/DotReacher-v0")
environment.reset(seed=0)
environment.step(environment.action_space.sample())
print(json.dumps(sorted({name.partition(".")[0] for name in set(sys.modules) - before})))
"""


def test_all_that_a_task_imports_is_in_the_environment_of_the_stock_learner():
    printed = subprocess.run(
        [sys.executable, "-c", _PLAY], capture_output=True, text=True, check=True, timeout=60
    ).stdout
    owners = importlib.metadata.packages_distributions()
    imported = {owner.lower() for name in json.loads(printed) for owner in owners.get(name, [])} - {_THIS_PROJECT}
    assert {"gymnasium", "numpy", "xxhash"} <= imported
    locked = set(re.findall(r"^([a-z0-9-]+)==", _LOCK.read_text(encoding="utf-8"), re.MULTILINE))
    assert {name.replace("_", "-") for name in imported} <= locked
