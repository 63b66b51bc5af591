"""Computers that a learner may run on: the three of the thesis, and host files that are wrong."""

from pathlib import Path

import pytest

from common.errors import ConfigError
from deploy.hosts import host_names, load_host

GOOD = "[host]\ndevice = 'cpu'\nthreads = 2\ninference_s = 0.005\nupdates_per_step = 0.5\nreplay_capacity = 5000\n"


def host_file(folder: Path, text: str) -> Path:
    path = folder / "my_board.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("name", "updates_per_step", "replay_capacity"),
    [("workstation", 1.0, 100_000), ("laptop", 1 / 3, 16_000), ("jetson", 1 / 12, 16_000)],
)
def test_the_computers_of_the_thesis_have_their_rates_and_memories(
    name: str, updates_per_step: float, replay_capacity: int
) -> None:
    host = load_host(name)
    assert host.name == name
    assert host.updates_per_step == pytest.approx(updates_per_step, rel=1e-9)
    assert host.replay_capacity == replay_capacity


def test_a_weaker_computer_infers_more_slowly_and_every_one_within_the_shortest_action_cycle() -> None:
    inference_s = [load_host(name).inference_s for name in ("workstation", "laptop", "jetson")]
    assert inference_s == sorted(inference_s)
    # The thesis's Jetson acted on board in Create-Reacher's cycle of 45 ms, and UR5's laptop in 40 ms.
    assert inference_s[0] > 0.0
    assert inference_s[-1] < 0.040


def test_the_hosts_that_come_with_the_project_are_listed() -> None:
    assert host_names() == ["jetson", "laptop", "workstation"]


def test_a_host_file_is_a_host_of_its_name(tmp_path: Path) -> None:
    host = load_host(host_file(tmp_path, GOOD))
    assert (host.name, host.threads, host.inference_s) == ("my_board", 2, 0.005)


def test_an_unknown_host_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"'jetsn'.*jetson, laptop, workstation.*did you mean 'jetson'"):
        load_host("jetsn")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GOOD.replace("threads = 2", "threads = -1"), r"threads = -1: expected a value from 0 to 256"),
        (GOOD.replace("threads = 2", "threads = 'two'"), r"threads = 'two': expected a whole number"),
        (GOOD.replace("0.005", "-0.1"), r"inference_s = -0.1: expected a value from 0.0 to 10.0"),
        (GOOD.replace("0.005", "nan"), r"inference_s = nan: expected a finite number"),
        (GOOD.replace("0.5", "0"), r"updates_per_step = 0.0: expected a value from 1e-06"),
        (GOOD.replace("5000", "1"), r"replay_capacity = 1: expected a value from 2"),
        (GOOD.replace("'cpu'", "'gpu'"), r"device = 'gpu': expected cpu, cuda or cuda:N"),
        (GOOD.replace("threads = 2\n", ""), r"threads is missing; expected a whole number"),
        (GOOD + "memory = 3\n", r"unknown key 'memory'"),
        (GOOD + "[hosts]\n", r"unknown section \[hosts\]; expected only \[host\]"),
        ("host = 3", r"host = 3: expected a table"),
        ("[host", "not a TOML file"),
    ],
)
def test_a_wrong_host_file_is_refused_by_file_key_and_value(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as refused:
        load_host(host_file(tmp_path, text))
    assert "my_board.toml" in str(refused.value)
