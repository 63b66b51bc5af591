"""The tables of what is run."""

from dataclasses import asdict, replace
from pathlib import Path

import pytest

from common.topics import ACTOR, LEARNER, REPLAY
from deploy.hosts import load_host
from experiments.distribution.configurations import PPO, QUESTIONS, SAC, SAC_PENDING
from experiments.distribution.jobs import training_of
from experiments.distribution.sizes import PPO_ONLY, SIZES, SMALL, THESIS
from experiments.training import plan_training

CONFIGURATIONS = {
    (panel.task, configuration.name): (panel, configuration)
    for size in SIZES.values()
    for panel in size.panels
    for configuration in panel.configurations
}


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_no_run_measures_this_computer(monkeypatch, name):
    def refuse(*arguments):
        raise AssertionError("a run of the study depends on the speed of this computer")

    monkeypatch.setattr("experiments.virtual_costs._measured_once", refuse)
    panel, configuration = CONFIGURATIONS[name]
    training = training_of(panel.job(configuration, 0), asdict(configuration), Path("runs"))
    configurations = plan_training(training).with_computing_times().configurations
    assert configurations[ACTOR].actor.min_inference_s > 0
    assert configurations[LEARNER].learner.min_update_s > 0
    assert configurations[LEARNER].learner.threads == 1  # as many on every computer


def test_the_actor_of_remote_local_is_as_slow_as_the_laptop_s():
    for configuration in (*SAC, *PPO):
        if configuration.mode == "remote_local":
            assert f"actor.min_inference_s={load_host('laptop').inference_s}" in configuration.overrides


def test_questions_are_about_configurations_that_are_run_in_one_panel():
    run = (*SMALL.panels, *PPO_ONLY.panels)
    panels = [{configuration.name for configuration in panel.configurations} for panel in run]
    for question in QUESTIONS:
        assert any({question.configuration, question.against} <= names for names in panels), question


def test_each_run_has_a_key_and_a_folder_of_its_own():
    for size in SIZES.values():
        jobs = size.jobs()
        assert len({job.key for job in jobs}) == len({job.folder for job in jobs}) == len(jobs)


def test_small_and_ppo_take_two_cores_two_hours_each():
    for size in (SMALL, PPO_ONLY):
        assert sum(map(size.expected_s, size.jobs())) / 2 < 120 * 60


def test_thesis_has_twenty_seeds_of_states_and_five_of_images_at_least():
    seeds = {
        task: [panel.seeds for panel in THESIS.panels if panel.task == task]
        for task in ("dot_reacher", "visual_dot_reacher")
    }
    assert min(seeds["dot_reacher"]) >= 20
    assert min(seeds["visual_dot_reacher"]) >= 5


@pytest.mark.parametrize("pending", SAC_PENDING, ids=lambda configuration: configuration.name)
def test_the_ablation_changes_nothing_but_the_pending_actions_of_all_who_must_know_of_them(pending):
    (without,) = (c for c in SAC if pending.name == f"{c.name}_pending")
    *same, added = pending.overrides
    assert replace(pending, name=without.name, overrides=tuple(same)) == without
    assert added == "algorithm.pending_actions=3"
    planned = plan_training(training_of(THESIS.panels[0].job(pending, 0), asdict(pending), Path("runs")))
    for service in (ACTOR, REPLAY, LEARNER):
        assert planned.configurations[service].algorithm.overrides["pending_actions"] == 3


def test_the_ablation_stands_beside_the_runs_that_it_is_held_against():
    for size in (SMALL, THESIS):
        (panel,) = (panel for panel in size.panels if panel.name == "sac_pending_dot_reacher")
        (sac,) = (panel for panel in size.panels if panel.name == "sac_dot_reacher")
        assert (panel.steps, panel.seeds, panel.overrides) == (sac.steps, sac.seeds, sac.overrides)
        assert [c.name.removesuffix("_pending") for c in panel.configurations[3:]] == [
            c.name for c in panel.configurations[:3]
        ]
        assert set(panel.configurations[:3]) < set(sac.configurations)
