"""What a user hears of the other computer, and when its end is the end here."""

import io
from dataclasses import dataclass, field

import pytest

from common.console import Console
from deploy.listener import INTERRUPTED_S, SILENT_S, Listener
from deploy.network import Host
from deploy.other_side import ENDED, RUNNING, News
from deploy.watch import OVERTIME_S


@dataclass
class Scene:
    """A listener whose other side and time the test plays."""

    robot_is_here: bool = True
    begun: bool = True
    there: Host = "remote"
    news: News | None = None
    has_record: bool = False
    silent_s: float = 0.0
    now_s: float = 100.0
    out: io.StringIO = field(default_factory=io.StringIO)

    def __post_init__(self) -> None:
        self.listener = Listener(
            self,
            Console(self.out, self.out),
            robot_is_here=self.robot_is_here,
            run_has_begun=lambda: self.begun,
            now_s=lambda: self.now_s,
        )

    def hear(self, **news: object) -> None:
        self.news = News(**{"phase": RUNNING, **news})  # type: ignore[arg-type]

    def ends(self) -> bool:
        return self.listener.early_end() is not None


def test_what_happens_there_is_said_here_once() -> None:
    scene = Scene()
    scene.hear(said=["learner has died: exit code 3"])
    for _ in range(3):
        assert not scene.ends()
    scene.hear(said=["learner has died: exit code 3", "learner has returned (process 7)"])
    assert not scene.ends()
    assert scene.out.getvalue().splitlines() == [
        "remote: learner has died: exit code 3",
        "remote: learner has returned (process 7)",
    ]


def test_silence_and_its_end_are_told_once() -> None:
    scene = Scene()
    scene.hear()
    for silent_s in (1.0, SILENT_S + 0.1, SILENT_S + 5.0, 0.1, 0.1):
        scene.silent_s = silent_s
        assert not scene.ends()
    assert scene.out.getvalue().splitlines() == [
        "the launcher on remote has not answered for 10 s; the services here go on",
        "the launcher on remote answers again",
    ]


def test_when_the_launcher_there_falls_silent_the_robot_s_side_says_how_to_go_on() -> None:
    scene = Scene(robot_is_here=True, silent_s=SILENT_S + 0.1)
    scene.hear(restart=["cd /there", "python -m services.replay"])
    assert not scene.ends()
    said = scene.out.getvalue()
    assert said.startswith("the launcher on remote has not answered for 10 s; the services here go on\n")
    assert said.endswith("start them again there:\n  cd /there\n  python -m services.replay\n")
    scene.now_s += 1000.0
    assert not scene.ends()
    assert scene.out.getvalue() == said


@pytest.mark.parametrize(("robot_is_here", "over"), [(False, False), (True, True)])
def test_silence_tells_no_commands_where_they_would_bring_nothing(robot_is_here: bool, over: bool) -> None:
    scene = Scene(robot_is_here=robot_is_here, silent_s=SILENT_S + 0.1)
    scene.hear(restart=["cd /there"])
    if over:
        scene.listener.note_end()
    scene.listener.listen()
    assert scene.out.getvalue() == "the launcher on remote has not answered for 10 s; the services here go on\n"


def test_ctrl_c_there_leaves_the_robot_s_side_running_and_says_how_to_go_on() -> None:
    scene = Scene(robot_is_here=True)
    scene.hear(phase=ENDED, outcome="stopped by Ctrl-C", restart=["cd /there", "python -m services.replay"])
    assert not scene.ends()
    scene.now_s += 1000.0
    assert not scene.ends()
    assert scene.listener.was_left_alone
    said = scene.out.getvalue()
    assert said.startswith("remote has ended: stopped by Ctrl-C\n")
    assert said.count("stopped by Ctrl-C") == 1
    assert "  cd /there\n  python -m services.replay\n" in said


def test_a_good_end_there_needs_nothing_here() -> None:
    scene = Scene(robot_is_here=True)
    scene.hear(phase=ENDED, outcome="well", succeeded=True, restart=["cd /there"])
    assert not scene.ends()
    assert scene.out.getvalue() == "remote has ended: well\n"
    assert not scene.listener.was_left_alone


@pytest.mark.parametrize(("succeeded", "limit_s"), [(True, OVERTIME_S), (False, INTERRUPTED_S)])
def test_when_the_robot_s_side_has_ended_the_services_here_have_a_while_to_end_by_themselves(
    succeeded: bool, limit_s: float
) -> None:
    scene = Scene(robot_is_here=False, there="local")
    scene.hear(phase=ENDED, outcome="so", succeeded=succeeded)
    assert not scene.ends()
    scene.now_s += limit_s
    assert not scene.ends()
    scene.now_s += 0.1
    end = scene.listener.early_end()
    assert end is not None
    assert not end.is_failure
    assert "local ended" in end.reason


@pytest.mark.parametrize(("robot_is_here", "has_record"), [(True, False), (False, True)])
def test_who_ends_before_the_run_has_begun_ends_it_for_both(robot_is_here: bool, has_record: bool) -> None:
    scene = Scene(robot_is_here=robot_is_here, begun=False, has_record=has_record)
    scene.hear(phase=ENDED, outcome="not well at the end: learner")
    end = scene.listener.early_end()
    assert end is not None
    assert end.is_failure
    assert "before the run had begun" in end.reason


def test_whether_a_run_had_begun_there_is_judged_by_its_record_and_without_one_after_a_while() -> None:
    scene = Scene(robot_is_here=False, there="local", begun=False)
    scene.hear(phase=ENDED, outcome="well", succeeded=True)
    assert not scene.ends()
    scene.begun = scene.has_record = True
    assert not scene.ends()
    scene.begun = scene.has_record = False
    scene.now_s += INTERRUPTED_S
    assert not scene.ends()
    scene.now_s += 0.1
    assert scene.ends()


def test_after_its_own_end_nobody_is_told_how_to_go_on() -> None:
    scene = Scene(robot_is_here=True)
    scene.hear()
    scene.listener.note_end()
    scene.hear(phase=ENDED, outcome="stopped by Ctrl-C", restart=["cd /there"])
    scene.listener.listen()
    assert scene.out.getvalue() == "remote has ended: stopped by Ctrl-C\n"
    assert not scene.listener.was_left_alone
