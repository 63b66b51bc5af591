"""dm_control's own environments, in the state of a task of ours."""

import os
from unittest.mock import patch

with patch.dict(os.environ, {"MUJOCO_GL": "disabled"}):  # or it would choose and import an OpenGL backend
    from dm_control import suite
    from dm_control.rl import control
    from dm_control.suite import reacher

NO_LIMIT = float("inf")
SUITE_NAMES = {
    "reacher_easy": ("reacher", "easy"),
    "reacher_hard": ("reacher", "hard"),
    "ball_in_cup": ("ball_in_cup", "catch"),
}


def environment_like(name):
    """Return dm_control's environment of a task's id, reset; always with the same seed."""
    name = name.removesuffix("_visual")
    if name == "reacher_extreme":
        physics = reacher.Physics.from_xml_string(*reacher.get_model_and_assets())
        environment = control.Environment(physics, reacher.Reacher(target_size=0.001, random=0), time_limit=NO_LIMIT)
        environment.physics.named.model.geom_size["finger", 0] = 0.0001
    else:
        environment = suite.load(*SUITE_NAMES[name], task_kwargs={"time_limit": NO_LIMIT, "random": 0})
    environment.reset()
    return environment


def take_over_state(environment, task):
    """Bring dm_control's environment into the state of ``task``, which must be at rest."""
    physics, world = environment.physics, task._world
    with physics.reset_context():
        if "target" in [physics.model.id2name(i, "geom") for i in range(physics.model.ngeom)]:
            physics.named.model.geom_pos["target"] = world.model.geom("target").pos
        physics.data.qpos[:] = world.data.qpos
