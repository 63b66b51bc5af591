"""The launcher from its command line to its exit code, with stand-ins for the services."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

from common.config import load_config
from common.console import Console
from common.stop_signals import INTERRUPTED, StopSignals
from deploy import launch, run
from deploy.options import parse_options
from deploy.placement import MODES
from deploy.plan import CONFIG_CLASSES

REPOSITORY = Path(__file__).parents[2]
PATIENCE_S = 60.0
SERVICES = ("robot_bridge", "actor", "replay", "learner")


def start_launcher(run_dir: Path, *options: str, mode: str = "local_only", **behaviours: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.deploy.fake_launch", json.dumps(behaviours), mode, "--task", "dot_reacher"]
    return subprocess.Popen(
        [*command, "--run-dir", str(run_dir), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=REPOSITORY,
    )


def finish(launcher: subprocess.Popen[str]) -> tuple[int, str, str]:
    try:
        out, errors = launcher.communicate(timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        launcher.kill()
        raise
    return launcher.returncode, out, errors


def wait_for_parts(run_dir: Path, count: int = 4) -> list[int]:
    """Wait until so many services have said their first word; return their process ids."""
    deadline = time.monotonic() + PATIENCE_S
    while len(paths := list(run_dir.glob("parts/*.json"))) < count:
        assert time.monotonic() < deadline, "the services have not started"
        time.sleep(0.01)
    return [json.loads(path.read_text(encoding="utf-8"))["pid"] for path in paths]


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_run_leaves_a_complete_record(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    code, out, errors = finish(start_launcher(run_dir, "--steps", "100", "--seed", "5", robot_bridge="done"))
    assert code == 0, errors
    for name in SERVICES:
        config = load_config(CONFIG_CLASSES[name], run_dir / "config" / f"{name}.toml")
        assert config.run.directory == str(run_dir)
        assert (run_dir / "logs" / f"{name}.console.log").read_text() == f"{name} says hello\n"
    facts = tomllib.loads((run_dir / "run.toml").read_text())
    assert (facts["run"]["mode"], facts["run"]["seed"], facts["run"]["backend"]) == ("local_only", 5, "none")
    assert facts["versions"]["python"]
    summary = json.loads((run_dir / "summary.json").read_text())
    assert (summary["steps"], summary["network"], summary["seed"]) == (100, "none", 5)
    assert (run_dir / "learning_curve.png").exists()
    assert out.rstrip().endswith(f"{run_dir}/summary.json\n{run_dir}/learning_curve.png")
    assert "100/100 100 %" in out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_all_and_completes_the_record(tmp_path: Path, number: signal.Signals) -> None:
    launcher = start_launcher(tmp_path / "run", learner="deaf")
    pids = wait_for_parts(tmp_path / "run")
    launcher.send_signal(number)
    launcher.send_signal(number)  # the impatient do it twice
    code, out, _ = finish(launcher)
    assert code == 130
    assert not any(map(is_running, pids))
    assert (tmp_path / "run" / "ends.log").read_text().startswith("robot_bridge SIGINT\n")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["steps"] == 100
    assert any(
        re.fullmatch(r"the run was cut short, at 100 of \d+ steps: interrupted", note) for note in summary["notes"]
    )
    assert "summary.json" in out


def test_ctrl_c_while_the_services_start_ends_all(tmp_path: Path) -> None:
    launcher = start_launcher(tmp_path / "run")
    pids = wait_for_parts(tmp_path / "run", count=1)
    launcher.send_signal(signal.SIGINT)
    code, _, _ = finish(launcher)
    assert code == 130
    assert (tmp_path / "run" / "summary.json").exists()
    assert not any(map(is_running, pids))


def test_a_service_that_dies_is_reported_and_shows_in_the_exit_code(tmp_path: Path) -> None:
    launcher = start_launcher(tmp_path / "run", learner="fail")
    assert launcher.stderr is not None
    said = ""
    while "start it again" not in said:
        line = launcher.stderr.readline()
        assert line, said
        said += line
    assert "learner has died: exit code 3" in said
    assert "the disk is full" in said
    (tmp_path / "run" / "finished").touch()  # the others go on until the run is over
    code, out, errors = finish(launcher)
    assert code == 1
    assert "not well at the end: learner" in errors
    assert "learner: the disk is full" in out


def test_a_service_that_cannot_start_ends_the_run(tmp_path: Path) -> None:
    code, _, errors = finish(start_launcher(tmp_path / "run", robot_bridge="cannot start"))
    assert code == 1
    assert "robot_bridge has died: exit code 3" in errors
    assert "could not start" in errors


def test_a_mode_with_two_hosts_runs_over_an_emulated_network(tmp_path: Path) -> None:
    launcher = start_launcher(tmp_path / "run", "--network", "outage", mode="remote_only", robot_bridge="done")
    code, _, errors = finish(launcher)
    assert code == 0, errors
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["network_link"]["backend"] in ("namespaces", "relay")
    facts = tomllib.loads((tmp_path / "run" / "run.toml").read_text())
    assert facts["conditions"]["uplink"]["rate_mbit"] == 20
    buffers = [
        load_config(CONFIG_CLASSES[name], tmp_path / "run" / "config" / f"{name}.toml").transport.socket_buffer_kib
        for name in SERVICES
    ]
    assert buffers == [128] * 4


def test_a_trace_that_is_over_ends_the_run_in_order_and_the_record_says_that_it_was_cut_short(tmp_path: Path) -> None:
    (tmp_path / "short.csv").write_text("time_s,delay_ms\n0,1\n0.01,1\n", encoding="utf-8")
    network = tmp_path / "network.toml"
    network.write_text('[network]\ntrace = "short.csv"\ntrace_end = "stop"\n', encoding="utf-8")
    run_dir = tmp_path / "run"
    code, out, errors = finish(start_launcher(run_dir, "--steps", "300", "--network", str(network), mode="remote_only"))
    reason = f"the trace {tmp_path / 'short.csv'} is over after 0.02 s, and trace_end = 'stop'; 'loop' begins it again"
    assert code == 0, errors
    assert f"the run ends: {reason}\n" in errors
    assert "failed" not in out + errors
    note = f"the run was cut short, at 100 of 300 steps: {reason}"
    assert note in json.loads((run_dir / "summary.json").read_text())["notes"]
    assert f"note       {note}" in out


def test_write_config_writes_and_prints_what_to_type(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["remote_local", "--task", "dot_reacher", "--run-dir", str(tmp_path / "run"), "--steps", "9"]
    assert launch.main([*arguments, "--write-config", str(tmp_path / "configs")]) == 0
    printed = capsys.readouterr().out
    commands = re.findall(r"^  \S*python\S* -m services\.(\w+) --config (\S+)$", printed, re.MULTILINE)
    assert [name for name, _ in commands] == list(SERVICES)
    for name, path in commands:
        config = load_config(CONFIG_CLASSES[name], REPOSITORY / path)
        assert config.transport.listen_bulk.startswith("tcp/127.0.0.1:")
        assert config.run.directory == str(tmp_path / "run")
    assert "no emulated network" in printed
    assert sorted(path.name for path in (tmp_path / "configs").iterdir()) == sorted(f"{name}.toml" for name in SERVICES)


def test_write_config_takes_the_addresses_of_the_mode_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mode = tmp_path / "lab.toml"
    endpoints = '\n[endpoints]\nlocal = "192.0.2.1"\nremote = "192.0.2.2"\n'
    mode.write_text((MODES / "remote_local.toml").read_text() + endpoints)
    command = [str(mode), "--task", "dot_reacher", "--run-dir", str(tmp_path / "run")]
    assert launch.main([*command, "--write-config", str(tmp_path / "configs")]) == 0
    assert "127.0.0.1" not in capsys.readouterr().out
    transport = load_config(CONFIG_CLASSES["replay"], tmp_path / "configs" / "replay.toml").transport
    assert transport.listen_real_time.startswith("tcp/192.0.2.2:")
    assert all(endpoint.startswith("tcp/192.0.2.1:") for endpoint in transport.connect_bulk)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere", "--task", "dot_reacher"], "mode 'nowhere'"),
        (["local_only", "--task", "nothing"], "--task nothing"),
        (["local_only", "--task", "dot_reacher", "--network", "wifi_bad"], "nothing crosses a network"),
        (["local_only", "--task", "dot_reacher", "--set", "actor.thread=2"], "unknown key 'thread'"),
        (["local_only", "--task", "dot_reacher", "--base-port", "0"], "--base-port 0"),
    ],
)
def test_bad_input_is_an_error_that_names_it_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert launch.main([*arguments, "--run-dir", str(tmp_path / "run")]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_the_record_of_another_run_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "parts").mkdir()
    arguments = ["local_only", "--task", "dot_reacher", "--run-dir", str(tmp_path)]
    assert launch.main(arguments) == 1
    assert launch.main([*arguments, "--write-config", str(tmp_path / "configs")]) == 1
    errors = capsys.readouterr().err
    assert "expected a folder that is empty" in errors
    assert "holds the record of a run already" in errors


def test_a_run_directory_that_cannot_be_made_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert launch.main(["local_only", "--task", "dot_reacher", "--run-dir", str(tmp_path / "file" / "run")]) == 1
    assert str(tmp_path / "file" / "run") in capsys.readouterr().err


def test_ctrl_c_before_anything_is_started_leaves_nothing(tmp_path: Path) -> None:
    options = parse_options(["local_only", "--task", "dot_reacher", "--run-dir", str(tmp_path / "run")])
    stop = StopSignals()
    stop.asked_s = time.monotonic()
    assert run.launch(options, stop, Console()) == INTERRUPTED
    assert not (tmp_path / "run").exists()
