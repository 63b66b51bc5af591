"""The record's bytes on the network: a payload crosses once for each listener on the other host."""

from collections import Counter

from common.topics import SERVICES
from deploy.placement import load_placement
from deploy.traffic import bytes_per_key, network_link, record_bytes
from tests.deploy.hand_made_record import network_part

SENT = {
    "robot_bridge": Counter({"timestep": 1000, "status": 10, "finished": 1}),
    "actor": Counter({"experience": 2000, "action": 100, "status": 10}),
    "replay": Counter({"minibatch/rows": 5000, "experience/ack": 7, "status": 10}),
    "learner": Counter({"policy": 300, "status": 10}),
}


def test_remote_only_carries_time_steps_up_and_actions_down() -> None:
    crossed = record_bytes(SENT, load_placement("remote_only").host)
    # Up: time steps to the actor; status and finished to three services. Down: actions, and status of three.
    assert crossed == {"uplink": 1000 + 3 * 10 + 3 * 1, "downlink": 100 + 3 * 10}


def test_remote_local_carries_experience_up_and_policies_down() -> None:
    crossed = record_bytes(SENT, load_placement("remote_local").host)
    # Up: experience to replay, status of two to two, finished to two. Down: policy, acknowledgements, status likewise.
    assert crossed == {"uplink": 2000 + 2 * 2 * 10 + 2 * 1, "downlink": 300 + 7 + 2 * 2 * 10}


def test_nothing_crosses_on_one_host() -> None:
    assert record_bytes(SENT, load_placement("local_only").host) == {"uplink": 0, "downlink": 0}


def test_bytes_per_key_are_of_all_services() -> None:
    assert bytes_per_key(SENT)["status"] == 40
    assert bytes_per_key(SENT)["policy"] == 300


def test_the_kernel_s_bytes_stand_beside_the_record_s() -> None:
    # The uplink is what the local host sent: 1033 by the record.
    part = network_part([], kernel={"local": (1100, 90), "remote": (260, 80)})
    table = network_link("namespaces", part, SENT, {}, load_placement("remote_only").host)
    assert table["uplink"] == {"kernel_bytes": 1100, "record_bytes": 1033, "ratio": 1.0649}
    assert table["downlink"] == {"kernel_bytes": 260, "record_bytes": 130, "ratio": 2.0}


def test_a_relay_has_no_kernel_bytes() -> None:
    table = network_link("relay", network_part([]), SENT, {}, load_placement("remote_only").host)
    assert table["uplink"] == {"kernel_bytes": None, "record_bytes": 1033, "ratio": None}


def test_a_link_without_traffic_has_no_ratio() -> None:
    nothing: dict[str, Counter[str]] = {service: Counter() for service in SERVICES}
    part = network_part([], kernel={"local": (0, 0), "remote": (0, 0)})
    assert network_link("namespaces", part, nothing, {}, load_placement("remote_only").host)["uplink"]["ratio"] is None


def test_what_came_to_each_host_shows_which_keys_have_crossed() -> None:
    received = {
        "robot_bridge": Counter({"status": 30}),
        "actor": Counter({"timestep": 1000, "status": 30, "policy": 300}),
        "replay": Counter({"experience": 2000, "status": 30}),
        "learner": Counter({"status": 30}),
    }
    part = network_part([], kernel={"local": (1100, 90), "remote": (260, 80)})
    table = network_link("namespaces", part, SENT, received, load_placement("remote_local").host)
    assert table["received"] == {
        "local": {"policy": 300, "status": 60, "timestep": 1000},
        "remote": {"experience": 2000, "status": 60},
    }
