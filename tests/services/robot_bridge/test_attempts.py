"""Attempts, episodes, resets, and how a run begins and ends. Cycles last 40 ms."""

import itertools

import pytest

from common import topics
from common.messages import ActionSource
from services.robot_bridge.bookkeeping import Totals
from tests.services.robot_bridge.scripted import Scene


def scene_of(tmp_path, goal_cycles=(), answers=0.01, totals=None, steps=7000, settings=None, **task):
    return Scene(tmp_path, answers, {"goal_cycles": goal_cycles, **task}, totals, steps=steps, **(settings or {}))


def test_the_thesis_example_of_three_time_outs_and_a_goal(tmp_path):
    scene = scene_of(tmp_path, {325}, answers=0.0, time_limit=100, reset_steps=20, pacing="lockstep", steps=386)
    time_steps = scene.run()
    (episode,) = scene.service.record.tables["episodes"]
    assert (episode["return"], episode["length"], episode["attempts"]) == (-385.0, 385, 4)
    assert (episode["episode"], episode["steps"], episode["acted_steps"]) == (0, 385, 325)
    assert episode["experience_time_s"] == pytest.approx(385 * 0.04)
    # Resets are in no transition: 325 cycles, the first of 4 attempts, one probe, then the next episode.
    of_the_episode = [t for t in time_steps if t.episode == 0]
    assert len(of_the_episode) == 325 + 4 + 1
    assert all(t.reward == -1.0 for t in of_the_episode if not t.is_first)
    assert [t.seq for t in of_the_episode if t.truncated] == [101, 202, 303]
    (goal,) = [t for t in time_steps if t.terminated]
    assert (goal.steps, goal.acted_steps, goal.episode) == (385, 325, 0)
    assert scene.bridge.counters()["last_return"] == -385.0


def test_a_time_out_truncates_and_keeps_the_goal(tmp_path):
    scene = scene_of(tmp_path, time_limit=3, reset_steps=2, steps=9)
    time_steps = scene.run()
    assert [(t.step_index, t.truncated, t.terminated) for t in time_steps[1:5]] == [
        (0, False, False),
        (1, False, False),
        (2, False, False),
        (3, True, False),
    ]
    assert time_steps[5].is_first
    assert (time_steps[5].episode, time_steps[5].attempt) == (0, time_steps[4].attempt + 1)
    begun = [entry[0] for entry in scene.task.log if entry[0].startswith("begin")]
    assert begun == ["begin_episode", "begin_attempt"]


def test_a_goal_ends_the_episode_without_a_reset_and_draws_a_new_goal(tmp_path):
    scene = scene_of(tmp_path, {2}, time_limit=50, reset_steps=10, steps=4)
    time_steps = scene.run()
    goal, first = time_steps[3], time_steps[4]
    assert (goal.terminated, goal.truncated, goal.episode) == (True, False, 0)
    assert (first.is_first, first.episode, first.attempt) == (True, 1, goal.attempt + 1)
    assert scene.published_s[3:5] == [0.08, 0.08]
    assert scene.task.times("begin_episode") == [0.0, 0.08]


def test_a_reset_lasts_its_steps_in_real_time_with_the_robot_stopped(tmp_path):
    scene = scene_of(tmp_path, time_limit=2, reset_steps=5, steps=9)
    time_steps = scene.run()
    assert time_steps[3].truncated
    assert scene.published_s[3] == 0.08
    assert scene.published_s[4] == pytest.approx(0.08 + 5 * 0.04)
    assert (time_steps[4].steps, time_steps[4].acted_steps) == (7, 2)
    assert (time_steps[4].reward, time_steps[4].action_source) == (0.0, ActionSource.NONE)
    assert 0.08 in scene.task.times("stop")
    assert [at for at in scene.task.times("command") if 0.08 < at < 0.28] == []
    assert scene.counts.cycles == 9


def test_actions_that_come_during_a_reset_answer_what_is_over(tmp_path):
    scene = scene_of(tmp_path, answers=0.05, time_limit=2, reset_steps=5, steps=9)
    scene.run()
    # Numbers 1 and 2 were answered after 50 and 90 ms; the attempt ended at 80 ms.
    assert [at for at in scene.task.times("command") if 0.08 <= at < 0.28] == []
    assert scene.counts.refused_actions == 1


def test_deadlines_go_on_through_attempts_and_resets(tmp_path):
    scene = scene_of(tmp_path, {4, 9, 10}, time_limit=6, reset_steps=3, steps=100)
    scene.run()
    ticks = [at / 0.04 for at in scene.published_s]
    assert ticks == pytest.approx([round(tick) for tick in ticks])
    assert scene.counts.overruns == 0


