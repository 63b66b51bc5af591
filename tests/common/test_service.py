"""What every service has around its own loop: peers, commands, a clean end, an error that says what is wrong."""

from __future__ import annotations

import contextlib
import csv
import logging
import signal
import subprocess
import sys
import threading
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import msgpack
import pytest
import tomli_w

from common import record as record_module
from common import service as service_module
from common import topics
from common.clock import FakeClock
from common.codec import decode, encode
from common.errors import MessageError, ServiceError
from common.messages import SCHEMA_VERSION, Command, CommandReply, Finished, Status, TaskSpec
from common.record import read_parts
from common.run_service import run_service
from common.run_settings import ClockSettings, RunSettings, TransportSettings
from common.service import (
    DRAIN_TIMEOUT_S,
    GONE_AFTER_S,
    HEARTBEAT_S,
    OUTAGE_S,
    RECORD_S,
    STOP_TIMEOUT_S,
    Service,
)
from common.transport import InMemoryNetwork
from tests.helpers import TIMEOUT_S, eventually, free_port, make_run, make_spec

ROOT = Path(__file__).parents[2]


class Scene:
    """Services of one network and one clock, and a stranger who can say anything."""

    def __init__(self, directory):
        self.network, self.clock = InMemoryNetwork(), FakeClock()
        self._directory, self._services, self._beats = directory, [], Counter()
        self.stranger = self.network.transport(make_run())
        self.stranger.subscribe(topics.STATUS, self._count, any_run=True)

    def _count(self, payload):
        with contextlib.suppress(MessageError):
            self._beats[decode(payload, Status).incarnation] += 1

    def service(self, name, run="test", start=True):
        settings = make_run(self._directory, run)
        service = Service(name, settings, self.network.transport(settings), self.clock)
        if start:
            self.start(service)
        return service

    def start(self, service):
        self._services.append(service)
        service.start()

    def close(self, service):
        self._services.remove(service)
        service.close()

    def close_all(self):
        for service in list(self._services):
            self.close(service)

    def say(self, message, topic=topics.STATUS, run="test"):
        self.network.transport(make_run(run=run)).publisher(topic).put(
            message if isinstance(message, bytes) else encode(message)
        )

    def beat(self):
        """Let a heartbeat's time pass, and all hearts beat in it."""
        before = self._beats.copy()
        self.clock.advance(HEARTBEAT_S)
        eventually(
            lambda: all(self._beats[service.incarnation] > before[service.incarnation] for service in self._services),
            "a heartbeat",
        )

    def until(self, holds, what="it"):
        """Let heartbeats pass until it holds."""

        def held():
            self.beat()
            return holds()

        eventually(held, what)


@pytest.fixture
def scene(tmp_path):
    scene = Scene(tmp_path)
    yield scene
    scene.close_all()


def status(service="actor", incarnation=1, state="running", run="test", **counters):
    counts = {name: float(value) for name, value in counters.items()}
    return Status(service, run, "robot0", incarnation, state, counts, {})


def heard(service, name="actor"):
    eventually(lambda: service.peer_age_s(name) < float("inf"), f"a status of {name}")


@contextlib.contextmanager
def running(function, *arguments):
    """Run a function on a thread; yields the list that gets its result, and waits for its end."""
    results = []
    thread = threading.Thread(target=lambda: results.append(function(*arguments)), daemon=True)
    thread.start()
    yield results
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()


# ------------------------------------------------------------------ peers


def test_services_hear_each_other(scene):
    actor, replay = scene.service("actor"), scene.service("replay")
    actor.counters = lambda: {"actions": 3}
    actor.state = "running"
    scene.until(lambda: replay.peer_state("actor") == "running")
    scene.until(lambda: replay.peer_counter("actor", "actions") == 3)
    assert actor.peer_state("replay") == "starting"
    assert actor.peer_counter("replay", "anything") == 0


def test_a_service_that_was_never_heard_of_is_gone(scene):
    actor = scene.service("actor", start=False)
    assert actor.peer_state("replay") == "gone"
    assert actor.peer_age_s("replay") == float("inf")
    assert actor.peer_counter("replay", "rows") == 0


