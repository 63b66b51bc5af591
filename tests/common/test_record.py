"""A service's part of the record: complete where the disk allows, never in anyone's way where it does not."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from common import record as record_module
from common.record import RunRecord, read_parts, unreadable_parts, write_atomically
from tests.helpers import TIMEOUT_S, eventually

ROOT = Path(__file__).parents[2]


@pytest.fixture
def started(tmp_path):
    """Start a record in the test's folder; closed after the test."""
    records = []

    def start(service="actor", incarnation=7):
        records.append(RunRecord(tmp_path, service, incarnation))
        records[-1].start()
        return records[-1]

    yield start
    for one in records:
        one.close()


def table(path):
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))


def points(folder):
    """Return (tag, step, value) of all points in TensorBoard's files."""
    return [
        (value.tag, event.step, round(value.tensor.float_val[0] if value.HasField("tensor") else value.simple_value, 3))
        for path in sorted(folder.iterdir())
        for event in EventFileLoader(str(path)).Load()
        for value in event.summary.value
    ]


# ------------------------------------------------------------------ parts


def test_a_part_says_whose_it_is_and_what_was_given(started, tmp_path):
    record = started()
    record.part({"state": "running", "counters": {"steps": 3}})
    record.close()
    assert json.loads((tmp_path / "parts" / "actor-7.json").read_text()) == {
        "service": "actor",
        "incarnation": 7,
        "pid": os.getpid(),
        "state": "running",
        "counters": {"steps": 3},
    }


def test_the_last_part_replaces_the_others_and_leaves_nothing_beside(started, tmp_path):
    record = started()
    for steps in range(50):
        record.part({"steps": steps})
    record.close()
    assert [path.name for path in (tmp_path / "parts").iterdir()] == ["actor-7.json"]
    assert read_parts(tmp_path)[0]["steps"] == 49
    assert record.dropped == 0


def test_a_reader_never_sees_a_piece_of_a_file(tmp_path):
    path = tmp_path / "deep" / "part.json"
    texts = {letter * 200_000 for letter in "ab"}
    write_atomically(path, next(iter(texts)))
    stop = threading.Event()

    def write():
        while not stop.is_set():
            for text in texts:
                write_atomically(path, text)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        for _ in range(200):
            assert path.read_text() in texts
    finally:
        stop.set()
        writer.join()
    assert list(path.parent.iterdir()) == [path]