def test_without_a_goal_every_attempt_is_an_episode(tmp_path):
    scene = scene_of(tmp_path, time_limit=4, reset_steps=3, has_goal=False, steps=14)
    scene.run()
    rows = scene.service.record.tables["episodes"]
    assert [(r["return"], r["length"], r["attempts"], r["steps"]) for r in rows] == [(-4, 4, 1, 4), (-4, 4, 1, 11)]
    assert len(scene.task.times("begin_episode")) == 2  # a new goal each time; the run ended in the last reset
    assert scene.bridge.counters()["steps"] == 14


def test_the_run_ends_with_its_steps_in_the_middle_of_an_attempt(tmp_path):
    scene = scene_of(tmp_path, time_limit=50, steps=5)
    time_steps = scene.run()
    assert time_steps[-1].steps == 5
    assert not time_steps[-1].is_last
    (finished,) = scene.finished
    assert (finished.produced, finished.reason) == (7, "steps")
    assert scene.task.log[-1][0] == "close"


def test_the_run_ends_with_its_steps_in_the_middle_of_a_reset(tmp_path):
    scene = scene_of(tmp_path, time_limit=3, reset_steps=10, steps=7)
    assert scene.run()[-1].truncated
    assert scene.bridge.counters()["steps"] == 7


def test_a_restarted_bridge_does_the_steps_that_are_left(tmp_path):
    scene = scene_of(tmp_path, totals=Totals(steps=95, acted_steps=90, episodes=3, attempts=6), steps=100)
    time_steps = scene.run()
    assert (time_steps[0].attempt, time_steps[0].episode, time_steps[0].steps) == (6, 3, 95)
    assert (time_steps[-1].steps, time_steps[-1].acted_steps) == (100, 95)
    assert time_steps[0].seq == 0  # numbers start again: it is another incarnation


def test_a_run_whose_steps_are_done_ends_at_once(tmp_path):
    scene = scene_of(tmp_path, totals=Totals(steps=100, attempts=3), steps=100)
    assert scene.run() == []
    assert scene.finished[0].produced == 0


def test_no_time_step_is_published_before_actor_and_replay_are_there(tmp_path):
    scene = scene_of(tmp_path, steps=1)
    scene.service.peers = {}
    states = [(0.5, topics.ACTOR, "starting"), (1.0, topics.ACTOR, "running"), (2.0, topics.REPLAY, "running")]
    for at, peer, state in states:
        scene.clock.at(at, lambda peer=peer, state=state: scene.service.peers.update({peer: state}))
    scene.run()
    assert 2.0 <= scene.published_s[0] <= 2.1


def test_no_attempt_starts_before_a_first_answer_came(tmp_path):
    scene = scene_of(tmp_path, steps=2, settings={"stop_after": 0.5})
    scene.probe_answer = None
    scene.answers = lambda t: None if scene.clock.seconds < 1.2 else 0.02
    time_steps = scene.run()
    # One TimeStep every 0.5 s until one is answered; each is an attempt of its own, so no transition comes of it.
    assert scene.published_s[:5] == pytest.approx([0.0, 0.5, 1.0, 1.5, 1.52])
    assert all(t.is_first for t in time_steps[:5])
    assert len({t.attempt for t in time_steps[:5]}) == 5
    assert (time_steps[4].steps, time_steps[4].acted_steps) == (0, 0)
    assert scene.published_s[5:] == pytest.approx([1.56, 1.6])
    assert scene.counts.cycles == 2


def test_what_nobody_answers_is_asked_ever_more_seldom(tmp_path):
    scene = scene_of(tmp_path, steps=1, settings={"stop_after": 0.5})
    scene.probe_answer = None
    scene.answers = lambda t: None if scene.clock.seconds < 30 else 0.02
    scene.run()
    asked_s = [0, 0.5, 1, 1.5, 2, 3, 5, 9, 17, 25, 33]
    assert scene.published_s[: len(asked_s)] == pytest.approx(asked_s, abs=0.3)
    answered_s, begun_s = scene.published_s[len(asked_s) - 1 :][:2]
    assert begun_s - answered_s == pytest.approx(0.02)
    assert scene.bridge.details()["unanswered_first_observations"] == 10


def test_who_has_been_missing_is_asked_at_once_and_often(tmp_path):
    scene = scene_of(tmp_path, steps=1, settings={"stop_after": 0.5})
    scene.probe_answer = None
    scene.answers = lambda t: None if scene.clock.seconds < 8 else 0.02
    scene.clock.at(6.0, lambda: scene.service.peers.pop(topics.ACTOR))  # between the observations of 5 and 9 s
    scene.clock.at(7.0, lambda: scene.service.peers.update({topics.ACTOR: "running"}))
    scene.run()
    back_s = next(at for at in scene.published_s if at > 6)
    assert 7.0 <= back_s <= 7.1
    assert [at for at in scene.published_s if at > 7.2][:2] == pytest.approx([back_s + 0.5, back_s + 1.0])


