"""Tests that render skip where nothing can render, and only there."""

import pytest

from common.errors import ServiceError
from services.robot_bridge.rendering import gl_context_class


def skip_without_opengl():
    try:
        gl_context_class()
    except ServiceError as error:
        pytest.skip(str(error))
