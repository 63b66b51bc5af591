"""From a request to four configurations: endpoints, routing of overrides, what follows from the network."""

from collections import Counter
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from common.config import build_config, to_tables
from common.errors import ConfigError
from common.topics import SERVICES, Lane
from deploy.hosts import Host as Computer
from deploy.network import PRESETS, Crossing, Direction, Host, NetworkPart, NoLink
from deploy.placement import load_placement
from deploy.plan import CONFIG_CLASSES, PORTS, PortMap, RunRequest, crossings, plan_run, split_overrides

MODES = ("local_only", "remote_local", "remote_only")
PORT_MAP = PortMap(range(7450, 7450 + PORTS))


class TwoAddressLink(NoLink):
    """Every host has an address, and remembers what was dialled."""

    def __init__(self) -> None:
        self.dialled: list[tuple[Host, Host, int]] = []

    def listen_address(self, host: Host) -> str:
        return {"local": "10.0.0.1", "remote": "10.0.0.2"}[host]

    def dial_address(self, from_host: Host, to_host: Host, port: int) -> tuple[str, int]:
        self.dialled.append((from_host, to_host, port))
        return self.listen_address(to_host), port + (1000 if from_host != to_host else 0)

    def kernel_bytes(self) -> dict[Direction, int] | None:
        return None

    def part(self) -> NetworkPart | None:
        return None


def plan(mode: str = "local_only", network: str | None = None, **request: Any) -> dict[str, Any]:
    values = {"task": "dot_reacher", "algorithm": "sac", "run_id": "run1", "run_dir": Path("/run/dir"), **request}
    conditions = PRESETS[network] if network else None
    return plan_run(RunRequest(load_placement(mode), **values), PORT_MAP, TwoAddressLink(), conditions)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("lane", ["real_time", "bulk"])
def test_every_pair_of_services_is_connected_once_on_each_lane(mode: str, lane: str) -> None:
    configurations = plan(mode)
    port_of = {
        service: int(getattr(configuration.transport, f"listen_{lane}").rpartition(":")[2])
        for service, configuration in configurations.items()
    }
    assert len(set(port_of.values())) == len(SERVICES)
    service_at = {port: service for service, port in port_of.items()}
    pairs: Counter[frozenset[str]] = Counter()
    for service, configuration in configurations.items():
        for endpoint in getattr(configuration.transport, f"connect_{lane}"):
            port = int(endpoint.rpartition(":")[2])
            pairs[frozenset({service, service_at.get(port) or service_at[port - 1000]})] += 1
    assert pairs == Counter(frozenset(pair) for pair in combinations(SERVICES, 2))


def test_lanes_have_ports_of_their_own() -> None:
    listening = [
        endpoint
        for configuration in plan().values()
        for endpoint in (configuration.transport.listen_real_time, configuration.transport.listen_bulk)
    ]
    assert len(set(listening)) == PORTS


def test_services_listen_on_their_host_and_dial_through_the_link() -> None:
    transport = plan("remote_local")["replay"].transport
    assert transport.listen_real_time.startswith("tcp/10.0.0.2:")
    bridge_port, actor_port = PORT_MAP.port("robot_bridge", Lane.REAL_TIME), PORT_MAP.port("actor", Lane.REAL_TIME)
    assert transport.connect_real_time == [f"tcp/10.0.0.1:{bridge_port + 1000}", f"tcp/10.0.0.1:{actor_port + 1000}"]
    on_one_host = plan("remote_local")["learner"].transport.connect_bulk[-1]
    assert on_one_host == f"tcp/10.0.0.2:{PORT_MAP.port('replay', Lane.BULK)}"


