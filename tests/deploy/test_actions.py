"""How long answers took, and how soon they came again after an outage."""

from pathlib import Path

import pytest

from deploy.actions import ArrivedActions, OutageEnd, last_published_ns, outage_ends
from tests.deploy.hand_made_record import SECOND_NS, network_part, write_actions


def read(run_dir: Path, times_s: list[tuple[float, float]]) -> ArrivedActions:
    write_actions(run_dir, times_s)
    actions = ArrivedActions.read(run_dir)
    assert actions is not None
    return actions


def test_delays_run_from_publication_to_arrival(tmp_path: Path) -> None:
    # Delays of 1 to 101 ms: the median is 51, the 99th percentile 100.
    actions = read(tmp_path, [(second, second + ms / 1000) for second, ms in enumerate(range(1, 102))])
    assert actions.observation_to_action_ms() == {"p50": 51.0, "p99": 100.0}


def test_without_actions_there_is_no_delay(tmp_path: Path) -> None:
    assert ArrivedActions.read(tmp_path) is None
    assert read(tmp_path, []).observation_to_action_ms() is None


def test_torn_rows_are_counted(tmp_path: Path) -> None:
    write_actions(tmp_path, [(1.0, 1.5)])
    with (tmp_path / "actions.csv").open("a", encoding="utf-8") as file:
        file.write("100,1,2000\n")
    actions = ArrivedActions.read(tmp_path)
    assert actions is not None
    assert (len(actions.arrived_ns), actions.unreadable) == (1, 1)


def test_after_an_outage_only_an_answer_to_a_fresh_observation_counts(tmp_path: Path) -> None:
    # The outage ends at 21 s. An answer to an observation of 20.9 s arrives at 21.1 s, one to 21.25 s at 21.75 s.
    actions = read(tmp_path, [(10.0, 10.1), (20.9, 21.1), (21.25, 21.75), (21.3, 21.8), (30.0, 30.1)])
    ends = outage_ends(actions, network_part([(20.0, 21.0)], start_s=1.0), 30 * SECOND_NS)
    assert ends == [OutageEnd(end_s=20.0, first_action_s=0.75)]


def test_an_observation_taken_at_link_up_is_fresh(tmp_path: Path) -> None:
    actions = read(tmp_path, [(1.0, 1.1), (21.0, 21.5), (30.0, 30.1)])
    assert outage_ends(actions, network_part([(20.0, 21.0)]), 30 * SECOND_NS)[0].first_action_s == 0.5


def test_outages_outside_of_the_run_are_left_out(tmp_path: Path) -> None:
    actions = read(tmp_path, [(25.0, 25.1), (45.0, 45.1)])
    outages = network_part([(20.0, 21.0), (40.0, 41.0), (60.0, 61.0)])
    assert [end.end_s for end in outage_ends(actions, outages, 45 * SECOND_NS)] == [41.0]


def test_an_outage_that_no_answer_followed_has_none(tmp_path: Path) -> None:
    actions = read(tmp_path, [(10.0, 10.1)])
    # Time steps were published until 23 s, as the ring shows, and none was answered after the outage.
    last_ns = last_published_ns(actions, 23 * SECOND_NS)
    assert outage_ends(actions, network_part([(20.0, 21.0)]), last_ns) == [OutageEnd(21.0, None)]


@pytest.mark.parametrize("persisted_ns", [0, 5])
def test_the_last_publication_is_0_where_nothing_is_known(tmp_path: Path, persisted_ns: int) -> None:
    assert last_published_ns(read(tmp_path, []), persisted_ns) == persisted_ns
