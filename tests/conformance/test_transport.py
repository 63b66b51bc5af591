"""What every transport promises: Zenoh over loopback, and the twin that stands in for it in tests and studies."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from common import topics
from common.errors import EndpointInUseError, TransportError
from common.run_settings import TransportSettings
from common.topics import SERVICES
from common.transport import InMemoryNetwork, ZenohTransport
from tests.helpers import TIMEOUT_S, eventually, free_port, make_run

ROOT = Path(__file__).parents[2]


class Ears:
    """Keeps what arrives on a topic."""

    def __init__(self, transport, topic=topics.STATUS, **options):
        self.payloads = []
        """What has come; the same payload several times in a row once."""
        self.bytes = 0
        transport.subscribe(topic, self._hear, **options)

    def _hear(self, payload):
        self.bytes += len(payload)
        if self.payloads[-1:] != [payload]:
            self.payloads.append(payload)

    def wait_for(self, payload):
        """Wait until this has come."""
        eventually(lambda: payload in self.payloads, "the payload")


def tell(publisher, payload, *ears):
    """Put until all have heard it: before it is connected, and where it is too busy, a transport drops messages."""

    def told():
        publisher.put(payload)
        return all(one.payloads[-1:] == [payload] for one in ears)

    eventually(told, "the payload")


class Endpoints:
    """Where one service listens."""

    def __init__(self):
        self.real_time, self.bulk = f"tcp/127.0.0.1:{free_port()}", f"tcp/127.0.0.1:{free_port()}"

    def settings(self, connect=()):
        return TransportSettings(
            listen_real_time=self.real_time,
            listen_bulk=self.bulk,
            connect_real_time=[other.real_time for other in connect],
            connect_bulk=[other.bulk for other in connect],
        )


class ZenohMesh:
    """Everyone who joins listens, and connects to all who were there before."""

    def __init__(self):
        self.transports, self._there = [], []

    def join(self, run="test", robot="robot0"):
        own = Endpoints()
        transport = ZenohTransport(make_run(run=run, robot=robot), own.settings(self._there))
        self._there.append(own)
        self.transports.append(transport)
        return transport


class MemoryMesh:
    def __init__(self):
        self.transports, self._network = [], InMemoryNetwork()

    def join(self, run="test", robot="robot0"):
        self.transports.append(self._network.transport(make_run(run=run, robot=robot)))
        return self.transports[-1]


@pytest.fixture(params=[ZenohMesh, MemoryMesh], ids=["zenoh", "memory"])
def mesh(request):
    """A mesh to join; everyone leaves it after the test."""
    mesh = request.param()
    yield mesh
    for transport in mesh.transports:
        transport.close()


@pytest.fixture
def opened():
    """Open Zenoh transports and close them after the test."""
    transports = []

    def open_transport(settings, **run):
        transports.append(ZenohTransport(make_run(**run), settings))
        return transports[-1]

    yield open_transport
    for transport in transports:
        transport.close()


# ------------------------------------------------------------------ publications


@pytest.mark.parametrize("topic", [topics.ACTION, topics.TIME_STEP, topics.EXPERIENCE, topics.POLICY, topics.CREDIT])
def test_what_arrives_is_unchanged_and_in_order(mesh, topic):
    here, there = mesh.join(), mesh.join()
    ears, publisher = Ears(there, topic), here.publisher(topic)
    payloads = [b"begin", b"", b"\0\xff" * 10, *(b"%d" % i for i in range(20)), bytes(range(256)), b"end"]
    tell(publisher, payloads[0], ears)
    for payload in payloads[1:-1]:
        publisher.put(payload)
    tell(publisher, payloads[-1], ears)
    places = [payloads.index(payload) for payload in ears.payloads]
    assert places == sorted(set(places))
    if isinstance(mesh, MemoryMesh):
        assert ears.payloads == payloads


@pytest.mark.parametrize("topic", [topics.TIME_STEP, topics.EXPERIENCE, topics.POLICY], ids=lambda topic: topic.name)
def test_a_large_message_arrives_whole_or_not_at_all(mesh, topic):
    here, there = mesh.join(), mesh.join()
    ears, large = Ears(there, topic), bytes(range(256)) * 10_000
    tell(here.publisher(topic), large, ears)
    assert ears.payloads == [large]


@pytest.mark.parametrize("topic", [topics.ARRAY_MINIBATCH, topics.POLICY], ids=lambda topic: topic.name)
def test_a_put_that_waits_gets_every_large_message_through(mesh, topic):
    here, there = mesh.join(), mesh.join()
    ears, publisher = Ears(there, topic), here.publisher(topic)
    tell(publisher, b"begin", ears)
    sizes = [16 * 2**20 + i for i in range(6)]
    for size in sizes:
        publisher.put(bytes(size))
    eventually(lambda: [len(payload) for payload in ears.payloads] == [5, *sizes], "every message, once and in order")


def test_both_directions_work_whoever_connected(mesh):
    first, second = mesh.join(), mesh.join()
    for sender, receiver in ((first, second), (second, first)):
        tell(sender.publisher(topics.STATUS), b"hello", Ears(receiver))


def test_every_subscriber_gets_a_message_the_sender_too(mesh):
    transports = [mesh.join() for _ in range(3)]
    ears = [Ears(transport) for transport in (*transports, transports[1])]
    tell(transports[0].publisher(topics.STATUS), b"to all", *ears)


def test_topics_are_kept_apart(mesh):
    here, there = mesh.join(), mesh.join()
    names = (topics.ACTION, topics.TIME_STEP_HEAD, topics.EXPERIENCE, topics.EXPERIENCE_RESENT)
    ears = {topic: Ears(there, topic) for topic in names}
    for _ in range(2):
        for topic, one in ears.items():
            tell(here.publisher(topic), topic.name.encode(), one)
    assert {topic: one.payloads for topic, one in ears.items()} == {t: [t.name.encode()] for t in names}


def test_runs_and_robots_do_not_hear_each_other(mesh):
    here, neighbour, other_run, other_robot = (
        mesh.join(run=run, robot=robot) for run, robot in (("a", "r"), ("a", "r"), ("b", "r"), ("a", "s"))
    )
    strangers = [Ears(other_run), Ears(other_robot)]
    ears = [Ears(neighbour), Ears(other_run, any_run=True), Ears(other_robot, any_run=True)]
    tell(here.publisher(topics.STATUS), b"of run a", *ears)
    for stranger in strangers:
        assert stranger.payloads == []


def test_a_subscription_to_every_run_hears_its_own_too(mesh):
    here = mesh.join(run="a")
    tell(here.publisher(topics.STATUS), b"own", Ears(mesh.join(run="a"), any_run=True))


def test_a_message_that_nobody_wants_is_no_error(mesh):
    mesh.join().publisher(topics.STATUS).put(b"alone")


def test_whoever_subscribes_later_hears_only_what_comes_later(mesh):
    here, there = mesh.join(), mesh.join()
    publisher, early = here.publisher(topics.STATUS), Ears(there)
    tell(publisher, b"before", early)
    tell(publisher, b"between", early)  # on a connection nothing overtakes: `before` is over
    late = Ears(there)
    tell(publisher, b"after", late)
    assert b"before" not in late.payloads


def test_many_threads_may_put(mesh):
    here, there = mesh.join(), mesh.join()
    ears, publisher = Ears(there), here.publisher(topics.STATUS)
    threads = [threading.Thread(target=publisher.put, args=(b"%02d" % i,)) for i in range(40)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert here.bytes_sent[topics.STATUS.name] == 80
    tell(publisher, b"end", ears)
    arrived = ears.payloads[:-1]
    assert len(arrived) == len(set(arrived))
    assert set(arrived) <= {b"%02d" % i for i in range(40)}
    if isinstance(mesh, MemoryMesh):
        assert len(arrived) == 40


# ------------------------------------------------------------------ late joiners


def test_a_cached_message_reaches_whoever_subscribes_later(mesh):
    here, there = mesh.join(), mesh.join()
    publisher = here.publisher(topics.POLICY)
    for version in (b"1", b"2"):
        publisher.put(version)
    ears = Ears(there, topics.POLICY)
    ears.wait_for(b"2")
    assert ears.payloads[-1] == b"2"


def test_a_cached_message_reaches_whoever_joins_later(mesh):
    mesh.join().publisher(topics.POLICY).put(b"weights")
    for ears in [Ears(mesh.join(), topics.POLICY) for _ in range(2)]:
        ears.wait_for(b"weights")


def test_after_the_cached_message_a_late_joiner_gets_the_new_ones(mesh):
    publisher = mesh.join().publisher(topics.POLICY)
    publisher.put(b"1")
    ears = Ears(mesh.join(), topics.POLICY)
    ears.wait_for(b"1")
    publisher.put(b"2")
    ears.wait_for(b"2")
    assert ears.payloads == [b"1", b"2"]


def test_a_publisher_that_joins_later_is_heard(mesh):
    ears = Ears(mesh.join(), topics.POLICY)
    mesh.join().publisher(topics.POLICY).put(b"late")
    ears.wait_for(b"late")


def test_cached_messages_of_another_run_stay_there(mesh):
    mesh.join(run="a").publisher(topics.POLICY).put(b"a")
    ears = Ears(mesh.join(run="b"), topics.POLICY)
    mesh.join(run="b").publisher(topics.POLICY).put(b"b")
    ears.wait_for(b"b")
    assert ears.payloads == [b"b"]


def test_a_cached_message_is_gone_with_its_publisher(mesh):
    first, there = mesh.join(), mesh.join()
    first.publisher(topics.POLICY).put(b"old")
    Ears(there, topics.POLICY).wait_for(b"old")
    first.close()
    ears = Ears(there, topics.POLICY)
    mesh.join().publisher(topics.POLICY).put(b"new")
    ears.wait_for(b"new")
    assert ears.payloads == [b"new"]


# ------------------------------------------------------------------ queries


def answered(transport, topic=topics.SPEC, payload=b""):
    """Ask until someone answers."""
    replies = []

    def ask():
        replies.append(transport.query(topic, payload, timeout_s=TIMEOUT_S))
        return replies[-1] is not None

    eventually(ask, "an answer")
    return replies[-1]


def test_a_query_is_answered_with_what_its_payload_asks_for(mesh):
    here, there = mesh.join(), mesh.join()
    here.serve(topics.SPEC, lambda payload: b"answer to " + payload)
    assert answered(there, payload=b"this") == b"answer to this"
    assert answered(there) == b"answer to "
    assert answered(there, payload=bytes(500_000)) == b"answer to " + bytes(500_000)


def test_an_answer_may_be_empty(mesh):
    here, there = mesh.join(), mesh.join()
    here.serve(topics.SPEC, lambda payload: b"")
    assert answered(there) == b""


def test_a_service_can_ask_itself(mesh):
    here = mesh.join()
    here.serve(topics.SPEC, lambda payload: b"mine")
    assert answered(here) == b"mine"


def test_a_query_that_nobody_answers_gives_none(mesh):
    here, _ = mesh.join(), mesh.join()
    assert here.query(topics.SPEC, timeout_s=0.2) is None


def test_a_query_of_another_run_robot_or_service_is_not_answered(mesh):
    here, there = mesh.join(run="a"), mesh.join(run="a")
    strangers = [mesh.join(run="b"), mesh.join(run="a", robot="other")]
    actor, replay = topics.command_topic("actor"), topics.command_topic("replay")
    here.serve(actor, lambda payload: b"actor of a")
    assert answered(there, actor) == b"actor of a"  # so the others could have reached it
    assert there.query(replay, timeout_s=0.2) is None
    for stranger in strangers:
        assert stranger.query(actor, timeout_s=0.2) is None


def test_nobody_answers_for_who_has_left(mesh):
    here, there = mesh.join(), mesh.join()
    here.serve(topics.SPEC, lambda payload: b"here")
    assert answered(there) == b"here"
    here.close()
    eventually(lambda: there.query(topics.SPEC, timeout_s=0.2) is None, "silence")


# ------------------------------------------------------------------ counting


def test_payload_bytes_are_counted_by_topic_on_both_sides(mesh):
    here, there = mesh.join(), mesh.join()
    ears = {topic.name: Ears(there, topic) for topic in (topics.ACTION, topics.EXPERIENCE)}
    for topic, payload in ((topics.ACTION, b"x" * 10), (topics.EXPERIENCE, b"x" * 1000)):
        publisher = here.publisher(topic)
        for count in range(1, 4):
            publisher.put(payload)
            assert here.bytes_sent[topic.name] == count * len(payload)
        tell(publisher, payload, ears[topic.name])
        tell(publisher, b"end", ears[topic.name])  # what came before it has come
    assert dict(there.bytes_received) == {name: one.bytes for name, one in ears.items()}
    assert not there.bytes_sent
    assert not here.bytes_received


def test_what_nobody_hears_counts_as_sent_only(mesh):
    here, there = mesh.join(), mesh.join()
    here.publisher(topics.ACTION).put(b"12345")
    assert dict(here.bytes_sent) == {"action": 5}
    assert not there.bytes_received


def test_queries_are_not_counted(mesh):
    here, there = mesh.join(), mesh.join()
    here.serve(topics.SPEC, lambda payload: b"answer")
    assert answered(there, payload=b"question") == b"answer"
    assert [*here.bytes_sent, *here.bytes_received, *there.bytes_sent, *there.bytes_received] == []


# ------------------------------------------------------------------ leaving


def test_closing_twice_is_no_error(mesh):
    transport = mesh.join()
    transport.close()
    transport.close()


def test_a_put_after_closing_is_refused_by_name(mesh):
    transport = mesh.join()
    publishers = {topic: transport.publisher(topic) for topic in (topics.STATUS, topics.POLICY, topics.EXPERIENCE)}
    transport.close()
    for topic, publisher in publishers.items():
        with pytest.raises(TransportError, match=rf"put on relod/test/robot0/{topic.name}: .*closed"):
            publisher.put(b"too late")


def test_who_has_left_hears_nothing_and_the_others_go_on(mesh):
    here, leaver, stayer = mesh.join(), mesh.join(), mesh.join()
    gone, there, publisher = Ears(leaver), Ears(stayer), here.publisher(topics.STATUS)
    tell(publisher, b"before", gone, there)
    leaver.close()
    tell(publisher, b"after", there)
    assert gone.payloads == [b"before"]


# ------------------------------------------------------------------ Zenoh: endpoints


@pytest.mark.parametrize("lane", ["real_time", "bulk"])
def test_an_endpoint_in_use_is_named(opened, lane):
    taken, other = Endpoints(), Endpoints()
    opened(taken.settings())
    setattr(other, lane, getattr(taken, lane))
    with pytest.raises(EndpointInUseError, match=f"cannot listen on {getattr(taken, lane)}: another process listens"):
        opened(other.settings())
    freed = Endpoints()
    freed.real_time = other.real_time if lane == "bulk" else other.bulk
    opened(freed.settings())  # what the refused one had opened is free again


def test_one_endpoint_cannot_serve_both_lanes(opened):
    endpoints = Endpoints()
    endpoints.bulk = endpoints.real_time
    with pytest.raises(EndpointInUseError):
        opened(endpoints.settings())


@pytest.mark.parametrize(
    "endpoint",
    [
        "",
        "tcp",
        "127.0.0.1:7450",
        "udp/127.0.0.1:7450",
        "tcp/127.0.0.1",
        "tcp/127.0.0.1:",
        "tcp/127.0.0.1:0",
        "tcp/127.0.0.1:65536",
        "tcp/127.0.0.1:99999999",
        "tcp/127.0.0.1:-1",
        "tcp/127.0.0.1:http",
        "tcp/127.0.0.1:٧٤٥٠",
        "tcp/:7450",
        "tcp/a b:7450",
        "tcp/127.0.0.1:7450 ",
        "tcp/127.0.0.1:7450\n",
        "tcp/127.0.0.1:7450#iface=lo",
        "tcp/[::1:7450",
        '"]}',
    ],
)
def test_a_malformed_endpoint_is_named_whether_it_listens_or_connects(opened, endpoint):
    good = Endpoints()
    for settings in (
        TransportSettings(listen_real_time=endpoint, listen_bulk=good.bulk),
        TransportSettings(listen_real_time=good.real_time, listen_bulk=endpoint),
        TransportSettings(good.real_time, good.bulk, connect_real_time=[endpoint]),
        TransportSettings(good.real_time, good.bulk, connect_bulk=[good.bulk, endpoint]),
    ):
        with pytest.raises(TransportError, match="expected tcp/ADDRESS:PORT") as caught:
            opened(settings)
        assert repr(endpoint) in str(caught.value)


def test_an_address_of_another_computer_is_named(opened):
    endpoints = Endpoints()
    endpoints.real_time = f"tcp/192.0.2.1:{free_port()}"  # reserved for documentation
    with pytest.raises(TransportError, match=r"192.0.2.1:.*expected an address of this computer"):
        opened(endpoints.settings())


# ------------------------------------------------------------------ Zenoh: the mesh


def test_an_unreachable_peer_is_no_error_and_is_met_when_it_comes(opened):
    early, late = Endpoints(), Endpoints()
    here = opened(early.settings([late]))
    publisher = here.publisher(topics.STATUS)
    publisher.put(b"to nobody")
    assert here.query(topics.SPEC, timeout_s=0.1) is None
    tell(publisher, b"to somebody", Ears(opened(late.settings())))


def test_a_peer_that_comes_back_is_met_again(opened):
    here, there = Endpoints(), Endpoints()
    publisher = opened(here.settings([there])).publisher(topics.STATUS)
    for greeting in (b"first", b"second"):
        transport = opened(there.settings())
        tell(publisher, greeting, Ears(transport))
        transport.close()


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 2, 1, 0), (2, 0, 3, 1), (1, 3, 0, 2)], ids=str)
def test_four_services_meet_in_any_order_of_starting(opened, order):
    """Of each pair one connects, as in the launcher's files."""
    endpoints = [Endpoints() for _ in SERVICES]
    transports = {}
    for index in order:
        transports[index] = opened(endpoints[index].settings(endpoints[:index]))
    for topic in (topics.STATUS, topics.EXPERIENCE):  # one of each lane
        ears = [Ears(transport, topic) for transport in transports.values()]
        for index, transport in transports.items():
            tell(transport.publisher(topic), b"from %d" % index, *ears)


