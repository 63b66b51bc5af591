"""The ring's file: created, reopened, refused, and left behind by a killed process."""

import errno
import os
import shutil
import subprocess

import pytest

from common.errors import RingError
from common.frame_ring import RingReader, layout
from tests.common.ring_cases import Bridge, task_spec
from tests.common.test_frame_ring import append_all, assert_right, every_pair, make_ring

SPEC = task_spec()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "ring"


def test_the_file_is_allocated_in_full(path):
    ring = make_ring(path, 1000)
    assert path.stat().st_size == ring.layout.file_bytes
    assert path.stat().st_blocks * 512 >= ring.layout.file_bytes
    assert os.listdir(path.parent) == ["ring"]


def test_a_reopened_ring_goes_on_in_the_middle_of_an_attempt(path):
    ring, bridge = make_ring(path, 30, 1.0), Bridge()
    made = [bridge.start(), *(bridge.step(new=i % 3) for i in range(50))]
    append_all(ring, made)
    view = RingReader(path)
    for _ in range(3):
        counts = ring.rows_appended, ring.frames_appended, ring.transitions_appended, ring.last_persisted()
        ring.close()
        ring = make_ring(path, 30, 1.0)
        assert counts == (
            ring.rows_appended,
            ring.frames_appended,
            ring.transitions_appended,
            ring.last_persisted(),
        )
        more = [bridge.step(new=0), bridge.step(), bridge.step()]
        append_all(ring, more)
        end = ring.rows_appended
        # A reader that mapped the ring before the restart sees the new rows; none of the pairs is missing.
        rows = every_pair(view)
        assert rows[-4:].tolist() == [end - 4, end - 3, end - 2, end - 1]
        assert_right(bridge, bridge.experiences, rows, view.gather(rows).minibatch)
    assert ring.transitions_appended == ring.rows_appended - 1 == 59


def test_what_is_persisted_survives_wraps_and_restarts(path):
    ring, bridge = make_ring(path, 10), Bridge()
    append_all(ring, [bridge.start(), *(bridge.step() for _ in range(30))])
    bridge.restart()
    made = [bridge.start(), *(bridge.step() for _ in range(5))]
    append_all(ring, made[:3] + made[4:])
    for _ in range(2):
        assert ring.persisted_count == 31 + 5
        assert ring.persisted_counts() == {1: 31, 2: 5}
        assert ring.persisted_ranges(1) == [(0, 31)]
        assert ring.persisted_ranges(2) == [(0, 3), (4, 6)]
        assert ring.contains(1, 0)
        assert not ring.contains(2, 3)
        assert not ring.contains(3, 0)
        assert ring.last_persisted() == (2, 5)
        ring.close()
        ring = make_ring(path, 10)
    ring.append(made[3])
    assert ring.persisted_ranges(2) == [(0, 6)]


class Killed(Exception):
    """Stands for a signal that ends the process."""


class Fragile:
    """An array whose n-th store kills."""

    def __init__(self, array, survives):
        self.array, self.left = array, survives

    def __getitem__(self, key):
        return self.array[key]

    def __setitem__(self, key, value):
        if not self.left:
            raise Killed
        self.left -= 1
        self.array[key] = value


@pytest.mark.parametrize(
    ("where", "survives"),
    [*(("_counters", n) for n in range(4)), *(("_frames", n) for n in range(3)), ("_rows", 0)],
)
def test_a_process_killed_inside_append_leaves_a_ring_without_the_unfinished_row(path, where, survives):
    ring, bridge = make_ring(path, 20, 1.0), Bridge()
    made = [bridge.start(), *(bridge.step(new=2) for _ in range(45))]
    append_all(ring, made)
    unfinished = bridge.step(new=3)
    setattr(ring, where, Fragile(getattr(ring, where), survives))
    with pytest.raises(Killed):
        ring.append(unfinished)
    left_behind = path.with_name("left_behind")
    shutil.copy(path, left_behind)

    ring = make_ring(left_behind, 20, 1.0)
    assert ring.rows_appended == 46
    assert ring.last_persisted() == (1, 45)
    assert not ring.contains(1, 46)
    view = RingReader(left_behind)
    rows = every_pair(view)
    assert len(rows) > 5
    assert_right(bridge, bridge.experiences, rows, view.gather(rows).minibatch)
    # The sender still has it, and it is as good as new.
    append_all(ring, [unfinished, bridge.step(new=0), bridge.step(new=0)])
    rows = every_pair(view)
    assert rows[-3:].tolist() == [46, 47, 48]
    assert_right(bridge, bridge.experiences, rows, view.gather(rows).minibatch)


