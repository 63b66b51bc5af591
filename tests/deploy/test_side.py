"""Two launchers, each with a run directory of its own and stand-ins for the services, on two addresses of loopback."""

import json
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from deploy import launch
from deploy.computers import other_host
from deploy.network import HOSTS, Host
from deploy.ports import held_ports, reserved_ports
from deploy.side import SIDE_PORTS
from tests.deploy.test_launch import REPOSITORY, finish, is_running, wait_for_parts
from tests.helpers import eventually

ADDRESSES = {"local": "127.0.0.2", "remote": "127.0.0.3"}
MODE = """
[services]
robot_bridge = "local"
actor = "local"
replay = "remote"
learner = "remote"

[endpoints]
local = "127.0.0.2"
remote = "127.0.0.3"
"""


class Computers:
    """Starts the launchers of both computers."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.mode = folder / "two.toml"
        self.mode.write_text(MODE, encoding="utf-8")
        with reserved_ports(SIDE_PORTS) as ports:
            self.base_port = ports[0]
        self.launchers: list[subprocess.Popen[str]] = []

    def run_dir(self, host: str) -> Path:
        return self.folder / host

    def command(self, host: str, *options: str) -> list[str]:
        words = [str(self.mode), "--task", "dot_reacher", "--host", host, "--run-dir", str(self.run_dir(host))]
        return [*words, "--base-port", str(self.base_port), *options]

    def start(self, host: str, *options: str, **behaviours: str) -> subprocess.Popen[str]:
        """Start a launcher; ``behaviours`` are those of the stand-ins for its services."""
        launcher = subprocess.Popen(
            [sys.executable, "-m", "tests.deploy.fake_launch", json.dumps(behaviours), *self.command(host, *options)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=REPOSITORY,
        )
        self.launchers.append(launcher)
        return launcher

    def summary(self, host: str) -> dict[str, object]:
        values: dict[str, object] = json.loads((self.run_dir(host) / "summary.json").read_text())
        return values


@pytest.fixture
def computers(tmp_path: Path) -> Iterator[Computers]:
    computers = Computers(tmp_path)
    yield computers
    for launcher in computers.launchers:
        launcher.kill()
        launcher.communicate()


def read_until(launcher: subprocess.Popen[str], stream: str, text: str) -> str:
    """Read what a launcher says until it has said ``text``."""
    said = ""
    while text not in said:
        line = getattr(launcher, stream).readline()
        assert line, said
        said += line
    return said


def test_each_side_starts_its_own_services_and_both_have_the_whole_record(computers: Computers) -> None:
    sides = {
        "local": computers.start("local", "--steps", "100", robot_bridge="done", actor="done"),
        "remote": computers.start("remote", "--steps", "100", replay="hears", learner="hears"),
    }
    said = {host: finish(launcher) for host, launcher in sides.items()}
    own = {"local": ["robot_bridge", "actor"], "remote": ["replay", "learner"]}
    facts = {}
    for host, (code, _, errors) in said.items():
        run_dir = computers.run_dir(host)
        assert code == 0, errors
        assert sorted(path.stem for path in (run_dir / "config").iterdir()) == sorted(own[host])
        assert {path.name.partition("-")[0] for path in run_dir.glob("parts/*.json")} == set(own[host])
        facts[host] = tomllib.loads((run_dir / "run.toml").read_text())["run"]
        assert computers.summary(host)["steps"] == 100
        assert computers.summary(host)["service_failures"] == []
    assert facts["local"]["id"] == facts["remote"]["id"]
    assert facts["local"]["network"] == "real"
    assert computers.summary("local") == computers.summary("remote")
    assert "100/100 100 %" in said["local"][1]
    assert "remote has ended: well" in said["local"][1]


def test_ctrl_c_on_the_strong_computer_ends_its_services_and_is_told_on_the_other(computers: Computers) -> None:
    local, remote = computers.start("local"), computers.start("remote")
    here, there = wait_for_parts(computers.run_dir("local"), 2), wait_for_parts(computers.run_dir("remote"), 2)
    mirrored = computers.run_dir("remote") / "hosts" / "local"
    wait_for_parts(mirrored, 2)  # until then, the run has not begun as far as remote knows
    wait_for_parts(computers.run_dir("local") / "hosts" / "remote", 2)
    remote.send_signal(signal.SIGINT)
    code, _, _ = finish(remote)
    assert code == 130
    assert not any(map(is_running, there))
    said = read_until(local, "stdout", "fake_service.py learner")
    assert "remote has ended: stopped by Ctrl-C" in said
    assert "start again there" in said
    assert all(map(is_running, here))
    local.send_signal(signal.SIGINT)
    code, _, errors = finish(local)
    assert code == 130
    assert not any(map(is_running, here))
    assert "the record of remote may not be complete here" in errors
    assert computers.summary("local")["steps"] == 100


@pytest.mark.parametrize("killed", ["local", "remote"])
def test_a_killed_launcher_s_services_end_and_its_successor_is_told_what_can_be_done(
    computers: Computers, killed: Host
) -> None:
    there = other_host(killed)
    launchers = {host: computers.start(host) for host in HOSTS}
    pids = wait_for_parts(computers.run_dir(killed), 2)
    wait_for_parts(computers.run_dir(there) / "hosts" / killed, 2)  # until then, the other side may not have agreed
    launchers[killed].kill()
    launchers[killed].communicate()
    eventually(lambda: not any(map(is_running, pids)))
    (computers.folder / "first").mkdir()
    computers.run_dir(killed).rename(computers.folder / "first" / killed)
    code, _, errors = finish(computers.start(killed))
    assert code == 1
    assert f"the launcher of '{there}' is in a run with another launcher of '{killed}'" in errors
    assert f"end the run on {there}, with Ctrl-C if need be, and start both sides anew" in errors
    # Only the robot's side goes on without the other, and shows how that can return.
    assert ("shows the commands that start the services of remote again" in errors) == (killed == "remote")
    assert not computers.run_dir(killed).exists()


def test_ctrl_c_on_the_robot_s_computer_ends_both(computers: Computers) -> None:
    local, remote = computers.start("local"), computers.start("remote")
    pids = [pid for host in ("local", "remote") for pid in wait_for_parts(computers.run_dir(host), 2)]
    wait_for_parts(computers.run_dir("remote") / "hosts" / "local", 2)
    local.send_signal(signal.SIGINT)
    code, _, _ = finish(local)
    assert code == 130
    _, out, errors = finish(remote)
    # The stand-ins there hear nothing of the bridge's end, so the launcher ends them.
    assert "local has ended: stopped by Ctrl-C" in out
    assert "stopping the services" in out
    assert not any(map(is_running, pids)), errors
    assert computers.summary("local") == computers.summary("remote")


def test_a_service_that_dies_there_is_told_here(computers: Computers) -> None:
    local = computers.start("local", robot_bridge="wait")
    computers.start("remote", learner="crash")
    said = read_until(local, "stderr", "start it again")
    assert "remote: learner has died: exit code 1" in said


def test_two_commands_that_are_not_the_same_start_nothing_and_say_what_differs(computers: Computers) -> None:
    sides = [computers.start("local", "--steps", "5"), computers.start("remote", "--steps", "6", "--run-id", "mine")]
    for launcher, values in zip(sides, ("5 on local, 6 on remote", "6 on remote, 5 on local"), strict=True):
        code, _, errors = finish(launcher)
        assert code == 1
        assert "do not start the same run" in errors
        assert f"robot_bridge: robot_bridge.steps: {values}" in errors
        assert "--run-id: " in errors
    assert not computers.run_dir("local").exists()
    assert not computers.run_dir("remote").exists()


def test_endpoints_that_do_not_match_are_named(computers: Computers) -> None:
    local = computers.start("local", "--endpoint", "remote=127.0.0.4")
    remote = computers.start("remote")
    for launcher in (local, remote):
        code, _, errors = finish(launcher)
        assert code == 1
        assert "endpoint remote: 127.0.0." in errors
    assert not computers.run_dir("local").exists()


def test_a_launcher_that_nobody_answers_gives_up_and_says_what_to_look_at(
    computers: Computers, capsys: pytest.CaptureFixture[str]
) -> None:
    begun_s = time.monotonic()
    assert launch.main(computers.command("remote", "--wait", "0.3")) == 1
    assert time.monotonic() - begun_s < 30.0
    said = capsys.readouterr().err
    assert "no launcher of 'local' within 0.3 s" in said
    assert f"local = 127.0.0.2, remote = 127.0.0.3) and the same --base-port ({computers.base_port})" in said
    assert f"port {computers.base_port + 8} of local" in said
    assert not computers.run_dir("remote").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--endpoint", "remote=192.0.2.7"], "a computer is reached at a loopback address only by itself"),
        (["--endpoint", "local=192.0.2.8", "--endpoint", "remote=192.0.2.7"], "not an address of this computer"),
        (["--endpoint", "lokal=10.0.0.1"], "unknown host 'lokal'"),
        (["--endpoint", "127.0.0.1"], "expected HOST=ADDRESS"),
        (
            ["--endpoint", "local=127.0.0.4", "--endpoint", "local=127.0.0.2"],
            "--endpoint local=127.0.0.2: expected once for each host, got local=127.0.0.4 too",
        ),
        (["--endpoint", "remote=127.0.0.2"], "endpoints local = remote = 127.0.0.2: expected the addresses of two"),
        (["--network", "wifi_bad"], "with --host nothing is emulated"),
        (["--set", "network.loss=0.1"], "with --host nothing is emulated"),
        (["--base-port", "65530"], "--base-port 65530: expected a port from 1 to 65524"),
        (["--host-budget", "jetsn"], "did you mean 'jetson'"),
        (["--write-config", "x"], "expected without --host"),
        (["--run-id", "a/b"], "id = 'a/b': expected letters"),
    ],
)
def test_bad_input_is_an_error_that_names_it_and_writes_nothing(
    computers: Computers, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert launch.main(computers.command("local", *options)) == 1
    assert message in capsys.readouterr().err
    assert not computers.run_dir("local").exists()


def test_a_port_that_is_taken_is_named(computers: Computers, capsys: pytest.CaptureFixture[str]) -> None:
    with held_ports([computers.base_port + 8], ADDRESSES["local"]):
        assert launch.main(computers.command("local")) == 1
    assert f"another launcher is about to use {computers.base_port + 8}" in capsys.readouterr().err


@pytest.mark.parametrize("host", ["local", "remote"])
def test_a_mode_on_one_computer_has_no_sides(capsys: pytest.CaptureFixture[str], tmp_path: Path, host: str) -> None:
    command = ["local_only", "--task", "dot_reacher", "--host", host, "--run-dir", str(tmp_path / "run")]
    assert launch.main(command) == 1
    assert "in local_only all services are on" in capsys.readouterr().err


def test_a_mode_without_addresses_asks_for_them(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    command = ["remote_local", "--task", "dot_reacher", "--run-dir", str(tmp_path / "run")]
    assert launch.main([*command, "--host", "local", "--endpoint", "local=127.0.0.1"]) == 1
    assert "no address for 'remote': expected it in the mode file's [endpoints]" in capsys.readouterr().err
    assert launch.main([*command, "--endpoint", "local=127.0.0.1"]) == 1
    assert "expected together with --host" in capsys.readouterr().err
