"""What the tests of both robots on two wheels need."""

import numpy as np

from services.robot_bridge.robots.wheeled_robot import start
from services.robot_bridge.target_detection import colour_mask, share
from services.robot_bridge.tasks import load_task


def build(name, seed=0, pacing="lockstep", **settings):
    return load_task(name, "", settings, pacing=pacing, rng=np.random.default_rng(seed))


def begun(name, **settings):
    task = build(name, **settings)
    task.advance_to(0)
    task.begin_episode()
    return task


def put(task, *pose):
    """Put the robot at a pose; return what its camera sees from there."""
    task._world.place(np.zeros(0), start(np.array(pose), ()), 0)
    task._forget_frames()
    return task.read().frames[-1]


def share_of_others(task, material, colours, cycles):
    """Drive about with the target painted over; return the largest share of a frame that has its colour still."""
    model = task.robot.model
    model.mat_rgba[model.material(material).id] = model.mat_rgba[model.material("wall").id]
    model.mat_emission[model.material(material).id] = 0
    task.read()  # what was drawn before
    largest = 0.0
    rng, cycle_ns = np.random.default_rng(0), round(task.spec.action_cycle_time_s * 1e9)
    for cycle in range(1, cycles + 1):
        task.command(rng.choice([-1.0, 1.0], 2).astype(np.float32) * task.spec.action_high)
        task.advance_to(cycle * cycle_ns)
        if cycle % 20 == 0:
            task.begin_attempt()
        largest = max(largest, *(share(colour_mask(frame, colours)) for frame in task.read().frames), 0.0)
    return largest