def test_frames_spoilt_by_a_killed_process_stay_gone_if_fewer_come_next(path):
    ring, bridge = make_ring(path, 20, 1.0), Bridge()
    append_all(ring, [bridge.start(), *(bridge.step(new=2) for _ in range(45))])
    ring._frames = Fragile(ring._frames, 2)
    with pytest.raises(Killed):
        ring.append(bridge.step(new=3))
    left_behind = path.with_name("left_behind")
    shutil.copy(path, left_behind)
    ring = make_ring(left_behind, 20, 1.0)
    ring.append(Bridge(incarnation=2).start(new=1))
    rows = every_pair(ring)
    assert len(rows) > 5
    assert_right(bridge, bridge.experiences, rows, RingReader(left_behind).gather(rows).minibatch)


def test_a_process_killed_before_it_counted_a_stored_row_has_it(path):
    ring, bridge = make_ring(path, 20), Bridge()
    append_all(ring, [bridge.start(), bridge.step()])
    ring._persisted.add = None
    with pytest.raises(TypeError):
        ring.append(bridge.step())
    left_behind = path.with_name("left_behind")
    shutil.copy(path, left_behind)
    ring = make_ring(left_behind, 20)
    assert ring.persisted_count == 3
    assert ring.persisted_ranges(1) == [(0, 3)]
    assert ring.transitions_appended == 2


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"capacity_rows": 65, "frames_per_row": 1.24}, "capacity_rows 64 .wanted 65."),
        ({"frames_per_row": 2.0}, "capacity_frames 80 .wanted 128."),
        ({"spec": task_spec(action_size=3)}, "action_size 2 .wanted 3."),
        ({"spec": task_spec(camera=False)}, "frame_stack 3 .wanted 0."),
    ],
)
def test_a_ring_of_another_layout_is_refused_by_name_and_kept(path, settings, named):
    ring, bridge = make_ring(path), Bridge()
    ring.append(bridge.start())
    ring.close()
    with pytest.raises(RingError, match=named):
        make_ring(path, **settings)
    assert make_ring(path).rows_appended == 1


def test_what_is_no_ring_is_refused_and_kept(path):
    path.write_bytes(b"a letter to my aunt" * 100)
    for access in (make_ring, RingReader):
        with pytest.raises(RingError, match=r"ring: not an experience ring"):
            access(path)
    assert path.read_bytes().startswith(b"a letter")


def test_a_damaged_a_short_and_another_versions_ring_are_refused(path):
    make_ring(path).close()
    good = path.read_bytes()
    damaged = {
        "damaged": good[:20] + b"\x01" + good[21:],
        "expected": good[:-4096],
        "layout version 2": good[:8] + b"\x02" + good[9:],
    }
    for named, content in damaged.items():
        path.write_bytes(content)
        for access in (make_ring, RingReader):
            with pytest.raises(RingError, match=named):
                access(path)


def test_a_missing_ring_cannot_be_read_and_a_missing_directory_not_be_made(tmp_path):
    with pytest.raises(RingError, match="No such file"):
        RingReader(tmp_path / "ring")
    with pytest.raises(RingError, match="No such file"):
        make_ring(tmp_path / "missing" / "ring")


def test_only_one_writer_at_a_time(path):
    ring = make_ring(path)
    with pytest.raises(RingError, match="another process writes"):
        make_ring(path)
    ring.close()
    make_ring(path).close()


def test_a_ring_needs_two_rows(path):
    with pytest.raises(RingError, match="at least 2, got 1"):
        make_ring(path, 1)


def test_a_full_disk_is_told_with_file_and_bytes_and_nothing_is_left(path, monkeypatch):
    def no_room(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", no_room)
    needed = layout.RingLayout.of_task(SPEC, 64, 1.25).file_bytes
    with pytest.raises(RingError, match=f"ring: .* needs {needed} bytes, .* free .No space .*make room") as caught:
        make_ring(path)
    assert isinstance(caught.value.__cause__, OSError)
    assert os.listdir(path.parent) == []


def test_a_disk_that_is_really_full(tmp_path):
    mounted = ["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(tmp_path)]
    if os.geteuid() or subprocess.run(mounted, capture_output=True, check=False).returncode:
        pytest.skip("only root can mount a small disk")
    try:
        with pytest.raises(RingError, match="make room"):
            make_ring(tmp_path / "ring", 10_000)
        assert os.listdir(tmp_path) == []
        ring = make_ring(tmp_path / "ring", 100)
        ring.append(Bridge().start())
        ring.close()
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


def test_closing_gives_the_file_up(path):
    ring = make_ring(path)
    ring.append(Bridge().start())
    frames = ring.frames  # somebody still looks at the pixels
    ring.close()
    assert frames[0, 1, 1, 1] == 28
