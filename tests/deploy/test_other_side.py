"""Two launchers in one process: what they tell each other, and what they make of strange messages."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from common.errors import MessageError
from common.run_settings import RunSettings
from common.transport import InMemoryNetwork
from deploy.network import Host
from deploy.other_side import ENDED, LAUNCHERS_RUN, RUNNING, News, OtherSide, launcher_topic, news_from
from tests.deploy.hand_made_record import write_actions, write_part
from tests.helpers import eventually


@dataclass
class Scene:
    """Two sides of a run, and someone else on their network."""

    folder: Path

    def __post_init__(self) -> None:
        self.network = InMemoryNetwork()
        self.sides: list[OtherSide] = []
        self.stranger = self.network.transport(RunSettings(LAUNCHERS_RUN, "."))

    def launcher(self, here: Host, there: Host, name: str = "") -> OtherSide:
        """Start a launcher on ``here`` with a run directory of its own."""
        run_dir = self.folder / (name or here)
        run_dir.mkdir()
        side = OtherSide(self.network.transport(RunSettings(LAUNCHERS_RUN, ".")), here, there, run_dir)
        self.sides.append(side)
        side.start()
        return side


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    scene = Scene(tmp_path)
    yield scene
    for side in scene.sides:
        side.close()


def phase_of(side: OtherSide) -> str:
    return side.news.phase if side.news else ""


def test_each_side_hears_what_the_other_tells(scene: Scene) -> None:
    local, remote = scene.launcher("local", "remote"), scene.launcher("remote", "local")
    local.tell(facts={"--run-id": "one"})
    remote.tell(phase=RUNNING, restart=["cd there"])
    remote.say("learner has died")
    remote.say("learner has returned")
    eventually(lambda: phase_of(local) == RUNNING and len(local.news.said) == 2)  # type: ignore[union-attr]
    assert local.news is not None
    assert local.news.said == ["learner has died", "learner has returned"]
    assert local.news.restart == ["cd there"]
    eventually(lambda: remote.news is not None and remote.news.facts == {"--run-id": "one"})


def test_the_record_comes_over_while_it_grows_and_is_whole_at_the_end(scene: Scene) -> None:
    local, remote = scene.launcher("local", "remote"), scene.launcher("remote", "local")
    eventually(lambda: local.news is not None and remote.news is not None)
    for side in (local, remote):
        side.agree()
    write_part(scene.folder / "local", "robot_bridge", 5, state="running")
    write_actions(scene.folder / "local", [(1.0, 1.1)])
    local.share_files()
    local.tell(phase=RUNNING)
    part = Path("parts") / "robot_bridge-5.json"
    copy = scene.folder / "remote" / "hosts" / "local"
    eventually((copy / part).exists)
    assert not remote.has_record
    write_part(scene.folder / "local", "robot_bridge", 5, state="stopped")
    write_actions(scene.folder / "local", [(1.0, 1.1), (2.0, 2.2)])
    local.tell(phase=ENDED)
    eventually(lambda: remote.has_record)
    eventually(lambda: local.news is not None and local.news.has_record)
    for name in (part, Path("actions.csv")):
        assert (copy / name).read_bytes() == (scene.folder / "local" / name).read_bytes()


def test_before_a_run_is_agreed_on_no_files_are_told(scene: Scene) -> None:
    scene.launcher("local", "remote")
    remote = scene.launcher("remote", "local")
    write_part(scene.folder / "local", "robot_bridge", 5)
    eventually(lambda: remote.news is not None)
    assert remote.news is not None
    assert remote.news.files == {}


def test_a_third_launcher_is_told_that_it_comes_too_late_and_gets_and_changes_nothing(scene: Scene) -> None:
    local, remote = scene.launcher("local", "remote"), scene.launcher("remote", "local")
    eventually(lambda: local.news is not None and remote.news is not None)
    for side in (local, remote):
        side.agree(phase=RUNNING)
    eventually(lambda: phase_of(local) == phase_of(remote) == RUNNING)
    write_part(scene.folder / "local", "actor", 5)
    local.share_files()
    late = scene.launcher("remote", "local", name="late")
    late.tell(phase=ENDED)
    eventually(lambda: late.news is not None and late.is_taken(late.news))
    assert phase_of(local) == RUNNING
    assert local.news is not None
    assert not local.is_taken(local.news)
    late.close()
    assert list((scene.folder / "late").iterdir()) == []


@pytest.mark.parametrize(
    "payload", [b"", b"\xff", b"[]", b"{}", b'{"ask": "news", "news": 3}', b'{"ask": "file", "news": {}}']
)
def test_a_question_that_is_none_changes_nothing_and_gets_an_answer(scene: Scene, payload: bytes) -> None:
    local = scene.launcher("local", "remote")
    answer = scene.stranger.query(launcher_topic("local"), payload)
    assert answer is not None
    assert json.loads(answer)["news"]["phase"] == "waiting"
    assert local.news is None


def test_what_another_launcher_has_does_not_replace_the_copy_of_a_killed_one_s_record(scene: Scene) -> None:
    local, remote = scene.launcher("local", "remote"), scene.launcher("remote", "local")
    eventually(lambda: local.news is not None and remote.news is not None)
    for side in (local, remote):
        side.agree(phase=RUNNING)
    part = write_part(scene.folder / "remote", "learner", 5, state="running")
    write_actions(scene.folder / "remote", [(1.0, 1.1)])
    remote.share_files()
    copy = scene.folder / "local" / "hosts" / "remote"
    eventually((copy / "actions.csv").exists)
    assert local.news is not None
    files = local.news.files
    remote.close()
    late = scene.launcher("remote", "local", name="late")
    eventually(lambda: late.news is not None)
    assert not local.mirror.update(files, whole=True)
    assert (copy / "parts" / "learner-5.json").read_bytes() == part.read_bytes()
    assert (copy / "actions.csv").read_bytes() == (scene.folder / "remote" / "actions.csv").read_bytes()


def test_a_file_is_given_in_pieces_and_only_from_the_record(scene: Scene) -> None:
    scene.launcher("local", "remote")
    write_actions(scene.folder / "local", [(1.0, 1.1)])
    (scene.folder / "local" / "ring").write_text("large")
    news = dict(vars(News()))

    def ask(name: str, offset: int) -> bytes | None:
        question = {"ask": "file", "name": name, "offset": offset, "news": news}
        return scene.stranger.query(launcher_topic("local"), json.dumps(question).encode())

    content = (scene.folder / "local" / "actions.csv").read_bytes()
    whose = ask("", 0)
    assert whose
    assert ask("actions.csv", 0) == whose + content
    assert ask("actions.csv", 10) == whose + content[10:]
    assert ask("ring", 0) == whose
    assert ask("../remote/actions.csv", 0) == whose


@pytest.mark.parametrize(
    "changes",
    [{"facts": []}, {"facts": {"a": 1}}, {"said": "x"}, {"said": [1]}, {"files": {"a": "b"}}, {"succeeded": 1}],
)
def test_news_of_a_wrong_kind_are_refused(changes: dict[str, Any]) -> None:
    values = vars(News())
    assert news_from(values) == News()
    with pytest.raises(MessageError, match="a launcher's news"):
        news_from({**values, **changes})
    with pytest.raises(MessageError, match="a launcher's news"):
        news_from({name: value for name, value in values.items() if name != "phase"})
