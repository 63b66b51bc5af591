"""Pictures without a display: a window of the whole picture, many cameras, and clear words where nothing renders."""

import gc
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import mujoco
import numpy as np
import pytest

from services.robot_bridge.rendering import OffscreenCamera, Window
from services.robot_bridge.robots.mujoco_world import MujocoWorld, load_suite_model
from tests.helpers import TIMEOUT_S
from tests.services.robot_bridge.opengl import skip_without_opengl

ROOT = Path(__file__).resolve().parents[3]
WHOLE = Window(top=0, left=0, height=240, width=320)
BALLS = """
<mujoco>
  <worldbody>
    <light directional="true" pos="0 0 3"/>
    <camera name="above" pos="0 0 2"/>
    <geom name="red" type="sphere" size=".2" pos="-.3 0 0" rgba="1 0 0 1"/>
    <geom name="blue" type="sphere" size=".2" pos=".3 0 0" rgba="0 0 1 1"/>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def balls():
    skip_without_opengl()
    model = mujoco.MjModel.from_xml_string(BALLS)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def run(program, **environment):
    """Run a program with nothing in the environment that chooses a backend, but ``environment``."""
    clean = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "LP_NUM_THREADS")}
    arguments = [sys.executable, "-c", program]
    result = subprocess.run(
        arguments, cwd=ROOT, env={**clean, **environment}, capture_output=True, text=True, timeout=240, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_red_is_left_and_blue_is_right_and_rows_run_down(balls):
    model, data = balls
    model.geom("red").pos[1] = 0.1  # up in the picture
    mujoco.mj_forward(model, data)
    picture = OffscreenCamera(model, Window(0, 0, 48, 64, 48, 64), "above").picture(data).astype(int)
    assert (picture.shape, picture.dtype) == ((48, 64, 3), int)
    red = np.argwhere(picture[..., 0] > 2 * picture[..., 2]).mean(axis=0)
    blue = np.argwhere(picture[..., 2] > 2 * picture[..., 0]).mean(axis=0)
    # 45 degrees over 48 rows, from 2 m above: 24 / tan(22.5 deg) / 2 = 29 pixels per metre.
    np.testing.assert_allclose(red, [23.5 - 2.9, 31.5 - 8.7], atol=1)
    np.testing.assert_allclose(blue, [23.5, 31.5 + 8.7], atol=1)


@pytest.mark.parametrize(
    ("name", "joints", "window"),
    [
        ("reacher", [0.6, 1.0], Window(85, 110, 70, 100)),
        ("ball_in_cup", [0.02, 0.03, 0.15, 0.3], Window(20, 100, 100, 120)),
    ],
)
def test_a_window_shows_that_part_of_the_whole_picture(name, joints, window):
    skip_without_opengl()
    world = MujocoWorld(load_suite_model(name))
    world.reset(np.array(joints))
    whole = OffscreenCamera(world.model, WHOLE).picture(world.data).astype(int)
    part = OffscreenCamera(world.model, window).picture(world.data).astype(int)
    crop = whole[window.top : window.top + window.height, window.left : window.left + window.width]
    assert crop.std() > 10
    # A triangle's colours may be interpolated from another corner.
    assert np.abs(part - crop).max() <= 1


def test_the_same_state_gives_the_same_pixels_and_another_state_others(balls):
    model, data = balls
    camera = OffscreenCamera(model, WHOLE)
    first = camera.picture(data)
    kept = first.copy()
    model.geom("red").pos[0] += 0.05
    mujoco.mj_forward(model, data)
    assert not np.array_equal(camera.picture(data), kept)
    np.testing.assert_array_equal(first, kept)  # the caller's own
    model.geom("red").pos[0] -= 0.05
    mujoco.mj_forward(model, data)
    np.testing.assert_array_equal(camera.picture(data), kept)
    np.testing.assert_array_equal(OffscreenCamera(model, WHOLE).picture(data), kept)


def test_cameras_do_not_disturb_each_other_nor_does_closing_one(balls):
    model, data = balls
    windows = [Window(0, 0, 60, 80, 60, 80), Window(0, 0, 30, 40, 30, 40), Window(0, 0, 48, 64, 48, 64)]
    cameras = [OffscreenCamera(model, window, "above") for window in windows]
    pictures = [camera.picture(data) for camera in cameras]
    for again in (0, 2, 1, 0):
        np.testing.assert_array_equal(cameras[again].picture(data), pictures[again])
    cameras[2].close()
    cameras[2].close()  # twice is once
    del cameras[1]
    np.testing.assert_array_equal(cameras[0].picture(data), pictures[0])


def test_an_unknown_camera_is_an_error(balls):
    model, _ = balls
    with pytest.raises(KeyError, match="above"):
        OffscreenCamera(model, WHOLE, "below")


def in_another_thread(function, *arguments):
    """What the function returns in a thread that has ended when it does."""
    with ThreadPoolExecutor(1) as threads:
        return threads.submit(function, *arguments).result(TIMEOUT_S)


def test_a_camera_goes_from_thread_to_thread(balls):
    model, data = balls
    camera = OffscreenCamera(model, WHOLE)
    picture = camera.picture(data)
    np.testing.assert_array_equal(in_another_thread(camera.picture, data), picture)
    np.testing.assert_array_equal(camera.picture(data), picture)
    theirs = in_another_thread(OffscreenCamera, model, WHOLE)
    np.testing.assert_array_equal(theirs.picture(data), picture)
    in_another_thread(camera.close)
    theirs.close()


def test_several_threads_draw_at_once(balls):
    model, _ = balls

    def draw(place):
        data = mujoco.MjData(model)
        mine = OffscreenCamera(model, Window(0, 0, 24 + place, 32, 24 + place, 32))
        mujoco.mj_forward(model, data)
        pictures = [mine.picture(data) for _ in range(30)]
        mine.close()
        assert all((picture == pictures[0]).all() for picture in pictures)
        return pictures[0]

    alone = [draw(place) for place in range(3)]
    with ThreadPoolExecutor(3) as threads:
        for one, other in zip(threads.map(draw, range(3), timeout=TIMEOUT_S), alone, strict=True):
            np.testing.assert_array_equal(one, other)


def test_a_camera_that_is_collected_while_another_one_draws_does_not_disturb_it(balls, monkeypatch):
    model, data = balls
    camera = OffscreenCamera(model, WHOLE)
    picture = camera.picture(data)
    garbage = [OffscreenCamera(model, WHOLE)]
    garbage.append(garbage)  # a cycle, which only the collector finds
    del garbage
    draw = mujoco.mjr_render
    monkeypatch.setattr(mujoco, "mjr_render", lambda *arguments: (gc.collect(), draw(*arguments)))
    np.testing.assert_array_equal(camera.picture(data), picture)


# ---------------------------------------------------------------------- backends, each in a process of its own

READ = """
import sys
{before}
import numpy as np
from services.robot_bridge.tasks import load_task
task = load_task("reacher_easy_visual", rng=np.random.default_rng(0))
task.advance_to(0)
try:
    frame = task.read().frames[0]
    print(frame.std() > 5)