def test_peers_do_not_forward_for_each_other(opened):
    """Each pair is connected or does not hear each other: local traffic never takes a detour across a slow link."""
    left, middle, right = (Endpoints() for _ in range(3))
    transports = [opened(left.settings()), opened(middle.settings([left])), opened(right.settings([middle]))]
    ears = [Ears(transport) for transport in transports]
    tell(transports[1].publisher(topics.STATUS), b"from the middle", *ears)  # all are connected
    tell(transports[0].publisher(topics.STATUS), b"from the left", *ears[:2])
    tell(transports[1].publisher(topics.STATUS), b"end", *ears)
    assert ears[2].payloads == [b"from the middle", b"end"]


SLEEPER = """
import sys
import time
from common import topics
from common.run_settings import RunSettings, TransportSettings
from common.transport import ZenohTransport

transport = ZenohTransport(RunSettings("test", "unused"), TransportSettings(sys.argv[1], sys.argv[2]))
heard = []
for name in sys.argv[3:]:
    transport.subscribe(getattr(topics, name), lambda payload, name=name: heard.append(name))
while set(heard) < set(sys.argv[3:]):
    time.sleep(0.01)
print("listening", flush=True)
sys.stdin.read()
"""
LONGEST_PUT_S = 2.0
"""A put that waits for a peer (CongestionControl BLOCK) takes 5 s; one that does not takes about a millisecond."""


