"""``python -m services.robot_bridge --task T --preview DIR``: a simulated robot's task, to look at before it is learnt.

The initial policy, actions at random, as a video ``DIR/T.mp4`` and a contact sheet ``DIR/T.png``: what the agent sees,
what of it is taken for the target, and the robot from outside.
"""

from __future__ import annotations

import argparse
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np

from common.config import parse_override
from common.console import Console
from common.errors import ConfigError, RelodError
from common.messages import TaskSpec, UInt8Array
from common.options import output_folder
from common.stop_signals import INTERRUPTED, StopSignals
from services.robot_bridge.preview_pictures import contact_sheet, panels, write_picture, write_video
from services.robot_bridge.rendering import OffscreenCamera, Window
from services.robot_bridge.robots.base import ROOM_CAMERA, SimulatedRobot
from services.robot_bridge.target_detection import Mask, colour_mask
from services.robot_bridge.tasks import load_task
from services.robot_bridge.tasks.robot_task import RobotTask

PROGRAM = "services.robot_bridge"
DURATION_S = 10.0
"""Of the world's time, whatever ends in it."""
ROOM_WIDTH, ROOM_HEIGHT = 960, 540
"""Of the picture from outside, pixels."""


@dataclass(frozen=True)
class Moment:
    """What there is to see at the end of an action cycle."""

    time_s: float
    """Since the first episode began."""
    frame: UInt8Array
    """(H, W, 3): the newest one."""
    mask: Mask | None
    """(H, W): what has the target's colours; None if it is not found by them."""
    room: UInt8Array
    """(ROOM_HEIGHT, ROOM_WIDTH, 3)."""
    at_goal: bool
    """True if the episode ends here."""


def main(arguments: Sequence[str], stop: StopSignals) -> int:
    """Draw what the command line asks for; return the exit code.

    Args:
        arguments: of the command line.
        stop: when to give up; what is being written by then is still completed.
    """
    options = _parser().parse_args(arguments)
    console = Console()
    try:
        return _draw(options, stop, console)
    except KeyboardInterrupt:
        console.line("interrupted before anything was written")
        return INTERRUPTED
    except RelodError as error:
        console.error(f"{PROGRAM}: error: {error}")
        return 1


def _draw(options: argparse.Namespace, stop: StopSignals, console: Console) -> int:
    _end_if_asked(stop)
    shown = []
    with closing(_task(options)) as task, closing(moments(task, options.seed)) as coming:
        name = task.spec.task
        for moment in coming:
            _end_if_asked(stop)
            shown.append((moment, panels(moment.frame, moment.mask, moment.room)))
    paths = options.preview / f"{name}.png", options.preview / f"{name}.mp4"
    write_picture(paths[0], contact_sheet([(_label(moment), picture) for moment, picture in shown]))
    write_video(paths[1], [picture for _, picture in shown], 1 / task.spec.action_cycle_time_s)
    for path in paths:
        console.line(str(path))
    return INTERRUPTED if stop.asked else 0


def _end_if_asked(stop: StopSignals) -> None:
    if stop.asked:
        raise KeyboardInterrupt


def moments(task: RobotTask, seed: int) -> Generator[Moment, None, None]:
    """Let the initial policy, tanh of N(0, 1), act in a task in lockstep, episode after episode."""
    spec = task.spec
    cycle_ns = round(spec.action_cycle_time_s * 1e9)
    rng = np.random.default_rng(seed)
    task.advance_to(0)
    task.begin_episode()
    frame = task.read().frames[-1]
    attempt_steps = 0
    with closing(_room_camera(task.robot)) as room:
        for cycle in range(1, round(DURATION_S / spec.action_cycle_time_s) + 1):
            task.command(_random_action(spec, rng))
            task.advance_to(cycle * cycle_ns)
            attempt_steps += 1
            new = task.read().frames
            frame = new[-1] if len(new) else frame
            mask = None if task.TARGET_RANGE is None else colour_mask(frame, task.TARGET_RANGE)
            at_goal = task.outcome().terminated
            yield Moment(cycle * spec.action_cycle_time_s, frame, mask, room.picture(task.robot.data), at_goal)
            if at_goal or attempt_steps == spec.time_limit_steps:
                task.begin_attempt() if spec.has_goal and not at_goal else task.begin_episode()
                frame = task.read().frames[-1]
                attempt_steps = 0


def _random_action(spec: TaskSpec, rng: np.random.Generator) -> np.ndarray:
    middle, half = (spec.action_high + spec.action_low) / 2, (spec.action_high - spec.action_low) / 2
    action: np.ndarray = middle + half * np.tanh(rng.standard_normal(len(half), np.float32))
    return action


def _room_camera(robot: SimulatedRobot) -> OffscreenCamera:
    """The model's camera that shows the robot from outside; if it has none, one that shows everything."""
    model = robot.model
    names = {model.camera(number).name for number in range(model.ncam)}
    window = Window(0, 0, ROOM_HEIGHT, ROOM_WIDTH, ROOM_HEIGHT, ROOM_WIDTH)
    return OffscreenCamera(model, window, ROOM_CAMERA if ROOM_CAMERA in names else None, effects=True)


def _label(moment: Moment) -> str:
    text = f"{moment.time_s:.2f} s"
    if moment.mask is not None:
        text += f"   target: {100 * float(moment.mask.mean()):.1f} % of the image"
    return text + ("   goal" if moment.at_goal else "")


def _task(options: argparse.Namespace) -> RobotTask:
    name, equals, target = options.task.partition("=")
    overrides: dict[str, Any] = {}
    for override in options.set:
        section, key, value = parse_override(override)
        if section != "task":
            raise ConfigError(f"--set {override}: only settings of the task count here: expected task.key=value")
        overrides[key] = value
    rows = {name: target} if equals else {}
    preset = str(overrides.pop("preset", options.preset))
    task = load_task(name, preset, overrides, rows, rng=np.random.default_rng(options.seed))
    if not isinstance(task, RobotTask):
        task.close()
        raise ConfigError(f"--task {name}: it is no simulated robot: expected one such as ur5_visual_reacher")
    return task


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m {PROGRAM}",
        description="Let a random policy act on a simulated robot; write a video DIR/T.mp4 and a contact sheet "
        "DIR/T.png of what the agent sees, what of it is taken for the target, and the robot from outside.",
        epilog=f"example: python -m {PROGRAM} --task ur5_visual_reacher_min_time --preview runs/preview",
    )
    parser.add_argument("--task", required=True, metavar="T", help="task id, or id=module:Class for one of your own")
    parser.add_argument("--preview", required=True, type=output_folder, metavar="DIR", help="for video and sheet")
    parser.add_argument("--preset", default="", metavar="NAME", help="of the task (default: the task's first)")
    parser.add_argument("--set", action="append", default=[], metavar="task.KEY=VALUE", help="override a setting")
    parser.add_argument("--seed", type=_seed, default=0, metavar="N", help="of everything random (default: 0)")
    return parser


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a whole number, 0 or more, got {text}")
    return int(text)