def test_a_silent_peer_is_gone_after_a_while_and_back_with_its_next_word(scene):
    replay = scene.service("replay")
    scene.say(status("actor"))
    heard(replay)
    scene.clock.advance(GONE_AFTER_S - 0.001)
    assert replay.peer_state("actor") == "running"
    assert replay.peer_age_s("actor") == pytest.approx(GONE_AFTER_S - 0.001)
    scene.clock.advance(0.001)
    assert replay.peer_state("actor") == "gone"
    scene.say(status("actor", actions=4))
    eventually(lambda: replay.peer_state("actor") == "running")


def test_a_peer_whose_messages_are_lost_is_gone(scene):
    actor, replay = scene.service("actor"), scene.service("replay")
    heard(replay)
    scene.network.drops = lambda topic, payload: True
    scene.clock.advance(GONE_AFTER_S)
    assert replay.peer_state("actor") == "gone"
    scene.network.drops = lambda topic, payload: False
    scene.until(lambda: replay.peer_state("actor") == actor.state)


def test_a_peer_that_says_goodbye_is_gone_at_once(scene):
    actor, replay = scene.service("actor"), scene.service("replay")
    heard(replay)
    scene.close(actor)
    eventually(lambda: replay.peer_state("actor") == "gone")
    assert replay.peer_age_s("actor") == float("inf")


def test_the_heartbeat_keeps_its_period(scene):
    beats = []
    scene.stranger.subscribe(topics.STATUS, beats.append)
    scene.service("actor")
    eventually(lambda: len(beats) == 1)
    for count in (2, 3, 4):
        scene.clock.advance(HEARTBEAT_S)
        eventually(lambda count=count: len(beats) == count)
    assert {decode(beat, Status).service for beat in beats} == {"actor"}


def test_a_restarted_peer_counts_and_its_predecessors_last_words_do_not(scene, caplog):
    caplog.set_level(logging.INFO)
    replay = scene.service("replay")
    scene.say(status("actor", incarnation=5, state="running", actions=10))
    eventually(lambda: replay.peer_counter("actor", "actions") == 10)
    scene.say(status("actor", incarnation=6, state="starting", actions=1))
    scene.say(status("actor", incarnation=5, state="stopped", actions=11))
    eventually(lambda: replay.peer_counter("actor", "actions") == 1)
    assert replay.peer_state("actor") == "starting"
    eventually(lambda: caplog.text.count("actor has joined") == 2)


def test_a_count_that_is_no_number_is_left_out_and_the_service_stays(scene):
    learner, replay = scene.service("learner"), scene.service("replay")
    learner.counters = lambda: {"updates": 7, "loss": float("nan"), "return": float("-inf")}
    scene.until(lambda: replay.peer_counter("learner", "updates") == 7)
    assert replay.peer_counter("learner", "loss") == 0
    assert replay.refusals.total == 0


# ------------------------------------------------------------------ two of one kind


def test_of_two_equal_services_the_newer_one_stays(scene):
    older, newer = scene.service("actor"), scene.service("actor")
    assert older.incarnation < newer.incarnation
    with older.wake:  # its loop is told at once
        assert older.wake.wait_for(older.stopping.is_set, TIMEOUT_S)
    assert older.failure == "a newer actor has joined this run; two cannot serve one robot"
    scene.close(older)
    scene.beat()
    assert not newer.stopping.is_set()
    assert newer.failure is None


def test_a_newer_service_that_has_already_left_changes_nothing(scene):
    actor = scene.service("actor")
    scene.say(status("actor", incarnation=2**61, state="stopped"))
    scene.say(status("replay"))  # comes after it
    heard(actor, "replay")
    assert not actor.stopping.is_set()


def test_a_service_is_not_its_own_peer(scene):
    actor = scene.service("actor")
    scene.say(status("replay"))
    heard(actor, "replay")
    assert actor.peer_state("actor") == "gone"
    assert not actor.stopping.is_set()


