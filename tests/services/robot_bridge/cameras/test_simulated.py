"""A simulated camera's pictures: drawn when something moves, noisy and dark as they are told to be."""

import mujoco
import numpy as np
import pytest

from services.robot_bridge.cameras.simulated import BUFFERED_FRAMES, LIGHT_PERIOD_NS, CameraDefects, SimulatedCamera
from tests.services.robot_bridge.opengl import skip_without_opengl

SCENE = """
<mujoco>
  <visual><headlight ambient=".2 .2 .2" diffuse=".1 .1 .1" specular="0 0 0"/></visual>
  <asset>
    <material name="shining" rgba="0 0 .6 1" emission="1" specular="0"/>
    <material name="dull" rgba=".5 .5 .5 1" specular="0"/>
  </asset>
  <worldbody>
    <light directional="true" pos="0 0 3" diffuse=".3 .3 .3"/>
    <camera name="above" pos="0 0 2"/>
    <geom name="wall" type="box" size="2 2 .01" pos="0 0 -.1" material="dull"/>
    <body>
      <joint type="slide" axis="1 0 0"/>
      <geom name="ball" type="sphere" size=".2" pos=".3 0 0" material="dull"/>
    </body>
  </worldbody>
</mujoco>
"""


class Scene:
    """A ball on a slide in front of a wall, and a camera."""

    def __init__(self, **defects) -> None:
        skip_without_opengl()
        self.model = mujoco.MjModel.from_xml_string(SCENE)
        self.data = mujoco.MjData(self.model)
        self.camera = SimulatedCamera(self.model, "above", height=24, width=32, defects=CameraDefects(**defects))
        self.camera.begin(np.random.default_rng(0))
        self.move(0.0)

    def move(self, position) -> None:
        self.data.qpos[0] = position
        mujoco.mj_kinematics(self.model, self.data)

    def shot(self, at_ns=0):
        self.camera.capture(self.data, at_ns)
        (frame,) = self.camera.take()
        return frame.frame


@pytest.fixture
def draws(monkeypatch):
    """Counts what is really drawn."""
    drawn, draw = [], mujoco.mjr_render
    monkeypatch.setattr(mujoco, "mjr_render", lambda *arguments: (drawn.append(1), draw(*arguments)))
    return drawn


def test_a_frame_is_rgb_of_the_size_that_was_asked_for():
    frame = Scene().shot()
    assert (frame.shape, frame.dtype) == ((24, 32, 3), np.uint8)
    assert len(np.unique(frame)) > 3  # the wall, and a ball that is darker towards its edge


def test_a_scene_in_which_nothing_has_moved_is_not_drawn_again(draws):
    scene = Scene()
    first = scene.shot()
    assert np.array_equal(scene.shot(10**9), first)
    assert len(draws) == 1
    scene.move(0.1)
    assert not np.array_equal(scene.shot(), first)
    scene.move(0.0)
    assert np.array_equal(scene.shot(), first)
    scene.model.geom("wall").pos[0] += 1.9  # not a joint, but seen
    scene.move(0.0)
    assert not np.array_equal(scene.shot(), first)
    assert len(draws) == 4


def test_noise_differs_from_frame_to_frame_and_is_as_strong_as_it_should_be():
    clean, noisy = Scene().shot().astype(float), Scene(noise=4.0)
    first, second = noisy.shot().astype(float), noisy.shot().astype(float)
    assert not np.array_equal(first, second)
    for frame in (first, second):
        assert (frame - clean).mean() == pytest.approx(0, abs=0.5)
        assert (frame - clean).std() == pytest.approx(4.0, rel=0.1)


def test_noise_follows_from_the_seed():
    scene = Scene(noise=4.0)
    frames = []
    for seed in (3, 3, 4):
        scene.camera.begin(np.random.default_rng(seed))
        frames.append(scene.shot())
    assert np.array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], frames[2])


def test_strong_noise_stays_within_the_grey_levels():
    frame = Scene(noise=128.0).shot()
    assert frame.min() == 0
    assert frame.max() == 255


def test_changing_light_goes_up_and_down_by_the_share_and_comes_back():
    scene, undisturbed = Scene(lighting_change=0.5), Scene().shot().astype(float).mean()
    quarter = LIGHT_PERIOD_NS // 40
    shares = [scene.shot(k * quarter).astype(float).mean() / undisturbed for k in range(40)]
    assert max(shares) == pytest.approx(1.5, abs=0.03)
    assert min(shares) == pytest.approx(0.5, abs=0.03)
    assert scene.shot(LIGHT_PERIOD_NS).astype(float).mean() / undisturbed == pytest.approx(shares[0])


def test_changing_light_follows_from_the_seed_whenever_it_begins():
    scene = Scene(lighting_change=0.5)
    shares = []
    for seed, begun_ns in ((3, 0), (3, 7 * LIGHT_PERIOD_NS // 3), (4, 0)):
        scene.camera.begin(np.random.default_rng(seed))
        shares.append([scene.shot(begun_ns + k * LIGHT_PERIOD_NS // 10).mean() for k in range(10)])
    assert shares[0] == shares[1]
    assert shares[0] != shares[2]


def test_what_shines_by_itself_stays_visible_when_the_room_gets_dark():
    scene = Scene(lighting_change=0.9)
    scene.model.geom("wall").matid = scene.model.material("shining").id
    blue = [scene.shot(k * LIGHT_PERIOD_NS // 20)[0, 0, 2] for k in range(20)]
    assert min(blue) > 0.6 * 255 - 2


def test_a_camera_that_never_captured_is_closed_without_opengl(monkeypatch):
    monkeypatch.setattr("services.robot_bridge.cameras.simulated.OffscreenCamera", None)
    model = mujoco.MjModel.from_xml_string(SCENE)
    camera = SimulatedCamera(model, "above", height=24, width=32)
    assert camera.take() == []
    camera.close()


def test_what_nobody_took_is_dropped_and_counted():
    scene = Scene()
    for k in range(BUFFERED_FRAMES + 3):
        scene.camera.capture(scene.data, k)
    scene.camera.miss(2)
    assert scene.camera.dropped == 3 + 2
    assert scene.camera.newest_capture_ns == BUFFERED_FRAMES + 2
    assert (scene.camera.lost, scene.camera.losses) == (None, 0)
    assert [frame.capture_ns for frame in scene.camera.take()] == list(range(3, BUFFERED_FRAMES + 3))


def test_nobody_writes_into_a_frame():
    with pytest.raises(ValueError, match="read-only"):
        Scene().shot()[0, 0, 0] = 1


def test_a_closed_camera_can_be_closed_again():
    scene = Scene()
    scene.shot()
    scene.camera.close()
    scene.camera.close()
