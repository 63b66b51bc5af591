"""A device that cannot be used is an error that says what to do, before anything is learnt."""

import pytest
import torch

from common.config import build_section
from common.errors import ConfigError, ServiceError
from services.learner.config import LearnerSettings
from services.learner.device import open_device, too_little_memory_explained


def test_the_cpu_is_always_there():
    assert open_device("cpu") == torch.device("cpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this computer has a GPU")
@pytest.mark.parametrize("name", ["cuda", "cuda:3"])
def test_a_gpu_that_is_not_there_is_named_with_what_to_do(name):
    with pytest.raises(ConfigError) as caught:
        open_device(name)
    message = str(caught.value)
    assert message.startswith(f"learner.device = '{name}': expected a GPU that torch can use, it sees 0; ")
    assert "\n" not in message
    for advice in ("nvidia-smi", "`--set learner.device=cpu` learns without one"):
        assert advice in message


def test_too_little_memory_is_told_with_what_needs_less():
    with (
        pytest.raises(ServiceError, match=r"cuda:1 has too little memory .*20 MiB.*learner.frames=host.*batch_size"),
        too_little_memory_explained(torch.device("cuda:1")),
    ):
        raise torch.OutOfMemoryError("Tried to allocate 20 MiB")


def test_other_errors_stay_what_they_are():
    with pytest.raises(ZeroDivisionError), too_little_memory_explained(torch.device("cpu")):
        1 / 0  # noqa: B018


@pytest.mark.parametrize("name", ["cpu", "cuda", "cuda:0", "cuda:12"])
def test_devices_that_are_accepted(name):
    assert build_section(LearnerSettings, {"device": name}, "[learner]").device == name


@pytest.mark.parametrize(
    "name", ["", "gpu", "Cuda", "cuda:", "cuda:-1", "cuda:128", "cuda:x", "cuda 0", "cpu:0", "mps", " cpu"]
)
def test_any_other_device_is_refused_when_the_configuration_is_read(name):
    with pytest.raises(ConfigError) as caught:
        build_section(LearnerSettings, {"device": name}, "learner.toml: [learner]")
    assert str(caught.value).startswith(f"learner.toml: [learner]: device = {name!r}: expected cpu, cuda or cuda:N")


@pytest.mark.parametrize(
    ("frames", "device", "expected"),
    [
        ("auto", "cpu", False),
        ("auto", "cuda", True),
        ("auto", "cuda:1", True),
        ("host", "cuda", False),
        ("device", "cpu", True),
        ("device", "cuda", True),
    ],
)
def test_frames_are_on_the_device_where_that_is_a_gpu_or_where_asked_for(frames, device, expected):
    assert LearnerSettings(device=device, frames=frames).frames_on_device == expected
