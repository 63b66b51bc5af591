"""A MuJoCo model as a world that goes on by itself, in whatever portions of time it is asked to."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np

from common.errors import ServiceError
from services.robot_bridge.mujoco_without_opengl import mujoco


def load_suite_model(name: str) -> mujoco.MjModel:
    """Compile a model of the DeepMind Control Suite from the XML that dm_control ships, ``suite/<name>.xml``.

    Only the file is used: importing dm_control's suite would choose and import an OpenGL backend. The sky is left out;
    it is never rendered (:mod:`services.robot_bridge.rendering`), and drawing its texture takes 50 of 51 ms.
    """
    package = importlib.util.find_spec("dm_control")
    if package is None or not package.submodule_search_locations:
        raise ServiceError(f"the model {name} comes with dm_control, which is not installed: pip install dm-control")
    path = Path(package.submodule_search_locations[0]) / "suite" / f"{name}.xml"
    model = mujoco.MjSpec.from_file(str(path))
    model.delete(model.texture("skybox"))
    return model.compile()


class MujocoWorld:
    """Joints, motors and the state of a model; the motors go on with their last command.

    The world takes whole physics timesteps, as dm_control does: a control step of n timesteps gives dm_control's state,
    bit for bit, and the portions in which the time comes change nothing. Between two timesteps, what is seen is a
    shorter step from the last one, taken back when time goes on. A timestep can be as long as an action cycle (the
    reacher's is): one in which the command changes is taken with the mean of its commands over time, so that a command
    has no effect before it is given, and half a timestep's effect when it is given in the middle.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        """Geometry may be changed between resets."""
        self.data = mujoco.MjData(model)
        """The state; positions and velocities of all bodies in it are those of now."""
        self._timestep_s = float(model.opt.timestep)
        self._timestep_ns = round(self._timestep_s * 1e9)
        self._motor_dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
        self._command = np.zeros(model.nu)
        self._begun_ns = 0
        """How much of a timestep has passed since the last whole one."""
        self._begun_impulse = np.zeros(model.nu)
        """Integral of the commands over that time, command times ns."""
        self._last_whole = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION))
        """The state after the last whole timestep, while another has begun."""
        self.reset(model.qpos0)

    @property
    def in_contact(self) -> bool:
        """True if any two bodies touch."""
        return bool(self.data.ncon)

    def reset(self, joint_positions: np.ndarray) -> None:
        """Put the joints at ``joint_positions`` (nq,), rad or m in the model's order; at rest, motors off."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = joint_positions
        self._start_from_here()

    def stop(self) -> None:
        """Switch the motors off and brake their joints; what no motor moves goes on moving."""
        self.data.qvel[self._motor_dofs] = 0.0
        self._start_from_here()

    def command(self, controls: np.ndarray) -> None:
        """Give the motors their commands (nu,) from now on; the model clips them to its range."""
        self._command[:] = controls

    def advance(self, duration_ns: int) -> None:
        """Let ``duration_ns`` of world time pass."""
        if self._begun_ns:
            duration_ns = self._go_on_with_begun(duration_ns)
        whole, rest_ns = divmod(duration_ns, self._timestep_ns)
        if whole:
            self.data.ctrl[:] = self._command
            self._take_timesteps(whole)
        if rest_ns:
            mujoco.mj_getState(self.model, self.data, self._last_whole, mujoco.mjtState.mjSTATE_INTEGRATION)
            self._begun_ns = rest_ns
            self._begun_impulse = self._command * rest_ns
            self._show_begun()

    def _go_on_with_begun(self, duration_ns: int) -> int:
        """Let time pass until the begun timestep is whole, if there is as much; return the time that is left."""
        portion_ns = min(duration_ns, self._timestep_ns - self._begun_ns)
        self._begun_ns += portion_ns
        self._begun_impulse += self._command * portion_ns
        mujoco.mj_setState(self.model, self.data, self._last_whole, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_step1(self.model, self.data)
        if self._begun_ns < self._timestep_ns:
            self._show_begun()
        else:
            self.data.ctrl[:] = self._begun_impulse / self._begun_ns
            self._take_timesteps(1)
            self._begun_ns = 0
        return duration_ns - portion_ns

    def _show_begun(self) -> None:
        self.data.ctrl[:] = self._begun_impulse / self._begun_ns
        self.model.opt.timestep = self._begun_ns * 1e-9
        self._take_timesteps(1)
        self.model.opt.timestep = self._timestep_s

    def _take_timesteps(self, count: int) -> None:
        # The first half of a step has been done for this state; doing the next one's leaves all bodies where they are.
        mujoco.mj_step2(self.model, self.data)
        if count > 1:
            mujoco.mj_step(self.model, self.data, count - 1)
        mujoco.mj_step1(self.model, self.data)

    def _start_from_here(self) -> None:
        """Make this state, with the motors off, that of a whole timestep."""
        self._command[:] = 0.0
        self.data.ctrl[:] = 0.0
        self._begun_ns = 0
        mujoco.mj_forward(self.model, self.data)
