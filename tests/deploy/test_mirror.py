"""The copy of the other computer's files: complete, cheap while they grow, and never outside of its folder."""

from collections.abc import Callable
from pathlib import Path

import pytest

from deploy.mirror import CHUNK_BYTES, Mirror, is_shared, read_piece, shared_files
from tests.deploy.hand_made_record import write_part


class Copying:
    """A mirror of ``there`` that counts what it fetches."""

    def __init__(self, folder: Path, answer: Callable[[Path, str, int], bytes | None] = read_piece) -> None:
        self.there, self.here = folder / "there", folder / "here"
        self.there.mkdir()
        self.fetched_bytes = 0
        self._answer = answer
        self.mirror = Mirror(self.here, self.fetch)

    def fetch(self, name: str, offset: int) -> bytes | None:
        piece = self._answer(self.there, name, offset)
        self.fetched_bytes += len(piece or b"")
        return piece


def test_parts_and_tables_are_copied_and_nothing_else(tmp_path: Path) -> None:
    copying = Copying(tmp_path)
    write_part(copying.there, "actor", 5)
    (copying.there / "config").mkdir()
    shared = {"episodes.csv", "actions.csv", "ring.json", "config/robot_bridge.toml"}
    for name in (*shared, "ring", "policy.msgpack", "parts/actor-5.json.new", "config/actor.toml"):
        (copying.there / name).write_text(name)
    files = shared_files(copying.there)
    assert set(files) == {"parts/actor-5.json", *shared}
    assert copying.mirror.update(files)
    assert {path.relative_to(copying.here).as_posix() for path in copying.here.rglob("*.*")} == set(files)
    for name in files:
        assert (copying.here / name).read_bytes() == (copying.there / name).read_bytes()


def test_of_a_table_that_grows_only_what_is_new_is_fetched(tmp_path: Path) -> None:
    copying = Copying(tmp_path)
    table = copying.there / "actions.csv"
    table.write_text("a,b\n1,2\n")
    copying.mirror.update(shared_files(copying.there))
    with table.open("a") as file:
        file.write("3,4\n")
    copying.fetched_bytes = 0
    copying.mirror.update(shared_files(copying.there))
    assert copying.fetched_bytes == 4
    assert (copying.here / "actions.csv").read_text() == "a,b\n1,2\n3,4\n"
    copying.mirror.update(shared_files(copying.there))
    assert copying.fetched_bytes == 4


def test_a_configuration_is_fetched_once(tmp_path: Path) -> None:
    copying = Copying(tmp_path)
    (copying.there / "config").mkdir()
    (copying.there / "config" / "robot_bridge.toml").write_text("[task]\n")
    for _ in range(3):
        copying.mirror.update(shared_files(copying.there))
    assert copying.fetched_bytes == 7


def test_at_the_end_a_table_that_was_written_anew_is_fetched_whole(tmp_path: Path) -> None:
    copying = Copying(tmp_path)
    table = copying.there / "episodes.csv"
    table.write_text("a,b\n1,2\n")
    copying.mirror.update(shared_files(copying.there))
    table.write_text("a,b,c\n1,2,\n3,4,5\n")
    copying.mirror.update(shared_files(copying.there), whole=True)
    assert (copying.here / "episodes.csv").read_text() == table.read_text()


def test_a_file_longer_than_a_message_comes_in_pieces(tmp_path: Path) -> None:
    copying = Copying(tmp_path)
    text = "0123456789\n" * (2 * CHUNK_BYTES // 11 + 7)
    (copying.there / "actions.csv").write_text(text)
    assert copying.mirror.update(shared_files(copying.there))
    assert (copying.here / "actions.csv").read_text() == text


def test_without_an_answer_the_copy_stays_as_it_was(tmp_path: Path) -> None:
    copying = Copying(tmp_path, answer=lambda folder, name, offset: None)
    assert not copying.mirror.update({"actions.csv": 10})
    assert not copying.here.exists()


@pytest.mark.parametrize(
    "name",
    ["../run.toml", "/etc/passwd", "parts/../../x.json", "parts/actor-1.json/../../x", "config/actor.toml", "ring", ""],
)
def test_no_other_file_is_given_or_taken(tmp_path: Path, name: str) -> None:
    copying = Copying(tmp_path, answer=lambda folder, name, offset: b"mine")
    assert not is_shared(name)
    copying.mirror.update({name: 4})
    assert copying.fetched_bytes == 0
    assert list(tmp_path.iterdir()) == [copying.there]
    (copying.there / "ring").write_text("secret")
    assert read_piece(copying.there, name, 0) == b""
    assert read_piece(copying.there, "actions.csv", -3) == b""