@pytest.mark.parametrize(("mode", "count"), [("local_only", 0), ("remote_local", 8), ("remote_only", 6)])
def test_crossings_are_the_connections_between_the_hosts(mode: str, count: int) -> None:
    link = TwoAddressLink()
    placement = load_placement(mode)
    request = RunRequest(placement, "dot_reacher", "sac", "run1", Path("/run/dir"))
    plan_run(request, PORT_MAP, link, None)
    dialled = {Crossing(*way) for way in link.dialled if way[0] != way[1]}
    needed = crossings(placement, PORT_MAP)
    assert set(needed) == dialled
    assert sum(way[0] != way[1] for way in link.dialled) == len(needed) == count


def test_the_request_reaches_the_services_that_it_concerns() -> None:
    configurations = plan(steps=123, seed=7, pacing="lockstep")
    assert {configuration.run.seed for configuration in configurations.values()} == {7}
    assert {configuration.run.id for configuration in configurations.values()} == {"run1"}
    assert {configuration.run.directory for configuration in configurations.values()} == {"/run/dir"}
    bridge = configurations["robot_bridge"]
    assert (bridge.task.name, bridge.robot_bridge.steps, bridge.robot_bridge.pacing) == ("dot_reacher", 123, "lockstep")
    assert {configurations[name].algorithm.name for name in ("actor", "replay", "learner")} == {"sac"}


def test_an_override_goes_to_every_service_that_has_the_section() -> None:
    configurations = plan(overrides=("algorithm.batch_size=32", "actor.threads=2", "transport.socket_buffer_kib=64"))
    for name in ("actor", "replay", "learner"):
        assert configurations[name].algorithm.overrides == {"batch_size": 32}
    assert configurations["actor"].actor.threads == 2
    assert {configuration.transport.socket_buffer_kib for configuration in configurations.values()} == {64}