except Exception as error:
    print(type(error).__name__, error)
{after}
"""


def test_without_any_backend_the_error_names_the_packages():
    without_opengl = 'sys.modules["OpenGL"] = None'  # as if no library were there: importing it fails
    message = run(READ.format(before=without_opengl, after=""))
    assert message.startswith("ServiceError this task has a camera, and no OpenGL backend works here (egl: ")
    assert "; osmesa: " in message
    assert message.endswith("install libegl1 and libgl1-mesa-dri, or libosmesa6")


@pytest.mark.parametrize(("backend", "packages"), [("egl", "libegl1 and libgl1-mesa-dri"), ("osmesa", "libosmesa6")])
def test_a_backend_that_was_asked_for_is_the_only_one_tried(backend, packages):
    message = run(READ.format(before='sys.modules["OpenGL"] = None', after=""), MUJOCO_GL=backend)
    said = "ServiceError this task has a camera, and the OpenGL backend that MUJOCO_GL names does not work here"
    assert message.startswith(f"{said} ({backend}: ")
    assert ("egl: " in message, "osmesa: " in message) == (backend == "egl", backend == "osmesa")
    assert f"install {packages}, or unset MUJOCO_GL" in message


def test_where_opengl_is_forbidden_the_error_says_so():
    message = run(READ.format(before="", after=""), MUJOCO_GL="disabled")
    assert message == "ServiceError this task has a camera, but MUJOCO_GL=disabled forbids OpenGL: unset it, or set egl"


@pytest.mark.parametrize("value", ["nonsense", "glfw"])
def test_a_backend_that_is_none_is_named_with_those_that_are(value):
    message = run(READ.format(before="", after=""), MUJOCO_GL=value)
    assert message.startswith(f"ServiceError this task has a camera, and MUJOCO_GL={value} is no backend")
    assert "expected egl or osmesa; unset it" in message


def test_the_second_backend_is_taken_where_the_first_fails():
    # The second one stands in: a context that only counts. Its failure to draw shows that it was chosen.
    before = """
import types
class GLContext:
    def __init__(self, width, height): print(width, height)
    def free(self): pass
sys.modules["mujoco.egl"] = types.ModuleType("mujoco.egl")
sys.modules["mujoco.osmesa"] = types.ModuleType("mujoco.osmesa")
sys.modules["mujoco.osmesa"].GLContext = GLContext
from services.robot_bridge.rendering import gl_context_class
assert gl_context_class() is GLContext and gl_context_class() is GLContext
raise SystemExit
"""
    assert run(READ.format(before=before, after="")) == "1 1"


def test_a_process_may_render_before_it_learns():
    skip_without_opengl()
    # Mesa's LLVM and that of triton, which torch's optimisers load, end such a process unless they are kept apart.
    after = """
import torch
parameter = torch.nn.Parameter(torch.zeros(3))
optimiser = torch.optim.Adam([parameter], fused=True)
parameter.sum().backward()
optimiser.step()
print(parameter[0].item() < 0)
"""
    assert run(READ.format(before="", after=after)).split() == ["True", "True"]


def test_a_program_that_closes_nothing_ends_quietly():
    skip_without_opengl()
    program = READ.format(before="", after="kept = [task]")
    arguments = [sys.executable, "-c", program]
    result = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, timeout=240, check=False)
    assert (result.returncode, result.stderr) == (0, "")