def test_a_file_that_cannot_be_written_keeps_its_old_text_and_leaves_nothing_beside(tmp_path, monkeypatch):
    path = tmp_path / "part.json"
    write_atomically(path, "old")
    write_bytes = Path.write_bytes

    def write_half(self, data):
        write_bytes(self, data[: len(data) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", write_half)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_parts_are_read_oldest_incarnation_first(tmp_path):
    for incarnation in (10, 9, 100):
        write_atomically(tmp_path / "parts" / f"actor-{incarnation}.json", json.dumps({"incarnation": incarnation}))
    write_atomically(tmp_path / "parts" / "learner-50.json", json.dumps({"incarnation": 50}))
    assert [part["incarnation"] for part in read_parts(tmp_path)] == [9, 10, 50, 100]
    assert [part["incarnation"] for part in read_parts(tmp_path, "actor")] == [9, 10, 100]


def test_a_run_without_parts_has_none(tmp_path):
    assert read_parts(tmp_path) == []
    assert read_parts(tmp_path / "nowhere") == []


@pytest.mark.parametrize(
    "content",
    [b"", b'{"incarnation": 3', b"\0" * 100, b"\xff\xfe", b"[]", b"3", b"null", b"{}", b'{"incarnation": "x"}'],
)
def test_a_part_that_cannot_be_read_is_left_out_and_named(tmp_path, content):
    write_atomically(tmp_path / "parts" / "actor-1.json", '{"incarnation": 1}')
    (tmp_path / "parts" / "actor-2.json").write_bytes(content)
    assert read_parts(tmp_path) == [{"incarnation": 1}]
    assert unreadable_parts(tmp_path) == [tmp_path / "parts" / "actor-2.json"]
    assert unreadable_parts(tmp_path, "learner") == []


# ------------------------------------------------------------------ tables


def test_rows_follow_a_header_of_their_columns(started, tmp_path):
    record = started()
    record.row("episodes", {"episode": 0, "return": -1.5})
    record.row("episodes", {"return": -2.5, "episode": 1})
    record.row("actions", {"seq": 4})
    record.close()
    assert table(tmp_path / "episodes.csv") == [["episode", "return"], ["0", "-1.5"], ["1", "-2.5"]]
    assert table(tmp_path / "actions.csv") == [["seq"], ["4"]]


def test_a_row_is_on_disk_before_the_record_is_closed(started, tmp_path):
    record = started()
    record.row("episodes", {"episode": 0})
    eventually(lambda: (tmp_path / "episodes.csv").exists() and len(table(tmp_path / "episodes.csv")) == 2)


def test_a_later_incarnation_goes_on_below(started, tmp_path):
    for incarnation in (7, 8):
        record = started(incarnation=incarnation)
        record.row("episodes", {"incarnation": incarnation, "return": 0.5})
        record.close()
    assert table(tmp_path / "episodes.csv") == [["incarnation", "return"], ["7", "0.5"], ["8", "0.5"]]


def test_new_columns_are_added_to_the_table_and_its_old_rows(started, tmp_path):
    record = started()
    record.row("episodes", {"a": 1})
    record.row("episodes", {"a": 2, "b": "x, y"})
    record.row("episodes", {"c": 3, "a": 4})
    record.close()
    assert table(tmp_path / "episodes.csv") == [["a", "b", "c"], ["1", "", ""], ["2", "x, y", ""], ["4", "", "3"]]
    assert [path.name for path in tmp_path.glob("*.csv")] == ["episodes.csv"]


def test_columns_that_are_not_given_stay_empty(started, tmp_path):
    record = started()
    record.row("episodes", {"a": 1, "b": 2})
    record.row("episodes", {"b": 3})
    record.close()
    assert table(tmp_path / "episodes.csv") == [["a", "b"], ["1", "2"], ["", "3"]]


def test_a_later_incarnation_may_have_other_columns(started, tmp_path):
    for incarnation, row in ((7, {"a": 1, "b": 2}), (8, {"b": 3}), (9, {"b": 4, "c": 5})):
        record = started(incarnation=incarnation)
        record.row("episodes", row)
        record.close()
    assert table(tmp_path / "episodes.csv") == [["a", "b", "c"], ["1", "2", ""], ["", "3", ""], ["", "4", "5"]]


def test_a_row_is_written_as_it_was_when_it_was_given(started, tmp_path):
    record, row = started(), {"a": 1}
    record.row("episodes", row)
    row["a"] = 2
    record.close()
    assert table(tmp_path / "episodes.csv") == [["a"], ["1"]]


# ------------------------------------------------------------------ metrics


def test_metrics_are_rows_and_points(started, tmp_path):
    record = started("learner")
    record.metrics(5, 1.23456, {"loss": 0.5, "updates": 10})
    record.metrics(6, 2.0, {"loss": 0.25, "updates": 20, "entropy": -1.0})
    record.close()
    assert table(tmp_path / "metrics" / "learner.csv") == [
        ["incarnation", "step", "wall_s", "loss", "updates", "entropy"],
        ["7", "5", "1.235", "0.5", "10", ""],
        ["7", "6", "2.0", "0.25", "20", "-1.0"],
    ]
    assert points(tmp_path / "tensorboard" / "learner") == [
        ("learner/wall_s", 5, 1.235),
        ("learner/loss", 5, 0.5),
        ("learner/updates", 5, 10),
        ("learner/wall_s", 6, 2.0),
        ("learner/loss", 6, 0.25),
        ("learner/updates", 6, 20),
        ("learner/entropy", 6, -1),
    ]


def test_each_incarnation_has_its_own_file_of_points(started, tmp_path):
    for incarnation in (7, 8):
        record = started("learner", incarnation)
        record.metrics(incarnation, 0.0, {})
        record.close()
    assert points(tmp_path / "tensorboard" / "learner") == [("learner/wall_s", 7, 0), ("learner/wall_s", 8, 0)]


def test_points_are_on_disk_before_the_record_is_closed(started, tmp_path):
    record = started("learner")
    record.metrics(5, 1.0, {"loss": 0.5})
    folder = tmp_path / "tensorboard" / "learner"
    eventually(lambda: folder.exists() and ("learner/loss", 5, 0.5) in points(folder))


def test_the_record_costs_no_service_an_import_of_torch(tmp_path):
    """The robot's side runs without torch; importing it also takes seconds and hundreds of MB."""
    program = (
        "import sys; from pathlib import Path; from common.record import RunRecord\n"
        "record = RunRecord(Path(sys.argv[1]), 'robot_bridge', 1); record.start()\n"
        "record.metrics(1, 1.0, {'steps': 1}); record.close(60); assert record.dropped == 0\n"
        "assert list(Path(sys.argv[1]).glob('tensorboard/robot_bridge/*'))\n"
        "assert not {'torch', 'tensorflow', 'mujoco'} & sys.modules.keys()"
    )
    run_program(program, tmp_path)


# ------------------------------------------------------------------ a disk that refuses


def refuse(*_, **__):
    raise OSError(28, "No space left on device")


def test_what_the_disk_refuses_is_counted_and_told_once(started, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(record_module, "write_atomically", refuse)
    record = started()
    for _ in range(3):
        record.part({"state": "running"})
    record.close()
    assert record.dropped == 3
    assert [entry.getMessage() for entry in caplog.records] == [
        f"{tmp_path}: the record cannot be written: [Errno 28] No space left on device"
    ]


def test_the_record_goes_on_when_the_disk_takes_again(started, tmp_path, monkeypatch):
    record = started()
    with monkeypatch.context() as patch:
        patch.setattr(record_module, "write_atomically", refuse)
        record.part({"state": "lost"})
        eventually(lambda: record.dropped == 1)
    record.part({"state": "kept"})
    record.close()
    assert read_parts(tmp_path)[0]["state"] == "kept"
    assert record.dropped == 1
    assert record.part_error is None


def test_a_last_part_that_the_disk_refuses_is_known(started, tmp_path, monkeypatch):
    monkeypatch.setattr(record_module, "write_atomically", refuse)
    record = started()
    record.part({"state": "stopped"})
    record.close()
    assert record.part_error is not None
    assert "No space left on device" in record.part_error


def test_a_folder_that_is_a_file_refuses_everything(started, tmp_path):
    for name in ("parts", "metrics", "tensorboard"):
        (tmp_path / name).write_text("in the way")
    record = started()
    record.part({})
    record.metrics(1, 1.0, {})
    record.row("parts/table", {"a": 1})
    record.row("episodes", {"a": 1})
    record.close()
    assert record.dropped == 3
    assert table(tmp_path / "episodes.csv") == [["a"], ["1"]]


def test_a_disk_that_is_still_full_at_the_end_ends_the_record_all_the_same(tmp_path):
    program = """
import resource, sys, time
from pathlib import Path
from common.record import RunRecord

resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
record = RunRecord(Path(sys.argv[1]), "actor", 1)
record.start()
for step in range(100):
    record.metrics(step, 1.0, {"a": 1.0})
    record.row("episodes", {"step": step, "text": "x" * 20})
began = time.monotonic()
record.close(timeout_s=60)
assert time.monotonic() - began < 50
assert record.dropped > 100
"""
    assert "Exception in thread" not in run_program(program, tmp_path)


def test_after_a_full_disk_all_that_was_recorded_can_be_read(tmp_path):
    """A limit on the size of files stands in for the full disk; each service's record outlives it."""
    program = """
import resource, sys, time
from pathlib import Path
from common.record import RunRecord, read_parts

directory = Path(sys.argv[1])
_, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
record = RunRecord(directory, "actor", 1)
record.start()

def recorded(state):
    for step in range(200):
        record.metrics(step, 1.0, {"a": 1.0, "b": 2.0, "c": 3.0})
    record.part({"state": state})

def wait_for(holds):
    deadline = time.monotonic() + 30
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.01)

recorded("before")
wait_for(lambda: read_parts(directory))
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
recorded("full")
wait_for(lambda: read_parts(directory)[0]["state"] == "full")  # small files still fit
assert record.dropped > 0
resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
recorded("after")
began = time.monotonic()
record.close(timeout_s=30)
assert time.monotonic() - began < 20
assert read_parts(directory)[0]["state"] == "after"
"""
    run_program(program, tmp_path)
    rows = table(tmp_path / "metrics" / "actor.csv")
    assert {len(row) for row in rows} == {6}
    assert rows[-1] == ["1", "199", "1.0", "1.0", "2.0", "3.0"]
    assert points(tmp_path / "tensorboard" / "actor")[-1] == ("actor/c", 199, 3.0)


def test_a_full_queue_drops_and_counts_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(record_module, "_QUEUE_LENGTH", 5)
    record = RunRecord(tmp_path, "actor", 1)  # not started: a disk that takes for ever
    for step in range(8):
        record.row("episodes", {"step": step})
    assert record.dropped == 3
    record.close()  # never started: nothing to wait for


def test_closing_writes_what_is_queued_even_if_the_queue_is_full(tmp_path, monkeypatch):
    monkeypatch.setattr(record_module, "_QUEUE_LENGTH", 2)
    blocked, release = threading.Event(), threading.Event()

    def wait_once(path, text):
        blocked.set()
        assert release.wait(TIMEOUT_S)
        write_atomically(path, text)

    monkeypatch.setattr(record_module, "write_atomically", wait_once)
    record = RunRecord(tmp_path, "actor", 1)
    record.start()
    record.part({})
    assert blocked.wait(TIMEOUT_S)  # one entry is being written, two fill the queue
    for step in range(3):
        record.row("episodes", {"step": step})
    assert record.dropped == 1
    closer = threading.Thread(target=record.close, args=(TIMEOUT_S,))
    closer.start()
    release.set()
    closer.join(TIMEOUT_S)
    assert not closer.is_alive()
    assert table(tmp_path / "episodes.csv") == [["step"], ["0"], ["1"]]


def test_closing_gives_up_on_a_disk_that_hangs(tmp_path, monkeypatch):
    release = threading.Event()
    monkeypatch.setattr(record_module, "write_atomically", lambda path, text: release.wait(TIMEOUT_S))
    record = RunRecord(tmp_path, "actor", 1)
    record.start()
    record.part({})
    record.close(timeout_s=0.01)
    release.set()
    record.close()


def run_program(program, *arguments):
    """Run Python in a process of its own, which must succeed; return what it said to stderr."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == 0, result.stderr
    return result.stderr