# ------------------------------------------------------------------ strangers


def test_a_service_of_another_run_is_reported_once_and_is_no_peer(scene, caplog):
    actor = scene.service("actor")
    for _ in range(3):
        scene.say(status("replay", run="other"), run="other")
        scene.say(status("actor", run="other", incarnation=2**61), run="other")
    scene.say(status("learner", run="third"), run="third")
    scene.say(status("learner"))
    heard(actor, "learner")
    assert actor.peer_state("replay") == "gone"
    assert not actor.stopping.is_set()
    errors = [entry.getMessage() for entry in caplog.records if entry.levelno == logging.ERROR]
    assert errors == [
        "replay on this mesh belongs to run 'other', expected 'test': check [run] id and the endpoints",
        "learner on this mesh belongs to run 'third', expected 'test': check [run] id and the endpoints",
    ]


def test_a_peer_of_another_release_is_counted_reported_once_and_no_peer(scene, caplog):
    actor = scene.service("actor")
    foreign = msgpack.packb({**msgpack.unpackb(encode(status("replay"))), "schema": SCHEMA_VERSION + 1})
    for _ in range(3):
        scene.say(foreign)
    scene.say(status("learner"))
    heard(actor, "learner")
    assert actor.refusals.counts == {"status": 3}
    assert actor.peer_state("replay") == "gone"
    assert caplog.text.count(f"expected schema version {SCHEMA_VERSION}, got {SCHEMA_VERSION + 1}") == 1


def test_rubbish_on_status_and_finished_is_counted(scene):
    actor = scene.service("actor")
    scene.say(b"\xc1")
    scene.say(b"\xc1", topics.FINISHED)
    eventually(lambda: actor.refusals.total == 2)
    assert actor.refusals.counts == {"status": 1, "finished": 1}
    assert actor.finished is None


# ------------------------------------------------------------------ finished


def test_the_bridges_word_that_the_run_is_over_wakes_the_service(scene):
    actor = scene.service("actor")
    assert actor.finished is None
    scene.say(status("robot_bridge", incarnation=5))
    heard(actor, "robot_bridge")
    with actor.wake:
        scene.say(Finished(5, 100, "steps"), topics.FINISHED)
        assert actor.wake.wait_for(lambda: actor.finished, TIMEOUT_S)
    assert actor.finished == Finished(5, 100, "steps")


def test_only_the_running_bridge_can_say_that_the_run_is_over(scene):
    actor = scene.service("actor")
    scene.say(status("robot_bridge", incarnation=7))
    heard(actor, "robot_bridge")
    for incarnation in (1, 6, 8):
        scene.say(Finished(incarnation, 10, "steps"), topics.FINISHED)
        scene.beat()
        scene.beat()  # in the second one at the latest it is taken
        assert actor.finished is None
    scene.say(Finished(7, 11, "stopped"), topics.FINISHED)
    eventually(lambda: actor.finished == Finished(7, 11, "stopped"))


def test_a_service_learns_from_the_others_that_it_has_been_replaced(scene):
    actor = scene.service("actor")
    told = status("robot_bridge")
    scene.say(replace(told, peers={"actor": actor.incarnation, "replay": actor.incarnation + 1}))
    heard(actor, "robot_bridge")
    assert not actor.stopping.is_set()
    scene.say(replace(told, peers={"actor": actor.incarnation + 1}, robot="another"))
    scene.beat()
    scene.beat()
    assert not actor.stopping.is_set()
    scene.say(replace(told, peers={"actor": actor.incarnation + 1}))
    eventually(actor.stopping.is_set)
    assert "a newer actor has joined" in actor.failure


def test_the_bridge_does_not_listen_to_itself(scene):
    bridge = scene.service("robot_bridge")
    scene.say(Finished(5, 100, "steps"), topics.FINISHED)
    scene.say(status("actor"))
    heard(bridge)
    assert bridge.finished is None


# ------------------------------------------------------------------ commands


