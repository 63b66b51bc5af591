"""docs/robots.md: every simulated robot is on it, to be looked at."""

import pytest

from services.robot_bridge.robots import franka, ur5
from services.robot_bridge.tasks.robot_task import RobotTask
from tests.conformance.test_tasks import BUILT
from tests.docs.task_pages import Page

PAGE = Page("robots.md")


def test_every_simulated_robots_task_is_there_with_its_contact_sheet():
    for name, task in BUILT.items():
        if isinstance(task, RobotTask):
            assert f"[`{name}`](pictures/sheets/{name}.png)" in PAGE.text


@pytest.mark.parametrize(("name", "arm", "rest"), [("UR5", ur5, "| stands still | |"), ("Franka", franka, "|")])
def test_joints_turn_back_where_the_page_says(name, arm, rest):
    lowest, highest = arm.ANGLE_LOW.round(3), arm.ANGLE_HIGH.round(3)
    ranges = " | ".join(f"{low:g}…{high:g}" for low, high in zip(lowest, highest, strict=True))
    assert f"| {name} | {ranges} {rest}\n" in PAGE.text


def test_files_the_page_links_to_exist():
    assert not PAGE.missing_files()
