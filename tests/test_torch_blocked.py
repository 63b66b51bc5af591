"""The robot's side runs on computers that have no torch: every import of it fails here, as if it were not installed."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

BLOCKED = """
import sys
sys.modules["torch"] = None  # any import of torch is now an ImportError
"""

ACTING = """
import threading
import numpy as np
from common.policies import initial_policy
from common.policies.numpy_policy import NumpyPolicy
from common.algorithms.presets import resolve_config
from common.run_settings import RunSettings
from common.service import Service
from common.transport import InMemoryNetwork
from services.actor.actor import Actor
from services.actor.config import ActorSettings
from services.replay.config import ReplaySettings
from services.replay.replay import Replay
from services.robot_bridge.bookkeeping import Totals
from services.robot_bridge.bridge import RobotBridge
from services.robot_bridge.config import RobotBridgeSettings
from services.robot_bridge.tasks import load_task

directory = sys.argv[1]
network = InMemoryNetwork()
run = RunSettings(id="test", directory=directory)
task = load_task("dot_reacher", pacing="lockstep", rng=np.random.default_rng(0))
config = resolve_config("sac", "dot_reacher", {"hidden_size": 32})
policy = initial_policy(task.spec, config.hidden_size, config.encoder_strides, 0)
assert isinstance(policy, NumpyPolicy)
services = {name: Service(name, run, network.transport(run)) for name in ("robot_bridge", "actor", "replay")}
settings = RobotBridgeSettings(steps=40, pacing="lockstep")
made = {
    "robot_bridge": RobotBridge(services["robot_bridge"], task, settings, Totals()),
    "actor": Actor(services["actor"], task.spec, policy, ActorSettings()),
    "replay": Replay(services["replay"], task.spec, config, ReplaySettings()),
}

def serve(name):
    services[name].start()
    made[name].run()
    services[name].close()

threads = [threading.Thread(target=serve, args=(name,)) for name in made]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
produced = made["robot_bridge"].counts.produced
print("produced", produced, "kept", made["replay"].counters()["rows"], "acted", made["actor"].counters()["actions"])
assert made["replay"].counters()["rows"] == produced > 40
assert made["actor"].counters()["actions"] > 40
"""


def run_blocked(code, *arguments):
    """Run Python without torch; return what it printed."""
    process = subprocess.run(
        [sys.executable, "-c", BLOCKED + code, *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    return process.stdout


@pytest.mark.parametrize(
    "module",
    [
        "services.robot_bridge.serve",
        "services.replay.__main__",
        "services.actor.__main__",
        "services.robot_bridge.tasks.visual_dot_reacher",
        "services.robot_bridge.tasks.noise_frames",
    ],
)
def test_a_service_can_be_started_without_torch(module):
    assert "imported" in run_blocked(f"import {module}; print('imported')")


def test_bridge_actor_and_replay_run_without_torch(tmp_path):
    assert "produced" in run_blocked(ACTING, str(tmp_path))
    parts = list((tmp_path / "parts").glob("*.json"))
    assert {path.name.split("-")[0] for path in parts} == {"robot_bridge", "actor", "replay"}
    assert (tmp_path / "metrics" / "replay.csv").exists()


def test_the_block_blocks():
    with pytest.raises(AssertionError, match="torch"):
        run_blocked("import torch")