def command(scene, service, name):
    reply = scene.stranger.query(
        topics.command_topic(service), name if isinstance(name, bytes) else encode(Command(name))
    )
    return decode(reply, CommandReply)


def test_every_service_can_be_stopped_by_command(scene):
    actor = scene.service("actor")
    actor.serve_commands({})
    assert command(scene, "actor", "stop") == CommandReply(True, "stopping")
    assert actor.stopping.is_set()
    assert actor.failure is None
    assert command(scene, "actor", "stop").accepted  # twice is no error


def test_a_command_is_answered_with_what_was_done(scene):
    learner, done = scene.service("learner"), []
    learner.serve_commands({"checkpoint": lambda: done.append(1) or "it is written"})
    assert command(scene, "learner", "checkpoint") == CommandReply(True, "it is written")
    assert done == [1]


@pytest.mark.parametrize("name", ["Stop", "", "pause", "stop "])
def test_an_unknown_command_is_answered_with_the_known_ones(scene, name):
    learner = scene.service("learner")
    learner.serve_commands({"checkpoint": lambda: "it is written"})
    assert command(scene, "learner", name) == CommandReply(
        False, f"expected one of ['checkpoint', 'stop'], got {name!r}"
    )
    assert not learner.stopping.is_set()


@pytest.mark.parametrize("payload", [b"", b"stop", encode(CommandReply(True, "stop"))])
def test_what_is_no_command_is_answered_with_the_reason(scene, payload):
    actor = scene.service("actor")
    actor.serve_commands({})
    reply = command(scene, "actor", payload)
    assert not reply.accepted
    assert "Command" in reply.detail
    assert not actor.stopping.is_set()


def test_whoever_has_to_be_told_of_a_stop_is_told_once(scene):
    actor, told = scene.service("actor"), []
    actor.on_stop = lambda: told.append(actor.stopping.is_set())
    actor.stop("SIGINT")
    actor.stop("once more")
    assert told == [True]


def test_stopping_wakes_the_loop(scene):
    actor = scene.service("actor")
    with running(actor.stop, "a test") as results, actor.wake:
        assert actor.wake.wait_for(actor.stopping.is_set, TIMEOUT_S)
    assert results == [None]


# ------------------------------------------------------------------ the task


def test_the_specification_comes_from_the_bridge_whenever_it_starts(scene):
    actor = scene.service("actor")
    with running(actor.query_spec) as results:
        scene.stranger.serve(topics.SPEC, lambda _: encode(make_spec()))
    assert results[0].dimensions == make_spec().dimensions


def test_waiting_for_the_bridge_ends_when_the_service_is_stopped(scene):
    actor = scene.service("actor")
    with running(actor.query_spec) as results:
        actor.stop("a test")
    assert results == [None]


def test_a_run_that_is_over_has_no_task_to_wait_for(scene):
    """The bridge is gone, or soon will be: a service that took long to start would wait for ever."""
    learner = scene.service("learner")
    scene.say(status("robot_bridge", incarnation=5))
    heard(learner, "robot_bridge")
    with running(learner.query_spec) as results:
        scene.say(Finished(5, 100, "steps"), topics.FINISHED)
    assert results == [None]


def test_a_missing_bridge_is_reported_now_and_then(scene, caplog):
    actor = scene.service("actor")
    with running(actor.query_spec):
        for count in (1, 2):
            scene.clock.advance(11)
            eventually(lambda count=count: caplog.text.count("no robot_bridge has answered yet") == count)
        actor.stop("a test")


@pytest.mark.parametrize("payload", [b"\xc1", encode(Command("stop"))])
def test_a_specification_that_cannot_be_used_ends_the_service(scene, payload):
    scene.stranger.serve(topics.SPEC, lambda _: payload)
    with pytest.raises(ServiceError, match=r"the bridge's task specification cannot be used: .*TaskSpec"):
        scene.service("actor", start=False).query_spec()


