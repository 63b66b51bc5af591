"""The sections that services share refuse what would break the keys, the network or the journal."""

import pytest

from common.config import build_section
from common.errors import ConfigError
from common.run_settings import AlgorithmSettings, JournalSettings, RunSettings, TransportSettings
from common.topics import TIME_STEP


def build(cls, **values):
    return build_section(cls, values, "here: [section]")


@pytest.mark.parametrize("name", ["r", "run-1", "2026_01_01.seed-0", "A" * 200])
def test_names_of_letters_digits_and_three_signs_are_taken(name):
    run = build(RunSettings, id=name, directory="d", robot=name)
    assert TIME_STEP.key(run.id, run.robot) == f"relod/{name}/{name}/timestep"


@pytest.mark.parametrize("name", ["", "a b", "a/b", "*", "**", "a*", "$*", "run?", "run#1", "läuft", "a\n", "@adv"])
@pytest.mark.parametrize("key", ["id", "robot"])
def test_names_that_would_change_the_key_expression_are_refused(key, name):
    values = {"id": "r", "directory": "d"} | {key: name}
    with pytest.raises(ConfigError, match=rf"\[section\]: {key} = .*expected letters, digits"):
        build(RunSettings, **values)


def test_a_run_needs_an_id_and_a_directory():
    with pytest.raises(ConfigError, match="id is missing"):
        build(RunSettings, directory="d")
    with pytest.raises(ConfigError, match="directory is missing"):
        build(RunSettings, id="r")


@pytest.mark.parametrize("seed", [-1, 2**31])
def test_a_seed_fits_every_generator(seed):
    with pytest.raises(ConfigError, match=f"seed = {seed}: expected a value from 0 to {2**31 - 1}"):
        build(RunSettings, id="r", directory="d", seed=seed)


def test_a_transport_needs_both_endpoints_and_connects_to_nobody_by_default():
    settings = build(TransportSettings, listen_real_time="a", listen_bulk="b")
    assert settings.connect_real_time == settings.connect_bulk == []
    assert settings.shared_memory is False  # it would go around an emulated network
    with pytest.raises(ConfigError, match="listen_bulk is missing"):
        build(TransportSettings, listen_real_time="a")


def test_an_algorithms_other_keys_override_its_preset():
    settings = build(AlgorithmSettings, preset="demo", batch_size=64)
    assert (settings.name, settings.preset, settings.overrides) == ("sac", "demo", {"batch_size": 64})


@pytest.mark.parametrize(
    ("key", "value"), [("journal_s", 0.5), ("journal_s", 3601), ("journal_mib", 0), ("resend_kib_per_s", 0)]
)
def test_a_journal_has_room_and_a_pace(key, value):
    with pytest.raises(ConfigError, match=key):
        build(JournalSettings, **{key: value})
