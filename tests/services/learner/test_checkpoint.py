"""A checkpoint that cannot be used is an error that names it; a disk that cannot be written is not."""

import io
import threading

import numpy as np
import pytest

from common.algorithms.sac import SAC
from common.algorithms.sac_config import SACConfig
from common.errors import ConfigError, ServiceError
from services.learner import checkpoint as checkpoints
from services.learner.checkpoint import CHECKPOINT_FILE, POLICY_FILE, CheckpointWriter, restore
from tests.helpers import TIMEOUT_S, eventually, make_spec

SPEC = make_spec(camera=False)


def make_algorithm(hidden_size=16):
    return SAC(SPEC, SACConfig(hidden_size=hidden_size, batch_size=8), seed=0, precision="float32")


@pytest.fixture
def checkpoint(tmp_path):
    """The file of a good checkpoint, policy version 6."""
    algorithm = make_algorithm()
    writer = CheckpointWriter(tmp_path)
    writer.write(6, algorithm.encoded_policy(6, "float32"), algorithm.state_dict())
    writer.close()
    assert restore(tmp_path, make_algorithm()) == 6
    return tmp_path / CHECKPOINT_FILE


def unchanged(algorithm, act):
    before = algorithm.state_dict()
    act()
    return all(np.array_equal(value, before[name]) for name, value in algorithm.state_dict().items())


def one_array():
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(3))
    return buffer.getvalue()


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[:10],
        lambda content: content[: len(content) // 2],
        lambda content: content[:-1],
        lambda content: b"not a checkpoint at all",
        lambda content: content[:3000] + bytes(64) + content[3064:],
        lambda content: b"\x93NUMPY" + content[6:],
        lambda content: one_array(),
    ],
    ids=["empty", "ten bytes", "half", "one byte short", "text", "overwritten", "another format", "one array"],
)
def test_a_damaged_checkpoint_is_named_and_changes_nothing(checkpoint, damage):
    checkpoint.write_bytes(damage(checkpoint.read_bytes()))
    algorithm = make_algorithm()

    def attempt():
        with pytest.raises(ConfigError, match=rf"{CHECKPOINT_FILE}: cannot go on from this checkpoint: .*remove it"):
            restore(checkpoint.parent, algorithm)

    assert unchanged(algorithm, attempt)


def test_a_checkpoint_of_other_networks_is_named_with_the_first_that_differs(checkpoint):
    with pytest.raises(ConfigError, match=r"cannot go on from this checkpoint: .*expected \[32.*got \[16"):
        restore(checkpoint.parent, make_algorithm(hidden_size=32))


@pytest.mark.parametrize("missing", ["policy_version", "updates", "log_temperature"])
def test_a_checkpoint_that_lacks_something_is_named(checkpoint, missing):
    with np.load(checkpoint) as file:
        state = {name: value for name, value in file.items() if name != missing}
    np.savez(checkpoint, **state)
    with pytest.raises(ConfigError, match=f"{CHECKPOINT_FILE}.*{missing}"):
        restore(checkpoint.parent, make_algorithm())


def test_a_checkpoint_is_never_unpickled(checkpoint):
    evil = np.array([{"a": 1}], dtype=object)
    np.savez(checkpoint, policy_version=np.int64(1), evil=evil)
    with pytest.raises(ConfigError, match="allow_pickle"):
        restore(checkpoint.parent, make_algorithm())


def test_the_last_of_several_checkpoints_is_what_remains(tmp_path):
    algorithm = make_algorithm()
    writer = CheckpointWriter(tmp_path)
    for version in range(1, 6):
        writer.write(version, algorithm.encoded_policy(version, "float32"), algorithm.state_dict())
    writer.close()
    assert restore(tmp_path, make_algorithm()) == 5


def test_while_one_is_written_the_next_ones_replace_each_other(tmp_path, monkeypatch):
    algorithm, replace = make_algorithm(), checkpoints.write_atomically
    begun, go_on, written = threading.Event(), threading.Event(), []

    def slow_replace(path, content):
        begun.set()
        assert go_on.wait(TIMEOUT_S)
        written.append(path.name)
        replace(path, content)

    monkeypatch.setattr(checkpoints, "write_atomically", slow_replace)
    writer = CheckpointWriter(tmp_path)
    writer.write(1, algorithm.encoded_policy(1, "float32"), algorithm.state_dict())
    assert begun.wait(TIMEOUT_S)
    for version in (2, 3, 4):
        writer.write(version, algorithm.encoded_policy(version, "float32"), algorithm.state_dict())
    go_on.set()
    writer.close()
    assert written == [POLICY_FILE, CHECKPOINT_FILE] * 2
    assert restore(tmp_path, make_algorithm()) == 4


def test_a_disk_that_cannot_be_written_is_logged_and_does_not_end_the_learner(tmp_path, caplog):
    algorithm = make_algorithm()
    no_folder = tmp_path / "file"
    no_folder.touch()
    writer = CheckpointWriter(no_folder)
    writer.write(1, algorithm.encoded_policy(1, "float32"), algorithm.state_dict())
    writer.close()
    assert "the checkpoint cannot be written" in caplog.text
    assert writer.failure is not None
    assert str(no_folder) in writer.failure


def test_a_disk_that_takes_again_has_the_checkpoint(tmp_path):
    algorithm, folder = make_algorithm(), tmp_path / "run"
    folder.touch()
    writer = CheckpointWriter(folder)
    writer.write(1, algorithm.encoded_policy(1, "float32"), algorithm.state_dict())
    eventually(lambda: writer.failure, "the failure")
    folder.unlink()
    writer.write(2, algorithm.encoded_policy(2, "float32"), algorithm.state_dict())
    writer.close()
    assert writer.failure is None
    assert restore(folder, make_algorithm()) == 2


def test_what_has_diverged_does_not_replace_a_good_checkpoint(checkpoint):
    algorithm, good = make_algorithm(), checkpoint.read_bytes()
    state = algorithm.state_dict()
    state["actor.1.weight"][3, 4] = np.inf
    writer = CheckpointWriter(checkpoint.parent)
    with pytest.raises(ServiceError, match=r"actor\.1\.weight is not finite"):
        writer.write(7, algorithm.encoded_policy(7, "float32"), state)
    writer.close()
    assert checkpoint.read_bytes() == good