@pytest.mark.parametrize("present", [False, True], ids=["absent", "frozen"])
def test_a_put_never_waits_for_a_peer(opened, present):
    here, there = Endpoints(), Endpoints()
    transport = opened(here.settings([there]))
    names = ("TIME_STEP", "EXPERIENCE", "EXPERIENCE_RESENT", "STATUS")
    publishers = [transport.publisher(getattr(topics, name)) for name in names]
    command = [sys.executable, "-c", SLEEPER, there.real_time, there.bulk, *names]
    sleeper = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE) if present else None
    try:
        if sleeper:
            _let_it_listen(sleeper, publishers)
            sleeper.send_signal(signal.SIGSTOP)
        longest_s = 0.0
        for _ in range(200):
            for publisher in publishers:
                began = time.monotonic()
                publisher.put(bytes(50_000))
                longest_s = max(longest_s, time.monotonic() - began)
        assert longest_s < LONGEST_PUT_S
    finally:
        if sleeper:
            sleeper.kill()
            sleeper.communicate()


def _let_it_listen(sleeper, publishers):
    listening = threading.Event()

    def read():
        assert sleeper.stdout.readline() == b"listening\n"
        listening.set()

    reader = threading.Thread(target=read)
    reader.start()

    def heard():
        for publisher in publishers:
            publisher.put(b"are you there?")
        return listening.is_set()

    eventually(heard, "the other process")
    reader.join()