def test_a_bridge_of_another_release_ends_the_service(scene):
    values = {**msgpack.unpackb(encode(make_spec())), "schema": SCHEMA_VERSION + 1}
    scene.stranger.serve(topics.SPEC, lambda _: msgpack.packb(values))
    with pytest.raises(ServiceError, match=f"expected schema version {SCHEMA_VERSION}, got {SCHEMA_VERSION + 1}"):
        scene.service("actor", start=False).query_spec()
    assert TaskSpec is topics.SPEC.message


# ------------------------------------------------------------------ the end


def test_a_service_alone_ends_as_soon_as_nothing_is_on_its_way(scene):
    actor = scene.service("actor")
    left = [3]

    def work():
        left[0] -= 1

    assert actor.drain(lambda: left[0] == 0, work) is True
    assert left == [0]
    assert actor.state == "drained"


def test_a_service_serves_until_its_peers_are_drained(scene):
    actor, replay = scene.service("actor"), scene.service("replay")
    actor.state = "running"
    scene.until(lambda: replay.peer_state("actor") == "running")
    worked = []
    with running(replay.drain, lambda: True, lambda: worked.append(replay.state)) as results:
        scene.until(lambda: actor.peer_state("replay") == "drained")
        before = len(worked)
        scene.until(lambda: len(worked) > before)
        assert results == []
        actor.state = "drained"
        scene.until(lambda: results)
    assert results == [True]
    assert worked[0] == "draining"


def test_a_drained_service_that_gets_work_again_goes_on_working(scene):
    actor, replay = scene.service("actor"), scene.service("replay")
    actor.state = "running"
    scene.until(lambda: replay.peer_state("actor") == "running")
    drained = [True]
    with running(replay.drain, lambda: drained[0], lambda: None) as results:
        eventually(lambda: replay.state == "drained")
        drained[0] = False
        actor.state = "drained"
        scene.until(lambda: replay.peer_state("actor") == "drained")
        scene.beat()
        assert results == []
        drained[0] = True
    assert results == [True]


def test_a_peer_that_says_goodbye_is_not_waited_for(scene):
    replay = scene.service("replay")
    scene.say(status("actor", state="running"))
    heard(replay)
    with running(replay.drain, lambda: True, lambda: None) as results:
        eventually(lambda: replay.state == "drained")
        assert results == []
        scene.say(status("actor", state="stopped"))
    assert results == [True]


@pytest.mark.parametrize(("stopped", "patience_s"), [(False, OUTAGE_S), (True, GONE_AFTER_S)])
def test_a_silent_peer_is_waited_for_as_long_as_the_network_may_be_out(scene, stopped, patience_s):
    replay = scene.service("replay")
    scene.say(status("actor", state="running"))
    heard(replay)
    if stopped:  # whoever pressed Ctrl-C does not want to wait
        replay.stop("a test")
    looks = []
    with running(replay.drain, lambda: True, lambda: looks.append(1)) as results:
        scene.clock.advance(patience_s - 0.001)
        before = len(looks)
        eventually(lambda: len(looks) > before + 1)
        assert results == []
        scene.clock.advance(0.001)
    assert results == [True]


def test_all_services_drain_together_and_end(scene):
    services = [scene.service(name) for name in topics.SERVICES]
    for service in services:
        service.state = "running"
    scene.until(lambda: all(s.peer_state(p.name) == "running" for s in services for p in services if s is not p))
    left = dict.fromkeys(topics.SERVICES, 0)
    left |= {"actor": 10, "replay": 20}

    def end(service):
        def work():
            left[service.name] -= 1

        ended = service.drain(lambda: left[service.name] <= 0, work)
        scene.close(service)
        return ended

    with contextlib.ExitStack() as stack:
        ends = [stack.enter_context(running(end, service)) for service in services]
        scene.until(lambda: all(ends), "the end of all")
    assert ends == [[True]] * 4


