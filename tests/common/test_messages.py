"""What the messages say of themselves, and that the codec can check every field of them."""

from dataclasses import FrozenInstanceError, fields, is_dataclass
from typing import get_type_hints

import numpy as np
import pytest

from common import messages
from common.frame_encoding import FrameEncoding
from common.messages import MESSAGES, Array, Count, Dimensions
from tests.helpers import make_experience, make_spec, make_time_step

_NESTED = {"PolicyExtras"}
"""Travels only inside another message."""
_NO_MESSAGES = {"Array", "Bounds", "CameraFrames", "Dimensions"}


def test_dimensions_are_read_off_the_task_specification():
    assert make_spec().dimensions == Dimensions(A=2, P=5, H=6, W=8, C=3, S=4, frame_encoding=FrameEncoding.RAW)


def test_a_task_without_camera_has_frames_of_no_size():
    spec = make_spec(camera=False)
    assert not spec.has_camera
    assert spec.dimensions == Dimensions(A=2, P=5, H=0, W=0, C=0, S=0, frame_encoding=FrameEncoding.RAW)


def test_a_task_with_frames_in_its_observation_has_a_camera():
    assert make_spec().has_camera


def test_the_first_time_step_of_an_attempt_is_the_one_with_index_0():
    assert make_time_step(7, step_index=0).is_first
    assert not make_time_step(0, step_index=1).is_first


@pytest.mark.parametrize(
    ("terminated", "truncated", "last"),
    [(False, False, False), (True, False, True), (False, True, True), (True, True, True)],
)
def test_an_attempt_ends_by_its_goal_or_by_its_time_limit(terminated, truncated, last):
    assert make_time_step(terminated=terminated, truncated=truncated).is_last is last


def test_every_message_can_stand_at_the_top_of_a_payload():
    declared = {
        name
        for name, cls in vars(messages).items()
        if is_dataclass(cls) and isinstance(cls, type) and name not in _NESTED | _NO_MESSAGES
    }
    assert {cls.__name__ for cls in MESSAGES} == declared
    assert len(MESSAGES) == len(declared)


@pytest.mark.parametrize("cls", MESSAGES, ids=lambda cls: cls.__name__)
def test_a_message_cannot_be_changed(cls):
    assert cls.__dataclass_params__.frozen


def test_a_message_that_was_built_is_not_rebuilt_by_assignment():
    step = make_experience().time_step
    with pytest.raises(FrozenInstanceError):
        step.reward = 1.0


def test_shapes_use_the_letters_of_the_table():
    letters = {
        letter
        for cls in MESSAGES
        for hint in get_type_hints(cls, include_extras=True).values()
        for rule in getattr(hint, "__metadata__", ())
        if isinstance(rule, Array)
        for letter in rule.shape
        if isinstance(letter, str)
    }
    sizes = {item.name for item in fields(Dimensions)} - {"frame_encoding"}
    assert letters >= sizes
    assert letters - sizes == {"k", "n", "m", "B"}  # sizes that are a message's own


def test_counts_fit_the_arrays_they_are_stored_in():
    bounds = Count.__metadata__[0]
    assert bounds.low == 0
    assert 2 * bounds.high - 1 <= np.iinfo(np.int64).max  # nor does one more, or a difference, wrap
