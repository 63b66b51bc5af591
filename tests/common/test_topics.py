"""The table of topics is complete and agrees with itself."""

from collections import Counter

import pytest

from common import messages, topics
from common.messages import MESSAGES, Acknowledgement, CommandReply, StreamHead, TaskSpec
from common.topics import SERVICES, TOPICS, Delivery, Lane, Topic, command_topic

every_topic = pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)


def test_every_message_is_on_a_topic():
    carried = {topic.message for topic in TOPICS} | {command_topic("actor").message}
    assert carried == set(MESSAGES) - {messages.Command}  # a Command is what the command query asks


def test_every_topic_of_the_module_is_in_the_table():
    assert {topic.name for topic in vars(topics).values() if isinstance(topic, Topic)} == {t.name for t in TOPICS}


def test_keys_are_unique():
    every = [*TOPICS, *(command_topic(name) for name in SERVICES)]
    assert [key for key, count in Counter(t.key("run", "robot0") for t in every).items() if count > 1] == []


@every_topic
def test_a_key_says_run_robot_and_topic(topic):
    assert topic.key("run-1", "robot0") == f"relod/run-1/robot0/{topic.name}"


@every_topic
def test_runs_and_robots_have_keys_of_their_own(topic):
    assert len({topic.key(run, robot) for run in ("a", "b") for robot in ("r", "s")}) == 4


@every_topic
def test_a_key_is_a_plain_key_expression(topic):
    assert all(part.replace("_", "").isalnum() for part in topic.name.split("/"))


@every_topic
def test_a_topic_goes_from_services_to_services(topic):
    assert topic.publishers
    assert topic.subscribers
    assert set(topic.publishers) | set(topic.subscribers) <= set(SERVICES)


def test_the_ring_is_closed():
    """Each service hands something on to the next one, and the last to the first."""
    for sender, receiver in (
        ("robot_bridge", "actor"),
        ("actor", "replay"),
        ("replay", "learner"),
        ("learner", "actor"),
        ("actor", "robot_bridge"),
    ):
        assert any(sender in t.publishers and receiver in t.subscribers for t in TOPICS), (sender, receiver)


@pytest.mark.parametrize("stream", [topics.TIME_STEP, topics.EXPERIENCE], ids=lambda topic: topic.name)
def test_a_journalled_stream_has_repairs_heads_and_acknowledgements(stream):
    named = {topic.name: topic for topic in TOPICS}
    resent, head, ack = (named[f"{stream.name}/{name}"] for name in ("resent", "head", "ack"))
    assert (resent.message, head.message, ack.message) == (stream.message, StreamHead, Acknowledgement)
    assert resent.publishers == head.publishers == ack.subscribers == stream.publishers
    assert resent.subscribers == head.subscribers == ack.publishers == stream.subscribers
    assert resent.lane is Lane.BULK
    assert head.lane is ack.lane is Lane.REAL_TIME


def test_only_the_action_cycle_is_urgent():
    assert [topic for topic in TOPICS if topic.urgent] == [topics.TIME_STEP, topics.ACTION]
    assert all(topic.lane is Lane.REAL_TIME for topic in TOPICS if topic.urgent)


def test_the_policy_reaches_late_joiners():
    assert [topic for topic in TOPICS if topic.delivery is Delivery.CACHED] == [topics.POLICY]


def test_the_specification_is_asked_for():
    assert topics.SPEC.delivery is Delivery.QUERY
    assert topics.SPEC.message is TaskSpec


@pytest.mark.parametrize("service", SERVICES)
def test_every_service_takes_commands(service):
    topic = command_topic(service)
    assert topic.key("run", "robot0") == f"relod/run/robot0/command/{service}"
    assert topic.publishers == (service,)
    assert topic.message is CommandReply
    assert topic.delivery is Delivery.QUERY