@pytest.mark.parametrize(
    ("ask", "limit_s"),
    [(None, DRAIN_TIMEOUT_S), ("stop", STOP_TIMEOUT_S), ("steps", DRAIN_TIMEOUT_S), ("stopped", STOP_TIMEOUT_S)],
)
def test_draining_gives_up_after_its_time(scene, caplog, ask, limit_s):
    actor = scene.service("actor")
    if ask == "stop":
        actor.stop("a test")
    elif ask:
        scene.say(status("robot_bridge", incarnation=1))
        heard(actor, "robot_bridge")
        scene.say(status("robot_bridge", incarnation=1, state="stopped"))
        scene.say(Finished(1, 10, ask), topics.FINISHED)
        eventually(lambda: actor.finished)
    began_ns = scene.clock.now_ns()
    assert actor.drain(lambda: False, lambda: scene.clock.advance(limit_s / 4)) is False
    assert (scene.clock.now_ns() - began_ns) / 1e9 == limit_s * 5 / 4  # the first look after the limit
    assert actor.state == "draining"
    assert f"not drained after {limit_s:.0f} s; peers: {{'robot_bridge': 'gone'" in caplog.text


def test_a_peer_that_never_drains_does_not_hold_up_the_end_for_ever(scene):
    actor = scene.service("actor")

    def work():
        scene.clock.advance(1.0)
        scene.say(status("replay", state="running"))

    scene.say(status("replay", state="running"))
    heard(actor, "replay")
    assert actor.drain(lambda: True, work) is False
    assert actor.state == "drained"


def test_a_stop_while_draining_shortens_it(scene):
    actor = scene.service("actor")
    began_ns = scene.clock.now_ns()

    def work():
        scene.clock.advance(1)
        if scene.clock.now_ns() - began_ns >= 10e9:
            actor.stop("the second Ctrl-C")

    assert actor.drain(lambda: False, work) is False
    assert (scene.clock.now_ns() - began_ns) / 1e9 == 10


def test_a_transport_that_cannot_say_goodbye_does_not_hold_up_the_end(tmp_path, monkeypatch):
    release = threading.Event()
    settings = make_run(tmp_path)
    transport = InMemoryNetwork().transport(settings)
    monkeypatch.setattr(service_module, "CLOSE_TIMEOUT_S", 0.01)
    monkeypatch.setattr(transport, "close", lambda: release.wait(TIMEOUT_S))
    service = Service("actor", settings, transport, FakeClock())
    service.start()
    service.close()  # returns, although the transport does not
    release.set()
    assert read_parts(tmp_path)[0]["state"] == "stopped"


# ------------------------------------------------------------------ the record


def test_the_part_says_what_the_service_counted(scene, tmp_path):
    actor = scene.service("actor", start=False)
    actor.counters = lambda: {"actions": 3, "steps": 12}
    actor.details = lambda: {"policy": "numpy"}
    scene.start(actor)
    scene.say(status("replay"))
    scene.say(b"rubbish")
    heard(actor, "replay")
    eventually(lambda: actor.refusals.total == 1)
    scene.clock.advance(2.5)
    actor.failure = "a reason"
    scene.close(actor)
    (part,) = read_parts(tmp_path, "actor")
    assert part["incarnation"] == actor.incarnation
    assert part["state"] == "stopped"
    assert part["failure"] == "a reason"
    assert part["run"] == "test"
    assert part["wall_s"] == 2.5
    assert part["counters"] == {"actions": 3, "steps": 12}
    assert part["policy"] == "numpy"
    assert part["refused_messages"] == {"status": 1}
    assert part["record_entries_dropped"] == 0
    assert part["bytes_sent"].keys() == {"status"}
    assert part["bytes_received"]["status"] > part["bytes_sent"]["status"]  # its own, and others'
    with (tmp_path / "metrics" / "actor.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows[-1] == {
        "incarnation": str(actor.incarnation),
        "step": "12",
        "wall_s": "2.5",
        "actions": "3",
        "steps": "12",
    }


def test_the_part_is_written_while_the_service_runs(scene, tmp_path):
    actor = scene.service("actor")
    actor.counters = lambda: {"actions": 1}
    scene.clock.advance(RECORD_S)
    eventually(lambda: (parts := read_parts(tmp_path)) and parts[0]["counters"] == {"actions": 1})
    assert read_parts(tmp_path)[0]["state"] == "starting"
    assert not list(tmp_path.glob("parts/.*"))


