"""The supervisor, with stand-ins for the services: who dies, who returns, and the order of the end."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from common.service import CLOSE_TIMEOUT_S, STOP_TIMEOUT_S
from deploy.child import Child, LaunchedService, exit_text
from deploy.supervise import StopTimes, Supervisor

FAKE = str(Path(__file__).with_name("fake_service.py"))
SERVICES = ("robot_bridge", "actor", "replay", "learner")
PATIENCE_S = 20.0
"""No test waits this long, unless it fails."""
NEVER_S = 60.0

Start = Callable[..., Supervisor]


def wait_for(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)


def fake_command(name: str, run_dir: Path, behaviour: str) -> tuple[str, ...]:
    return (sys.executable, "-S", "-E", FAKE, name, str(run_dir), behaviour)


class Reports(list[str]):
    def text(self) -> str:
        return "\n".join(self)


@pytest.fixture
def reports() -> Reports:
    return Reports()


@pytest.fixture
def start(tmp_path: Path, reports: Reports) -> Iterator[Start]:
    """Starts a supervisor whose services behave as told, and waits until all have said their first word."""
    started: list[Supervisor] = []

    def start(stop_times: StopTimes | None = None, run_has_begun: bool = True, **behaviours: str) -> Supervisor:
        services = [
            LaunchedService(name, fake_command(name, tmp_path, behaviours.get(name, "wait")), {"MARK": "1"})
            for name in SERVICES
        ]
        supervisor = Supervisor(services, tmp_path, reports.append, lambda: run_has_begun, stop_times or StopTimes())
        started.append(supervisor)
        supervisor.start()
        wait_for(lambda: len(list(tmp_path.glob("parts/*.json"))) >= len(SERVICES), "the services have not started")
        return supervisor

    yield start
    for supervisor in started:
        for child in supervisor.children.values():
            child.signal(signal.SIGKILL)
        wait_for(lambda s=supervisor: not s.running, "killed processes live on")


def ends(run_dir: Path) -> list[str]:
    path = run_dir / "ends.log"
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []


def check_until(supervisor: Supervisor, condition: Callable[[], object], what: str) -> None:
    def checked() -> object:
        supervisor.check()
        return condition()

    wait_for(checked, what)


def test_a_run_that_ends_by_itself_has_no_failures(start: Start, tmp_path: Path, reports: Reports) -> None:
    supervisor = start(robot_bridge="done")
    check_until(supervisor, lambda: not supervisor.running, "the services have not ended")
    assert supervisor.failed == reports == []
    assert sorted(ends(tmp_path)) == ["actor finished", "learner finished", "replay finished", "robot_bridge done"]


def test_a_service_that_fails_is_reported_with_its_reason_and_its_command(
    start: Start, tmp_path: Path, reports: Reports
) -> None:
    supervisor = start(replay="fail")
    check_until(supervisor, lambda: reports, "nothing was reported")
    assert len(reports) == 1
    for words in (
        "replay has died: exit code 3",
        "the disk is full",
        f"env MARK=1 {sys.executable}",
        f"replay {tmp_path} fail",
        "replay.console.log",
    ):
        assert words in reports.text()
    assert not supervisor.cannot_start
    assert supervisor.running
    assert all(supervisor.children[name].alive for name in ("robot_bridge", "actor", "learner"))


def test_after_the_bridge_s_end_nobody_is_to_be_started_again(start: Start, reports: Reports) -> None:
    supervisor = start(robot_bridge="done", learner="deaf")
    check_until(supervisor, lambda: supervisor.children["robot_bridge"].ended_well, "the bridge has not ended")
    supervisor.children["learner"].signal(signal.SIGKILL)
    check_until(supervisor, lambda: reports, "nothing was reported")
    assert "the run is over: started again, it would find nobody" in reports.text()
    assert "start it again" not in reports.text()


def test_without_a_part_s_word_the_console_s_last_lines_are_the_reason(start: Start, reports: Reports) -> None:
    supervisor = start(actor="crash")
    check_until(supervisor, lambda: reports, "nothing was reported")
    assert "Traceback: something unexpected" in reports.text()
    assert "actor says hello" in reports.text()


def test_a_killed_service_is_reported_with_the_signal_and_fails_the_run(start: Start, reports: Reports) -> None:
    supervisor = start()
    supervisor.children["learner"].signal(signal.SIGKILL)
    check_until(supervisor, lambda: reports, "nothing was reported")
    assert "learner has died: killed by SIGKILL" in reports.text()
    supervisor.children["robot_bridge"].signal(signal.SIGINT)
    check_until(supervisor, lambda: not supervisor.running, "the others have not ended")
    assert supervisor.failed == ["learner"]


@pytest.mark.parametrize(("behaviour", "failed"), [("wait", []), ("fail", ["replay"])])
def test_a_service_started_again_by_hand_has_returned(
    start: Start, tmp_path: Path, reports: Reports, behaviour: str, failed: list[str]
) -> None:
    supervisor = start()
    supervisor.children["replay"].signal(signal.SIGKILL)
    check_until(supervisor, lambda: reports, "nothing was reported")
    by_hand = subprocess.Popen(fake_command("replay", tmp_path, behaviour), stdout=subprocess.DEVNULL)
    try:
        check_until(supervisor, lambda: "replay has returned" in reports.text(), "its return was not noticed")
        supervisor.children["robot_bridge"].signal(signal.SIGINT)
        check_until(supervisor, lambda: not supervisor.running, "the run has not ended")
        assert supervisor.failed == failed
        assert ("replay has died again: the disk is full" in reports.text()) == bool(failed)
    finally:
        by_hand.kill()
        by_hand.wait()


def test_a_service_that_fails_before_the_run_has_begun_ends_it(start: Start, reports: Reports) -> None:
    supervisor = start(run_has_begun=False, robot_bridge="cannot start")
    check_until(supervisor, lambda: supervisor.cannot_start, "the failure was not noticed")
    assert "could not start, so the run ends" in reports.text()
    supervisor.stop(time.monotonic())
    assert not supervisor.running
    assert "robot_bridge" in supervisor.failed


def test_the_bridge_is_stopped_first_and_tells_the_others(start: Start, tmp_path: Path) -> None:
    supervisor = start(StopTimes(rest_after_s=NEVER_S, kill_after_s=NEVER_S))
    supervisor.stop(time.monotonic())
    assert not supervisor.running
    assert ends(tmp_path)[0] == "robot_bridge SIGINT"
    assert sorted(ends(tmp_path)[1:]) == ["actor finished", "learner finished", "replay finished"]


def test_who_does_not_hear_the_bridge_gets_a_signal_the_learner_last(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[tuple[str, signal.Signals]] = []
    send = Child.signal

    def remember(child: Child, number: signal.Signals) -> None:
        sent.append((child.name, number))
        send(child, number)

    monkeypatch.setattr(Child, "signal", remember)
    supervisor = start(StopTimes(0.3, NEVER_S), actor="deaf", replay="deaf", learner="deaf")
    supervisor.stop(time.monotonic())
    assert not supervisor.running
    assert [name for name, _ in sent] == ["robot_bridge", "actor", "replay", "learner"]
    assert {number for _, number in sent} == {signal.SIGINT}
    assert sorted(ends(tmp_path)) == [f"{name} SIGINT" for name in sorted(SERVICES)]


def test_without_a_bridge_the_others_are_told_at_once(start: Start, tmp_path: Path, reports: Reports) -> None:
    supervisor = start(StopTimes(rest_after_s=NEVER_S, kill_after_s=NEVER_S))
    supervisor.children["robot_bridge"].signal(signal.SIGKILL)
    check_until(supervisor, lambda: reports, "nothing was reported")
    supervisor.stop(time.monotonic())
    assert sorted(ends(tmp_path)) == ["actor SIGINT", "learner SIGINT", "replay SIGINT"]


def test_who_ignores_everything_is_killed(start: Start, reports: Reports) -> None:
    supervisor = start(StopTimes(0.1, 0.5), replay="stubborn", robot_bridge="stubborn")
    supervisor.stop(time.monotonic())
    assert not supervisor.running
    assert supervisor.children["replay"].exit_code == -signal.SIGKILL
    assert "replay has not ended in time and is killed" in reports.text()


def test_who_waits_for_one_that_hangs_has_the_time_to_give_up() -> None:
    times = StopTimes()
    assert times.kill_after_s >= times.rest_after_s + STOP_TIMEOUT_S + CLOSE_TIMEOUT_S
    assert times.kill_after_s < 5  # All are gone by then.


def test_a_service_by_hand_is_stopped_too(start: Start, tmp_path: Path, reports: Reports) -> None:
    supervisor = start(StopTimes(rest_after_s=0.1, kill_after_s=NEVER_S))
    supervisor.children["replay"].signal(signal.SIGKILL)
    check_until(supervisor, lambda: reports, "nothing was reported")
    by_hand = subprocess.Popen(fake_command("replay", tmp_path, "deaf"), stdout=subprocess.DEVNULL)
    try:
        check_until(supervisor, lambda: "replay has returned" in reports.text(), "its return was not noticed")
        supervisor.stop(time.monotonic())
        assert by_hand.wait(PATIENCE_S) == 0
        assert "replay SIGINT" in ends(tmp_path)
    finally:
        by_hand.kill()
        by_hand.wait()


def test_nothing_is_started_after_a_request_to_stop(tmp_path: Path, reports: Reports) -> None:
    services = [LaunchedService(name, fake_command(name, tmp_path, "wait")) for name in SERVICES]
    supervisor = Supervisor(services, tmp_path, reports.append)
    supervisor.start(asked_to_stop=lambda: True)
    assert not supervisor.running
    supervisor.stop(time.monotonic())
    assert reports == []


def test_services_end_with_a_launcher_that_is_killed(tmp_path: Path) -> None:
    launcher = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import sys, time\nfrom pathlib import Path\nfrom deploy.child import Child, LaunchedService\n"
            "child = Child(LaunchedService('actor', tuple(sys.argv[2:])), Path(sys.argv[1]))\n"
            "child.start()\ntime.sleep(60)\n",
            str(tmp_path),
            *fake_command("actor", tmp_path, "deaf"),
        ],
        cwd=Path(__file__).parents[2],
    )
    try:
        wait_for(lambda: list(tmp_path.glob("parts/*.json")), "the service has not started")
    finally:
        launcher.kill()
        launcher.wait()
    wait_for(lambda: ends(tmp_path) == ["actor SIGTERM"], "the service was left behind")


def test_a_command_that_is_not_there_is_reported(tmp_path: Path, reports: Reports) -> None:
    supervisor = Supervisor([LaunchedService("actor", ("/no/such/program",))], tmp_path, reports.append)
    supervisor.start()
    check_until(supervisor, lambda: reports, "nothing was reported")
    assert "/no/such/program: cannot be started: No such file or directory" in reports.text()


def test_exit_codes_are_told_in_words() -> None:
    assert [exit_text(code) for code in (1, -9, -200)] == ["exit code 1", "killed by SIGKILL", "killed by signal 200"]