def test_a_pause_between_two_first_observations_is_noticed_and_counts_as_none(tmp_path):
    scene = scene_of(tmp_path, steps=1, settings={"stop_after": 0.5})
    scene.probe_answer = None
    scene.answers = lambda t: None if scene.clock.seconds < 7 else 0.02
    seen = []
    scene.clock.at(5.2, lambda: scene.command("pause"))  # while the observation of 5 s is waited for
    scene.clock.at(6.9, lambda: seen.append(scene.bridge.details()["waits_for"]))
    scene.clock.at(7.0, lambda: scene.command("resume"))
    scene.run()
    assert seen == ["resume"]
    assert 7.0 <= next(at for at in scene.published_s if at > 5.2) <= 7.1
    assert scene.bridge.details()["unanswered_first_observations"] == 6


def test_an_attempt_begins_when_the_robot_has_been_placed(tmp_path):
    scene = scene_of(tmp_path, steps=3)
    place = scene.task.begin_episode

    def place_slowly():
        scene.clock.sleep(3.0)
        place()

    scene.task.begin_episode = place_slowly
    scene.run()
    # The one that asks for a first answer; then whole cycles.
    assert scene.published_s == pytest.approx([0.0, 3.0, 3.04, 3.08, 3.12])
    assert (scene.counts.cycles, scene.counts.overruns, scene.counts.skipped_cycles) == (3, 1, 74)
    assert scene.counts.unanswered == 0


def test_who_is_asked_to_stop_while_the_robot_is_placed_publishes_no_start(tmp_path):
    scene = scene_of(tmp_path, steps=5)
    assert scene.service.on_stop == scene.task.give_up  # which lets a placement return at once
    place = scene.task.begin_episode

    def stop_meanwhile():
        scene.service.stop("SIGINT")
        place()

    scene.task.begin_episode = stop_meanwhile
    time_steps = scene.run()
    assert [step.seq for step in time_steps] == [0]  # the one that asks for a first answer


def test_probes_do_not_count_as_attempts_of_the_episode(tmp_path):
    scene = scene_of(tmp_path, {3}, steps=4)
    scene.probe_answer = None
    scene.answers = lambda t: 0.01 if t.seq >= 2 else None
    scene.run()
    assert scene.service.record.tables["episodes"][0]["attempts"] == 1


def test_the_robot_stands_still_until_the_first_answer_has_come(tmp_path):
    scene = scene_of(tmp_path, steps=1)
    scene.run()
    names = [entry[0] for entry in scene.task.log]
    assert names[:2] == ["stop", "begin_episode"]


def test_a_peer_that_is_gone_for_long_holds_the_next_attempt_back(tmp_path):
    scene = scene_of(tmp_path, time_limit=5, steps=10, settings={"peer_grace": 3.0})
    scene.clock.at(0.05, lambda: scene.service.ages_s.update({topics.REPLAY: 3.5}))
    scene.clock.at(0.06, lambda: scene.service.peers.pop(topics.REPLAY))
    scene.clock.at(9.0, lambda: scene.service.peers.update({topics.REPLAY: "running"}))
    scene.clock.at(9.0, scene.service.ages_s.clear)
    time_steps = scene.run()
    # The running attempt goes on to its end; then there is a new probe before the next one.
    assert [t.step_index for t in time_steps] == [0, 0, 1, 2, 3, 4, 5, 0, 0, 1, 2, 3, 4, 5]
    assert scene.published_s[6] == 0.2
    assert all(at >= 9.0 for at in scene.published_s[7:])
    assert scene.counts.overruns == 0


def test_a_peer_that_is_gone_for_a_moment_holds_nothing_back(tmp_path):
    scene = scene_of(tmp_path, time_limit=5, steps=10, settings={"peer_grace": 3.0})
    scene.clock.at(0.05, lambda: scene.service.ages_s.update({topics.REPLAY: 2.5}))
    scene.run()
    assert scene.published_s[7] == pytest.approx(0.2)


def test_the_counts_agree_with_what_was_published(tmp_path):
    scene = scene_of(tmp_path, {7, 30}, time_limit=10, reset_steps=4, steps=60)
    time_steps = scene.run()
    counters = scene.bridge.counters()
    assert counters["produced"] == len(time_steps)
    assert counters["steps"] == counters["cycles"] == 60
    assert counters["acted_steps"] == len([t for t in time_steps if not t.is_first])
    assert counters["attempts"] == len([t for t in time_steps if t.is_first])
    assert counters["episodes"] == 2
    assert counters["unacknowledged"] == counters["given_up"] == 0
    assert scene.bridge.details()["steps_total"] == 60


def test_an_attempt_is_one_unbroken_count(tmp_path):
    scene = scene_of(tmp_path, {7, 30}, time_limit=10, reset_steps=4, steps=200)
    time_steps = scene.run()
    for before, after in itertools.pairwise(time_steps):
        assert after.seq == before.seq + 1
        if after.is_first:
            assert after.attempt == before.attempt + 1
        else:
            assert (after.attempt, after.episode) == (before.attempt, before.episode)
            assert after.step_index == before.step_index + 1
            assert not before.is_last