def test_a_disk_that_refuses_is_counted_and_disturbs_nobody(scene, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(record_module, "write_atomically", refuse)
        actor, replay = scene.service("actor"), scene.service("replay")
        scene.clock.advance(RECORD_S)
        scene.until(lambda: actor.record.dropped > 0)
        scene.until(lambda: replay.peer_state("actor") == "starting")
    scene.clock.advance(RECORD_S)
    eventually(lambda: (parts := read_parts(tmp_path, "actor")) and parts[0]["record_entries_dropped"] > 0)


# ------------------------------------------------------------------ the command line


@dataclass(frozen=True)
class TinyConfig:
    run: RunSettings
    transport: TransportSettings
    clock: ClockSettings


def never(service, config):
    raise AssertionError("the service must not start")


def write_config(directory, bulk=None):
    """Write the file of an actor that nobody connects to."""
    run = {"id": "r", "directory": str(directory / "run")}
    transport = {
        "listen_real_time": f"tcp/127.0.0.1:{free_port()}",
        "listen_bulk": bulk or f"tcp/127.0.0.1:{free_port()}",
    }
    path = directory / "actor.toml"
    path.write_text(tomli_w.dumps({"run": run, "transport": transport}))
    return path


@pytest.mark.parametrize(
    ("addition", "options", "expected"),
    [
        ("[run]\n", (), "not a TOML file"),
        ("sharedmemory = true\n", (), "[transport]: unknown key 'sharedmemory'; did you mean 'shared_memory'?"),
        ("shared_memory = 1\n", (), "[transport] shared_memory = 1: expected true or false"),
        ("[running]\n", (), "unknown section [running]; did you mean 'run'?"),
        ("", ("run.seed=-1",), "[run] seed = -1: expected a value from 0 to 2147483647"),
        ("", ("run.id=a/b",), "id = 'a/b': expected letters, digits"),
        ("", ("seed=1",), "--set 'seed=1': expected section.key=value"),
        ("", ("learner.lr=1",), "--set learner.lr=1: no section [learner]"),
    ],
)
def test_a_wrong_configuration_ends_with_1_and_says_why(tmp_path, capfd, addition, options, expected):
    path = write_config(tmp_path)
    path.write_text(path.read_text() + addition)
    arguments = [part for option in options for part in ("--set", option)]
    assert run_service("actor", TinyConfig, never, ["--config", str(path), *arguments]) == 1
    said = capfd.readouterr().err
    assert said.startswith("actor: error: ")
    assert expected in said
    assert said.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_a_missing_configuration_ends_with_1_and_says_which(tmp_path, capfd):
    path = tmp_path / "nowhere.toml"
    assert run_service("actor", TinyConfig, never, ["--config", str(path)]) == 1
    assert capfd.readouterr().err == f"actor: error: {path}: cannot be read: No such file or directory\n"


def test_a_run_directory_that_cannot_be_made_ends_with_1_and_says_so(tmp_path, capfd):
    path = write_config(tmp_path)
    (tmp_path / "run").write_text("in the way")
    assert run_service("actor", TinyConfig, never, ["--config", str(path)]) == 1
    assert capfd.readouterr().err.startswith(f"actor: error: {tmp_path / 'run'}: the run's folder cannot be written: ")


@pytest.mark.parametrize("arguments", [[], ["--config"], ["--configuration", "x"], ["x"]])
def test_a_wrong_command_line_ends_with_2_and_shows_the_usage(capfd, arguments):
    with pytest.raises(SystemExit) as caught:
        run_service("actor", TinyConfig, never, arguments)
    assert caught.value.code == 2
    assert "usage: python -m services.actor" in capfd.readouterr().err


PROGRAM = """
import sys
from dataclasses import dataclass
from common.errors import ServiceError
from common.run_settings import ClockSettings, RunSettings, TransportSettings
from common.run_service import run_service

@dataclass(frozen=True)
class TinyConfig:
    run: RunSettings
    transport: TransportSettings
    clock: ClockSettings

def serve(service, config):
    service.state = "running"
    print("running", flush=True)
    {body}

sys.exit(run_service("actor", TinyConfig, serve, sys.argv[1:]))
"""
WAIT = "while not service.stopping.wait(1.0): pass"
SPIN = "while not service.stopping.wait(0): pass"
LOOP = """while not service.stopping.is_set():
        with service.wake:
            service.wake.wait(0.0001)"""


@contextlib.contextmanager
def process(config, body, *arguments):
    """A service in a process of its own, whose loop is ``body``."""
    command = [sys.executable, "-c", PROGRAM.format(body=body), "--config", str(config), *arguments]
    child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


@pytest.mark.parametrize("body", [WAIT, SPIN, LOOP], ids=["waits", "spins", "loops"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_a_signal_ends_a_service_whatever_it_is_doing(tmp_path, body, number):
    with process(write_config(tmp_path), body) as child:
        assert child.stdout.readline() == "running\n"
        child.send_signal(number)
        _, said = child.communicate(timeout=TIMEOUT_S)
        assert child.returncode == 0, said
    assert f"stopping: {number.name}" in said
    assert "actor has ended" in (tmp_path / "run" / "logs" / "actor.log").read_text()
    (part,) = read_parts(tmp_path / "run")
    assert (part["state"], part["failure"], part["pid"]) == ("stopped", None, child.pid)


def test_a_service_started_with_signals_ignored_can_still_be_stopped(tmp_path):
    """So a shell starts what it puts in the background."""
    path = write_config(tmp_path)
    program = f"import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n{PROGRAM.format(body=WAIT)}"
    command = [sys.executable, "-c", program, "--config", str(path)]
    child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert child.stdout.readline() == "running\n"
        child.send_signal(signal.SIGINT)
        child.communicate(timeout=TIMEOUT_S)
        assert child.returncode == 0
    finally:
        child.kill()
        child.communicate()


@pytest.mark.parametrize(
    ("body", "failure", "said"),
    [
        ("raise ServiceError('the camera is unplugged')", "the camera is unplugged", "ERROR the camera is unplugged"),
        ("1 / 0", "ZeroDivisionError: division by zero", "unexpected ZeroDivisionError: division by zero; see the log"),
        ("service.failure = 'superseded'", "superseded", "ERROR superseded"),
    ],
)
def test_a_failure_ends_with_1_and_stands_in_part_and_log(tmp_path, body, failure, said):
    with process(write_config(tmp_path), body) as child:
        _, stderr = child.communicate(timeout=TIMEOUT_S)
        assert child.returncode == 1
    log = (tmp_path / "run" / "logs" / "actor.log").read_text()
    (part,) = read_parts(tmp_path / "run")
    assert part["failure"] == failure
    assert said in stderr
    assert said in log
    assert ("Traceback" in log) == ("ZeroDivisionError" in failure)


def test_a_port_in_use_ends_with_1_and_is_named_in_the_log(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    folders = [tmp_path / name for name in ("first", "second")]
    for folder in folders:
        folder.mkdir()
        write_config(folder, bulk=endpoint)
    with process(folders[0] / "actor.toml", WAIT) as first:
        assert first.stdout.readline() == "running\n"
        with process(folders[1] / "actor.toml", WAIT) as second:
            _, said = second.communicate(timeout=TIMEOUT_S)
            assert second.returncode == 1
    expected = f"cannot listen on {endpoint}: another process listens there"
    assert expected in said
    assert expected in (folders[1] / "run" / "logs" / "actor.log").read_text()


def test_a_setting_on_the_command_line_overrides_the_file(tmp_path):
    body = "print(service.run.seed, config.run.id)"
    with process(write_config(tmp_path), body, "--set", "run.seed=7", "--set", "run.id=named") as child:
        said, _ = child.communicate(timeout=TIMEOUT_S)
        assert child.returncode == 0
    assert said == "running\n7 named\n"
