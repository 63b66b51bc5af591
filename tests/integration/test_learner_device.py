"""Where the learner's frames are makes no difference to what is learnt; a GPU that is missing is said at once."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from experiments.train import Training, train
from tests.integration.ring_processes import SMALL_AND_FAST, RingProcesses, options, start_all, wait_until

LEARNS_SOON = (
    "algorithm.batch_size=8",
    "algorithm.hidden_size=32",
    "algorithm.min_size_to_sample=30",
    "algorithm.policy_push_interval=5",
    "algorithm.replay_capacity=60",
)
"""And wraps its ring twice in 150 steps."""


def test_a_run_with_frames_on_the_device_is_the_run_with_frames_in_the_ring(tmp_path: Path) -> None:
    for frames in ("host", "device"):
        settings = (*LEARNS_SOON, f"learner.frames={frames}")
        values = train(Training("visual_dot_reacher", tmp_path / frames, steps=150, overrides=settings))
        assert values["updates"] > 60
    host, device = ((tmp_path / frames / "policy.msgpack").read_bytes() for frames in ("host", "device"))
    assert host == device
    log = "logs/train.log"
    assert "frames of the ring are kept on cpu" in (tmp_path / "device" / log).read_text()
    assert "frames of the ring are kept on" not in (tmp_path / "host" / log).read_text()


DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")),
]


@pytest.mark.parametrize("device", DEVICES)
def test_four_processes_learn_from_frames_on_the_device(tmp_path: Path, device: str) -> None:
    settings = options(*SMALL_AND_FAST, f"learner.device={device}", "learner.frames=device")
    with RingProcesses(tmp_path, "noise_frames", "--steps", "1000000", *settings) as ring:
        start_all(ring)
        wait_until(lambda: ring.counter("actor", "policy_version") >= 2, "the actor acts with what was learnt")
        wait_until(lambda: ring.counter("replay", "rows") > 200, "the ring has wrapped")
        ring.interrupt("robot_bridge")
        assert set(ring.wait().values()) == {0}
        assert f"frames of the ring are kept on {device}" in ring.output("learner")
        summary = ring.summary()
    assert summary["experience"]["lost"] == 0
    assert summary["updates"] >= 10


@pytest.mark.skipif(torch.cuda.is_available(), reason="this computer has a GPU")
def test_a_learner_without_its_gpu_ends_at_once_and_says_what_to_do(tmp_path: Path) -> None:
    with RingProcesses(tmp_path, "noise_frames", *options("learner.device=cuda")) as ring:
        ring.start("learner")  # and nobody else: it does not wait for the task
        assert ring.wait() == {"learner": 1}
        output = ring.output("learner")
    assert "learner.device = 'cuda': expected a GPU that torch can use" in output
    assert "`--set learner.device=cpu` learns without one" in output
    assert "Traceback" not in output