def test_an_override_wins_over_an_option() -> None:
    assert plan(steps=5, overrides=("robot_bridge.steps=9",))["robot_bridge"].robot_bridge.steps == 9


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("actr.threads=2", r"no service has a section \[actr\]; did you mean 'actor'"),
        ("actor.thread=2", r"unknown key 'thread'; did you mean 'threads'"),
        ("actor.threads=0", r"threads = 0: expected a value from 1 to 64"),
        ("run.directory=/elsewhere", "use --run-dir"),
        ("transport.listen_bulk=tcp/127.0.0.1:1", "--base-port"),
        ("threads=2", "expected section.key=value"),
        ("algorithm.batch_siz=12", r"\[algorithm\]: sac: unknown setting 'batch_siz'"),
        ("algorithm.batch_size=abc", r"\[algorithm\]: batch_size = 'abc': expected int"),
        ("algorithm.batch_size=0", r"\[algorithm\]: batch_size = 0: expected an integer >= 1"),
        ("algorithm.preset=nope", r"\[algorithm\]: unknown preset 'nope' of sac; known: "),
    ],
)
def test_a_wrong_override_is_refused_by_name(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        plan(overrides=(override,))


def test_network_overrides_are_set_apart() -> None:
    others, network = split_overrides(["actor.threads=2", "network.loss=0.1", "network.uplink.rate_mbit=5"])
    assert others == ["actor.threads=2"]
    assert network == {"loss": 0.1, "uplink.rate_mbit": 5}


def test_replay_is_mapped_only_where_the_learner_is_on_its_host(tmp_path: Path) -> None:
    path = tmp_path / "split.toml"
    path.write_text('[services]\nrobot_bridge="local"\nactor="local"\nreplay="local"\nlearner="remote"\n')
    for mode, access in (("local_only", "map"), ("remote_only", "map"), (str(path), "arrays")):
        configurations = plan(mode)
        assert configurations["replay"].replay.access == configurations["learner"].learner.access == access


def test_both_ends_of_replay_must_agree(tmp_path: Path) -> None:
    both = plan(overrides=("replay.access=arrays", "learner.access=arrays"))
    assert both["learner"].learner.access == "arrays"
    with pytest.raises(ConfigError, match="expected the same"):
        plan(overrides=("replay.access=arrays",))
    path = tmp_path / "split.toml"
    path.write_text('[services]\nrobot_bridge="local"\nactor="local"\nreplay="local"\nlearner="remote"\n')
    with pytest.raises(ConfigError, match="can be mapped on one host only"):
        plan(str(path), overrides=("replay.access=map", "learner.access=map"))


def test_a_limited_network_makes_buffers_small_and_repairs_slow() -> None:
    default_pace = plan()["actor"].actor.resend_kib_per_s
    remote_local, remote_only = plan("remote_local", "wifi_office"), plan("remote_only", "wifi_office")
    # 20 % of 40 Mbit/s = 1e6 bytes/s, where the stream crosses the network.
    assert remote_local["actor"].actor.resend_kib_per_s == pytest.approx(1e6 / 1024)
    assert remote_local["robot_bridge"].robot_bridge.resend_kib_per_s == default_pace
    assert remote_only["robot_bridge"].robot_bridge.resend_kib_per_s == pytest.approx(1e6 / 1024)
    assert remote_only["actor"].actor.resend_kib_per_s == default_pace
    assert {c.transport.socket_buffer_kib for c in remote_local.values()} == {128}
    unlimited = plan("remote_local", "ideal")
    assert {c.transport.socket_buffer_kib for c in unlimited.values()} == {0}
    assert unlimited["actor"].actor.resend_kib_per_s == default_pace


@pytest.mark.parametrize("mode", MODES)
def test_shared_memory_is_off_and_nobody_knows_the_mode(mode: str) -> None:
    for configuration in plan(mode).values():
        assert configuration.transport.shared_memory is False
        assert "mode" not in {key for table in to_tables(configuration).values() for key in table}


def test_written_tables_are_read_back_equal() -> None:
    for service, configuration in plan("remote_only", "outage").items():
        assert build_config(CONFIG_CLASSES[service], to_tables(configuration), "test") == configuration


@pytest.mark.parametrize(
    ("request_values", "message"),
    [
        ({"task": "dot_recher"}, "--task dot_recher: expected one of .*did you mean 'dot_reacher'"),
        ({"algorithm": "sacc"}, "--algorithm sacc: expected one of sac"),
        ({"steps": 0}, "steps = 0: expected at least 1"),
        ({"seed": -1}, "seed = -1"),
        ({"run_id": "a/b"}, "id = 'a/b'"),
    ],
)
def test_a_wrong_request_is_refused_by_name(request_values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        plan(**request_values)


def test_a_task_of_the_user_s_own_table_is_known() -> None:
    configurations = plan(task="mine", overrides=("tasks.mine=my_module:MyTask",))
    assert configurations["robot_bridge"].tasks.rows == {"mine": "my_module:MyTask"}


BOARD = Computer("board", device="cpu", threads=3, inference_s=0.012, updates_per_step=0.25, replay_capacity=5000)


def test_the_learner_s_computer_becomes_plain_settings() -> None:
    configurations = plan(learner_host=BOARD)
    for name in ("actor", "replay", "learner"):
        assert configurations[name].algorithm.overrides == {"replay_ratio": 0.25, "replay_capacity": 5000}
    assert (configurations["learner"].learner.device, configurations["learner"].learner.threads) == ("cpu", 3)
    assert configurations["actor"].actor.min_inference_s == 0.012


@pytest.mark.parametrize(
    ("mode", "inference_s"), [("local_only", 0.012), ("remote_only", 0.012), ("remote_local", 0.0)]
)
def test_actions_take_as_long_as_on_the_learner_s_computer_only_where_they_are_computed_there(
    mode: str, inference_s: float
) -> None:
    assert plan(mode, learner_host=BOARD)["actor"].actor.min_inference_s == inference_s


def test_an_override_wins_over_the_learner_s_computer() -> None:
    configurations = plan(learner_host=BOARD, overrides=("algorithm.replay_ratio=2.0", "learner.threads=1"))
    assert configurations["replay"].algorithm.overrides["replay_ratio"] == 2.0
    assert configurations["replay"].algorithm.overrides["replay_capacity"] == 5000
    assert configurations["learner"].learner.threads == 1
