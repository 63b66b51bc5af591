"""docs/robots.md: every simulated robot is on it, to be looked at."""

from services.robot_bridge.tasks.robot_task import RobotTask
from tests.conformance.test_tasks import BUILT
from tests.docs.task_pages import Page

PAGE = Page("robots.md")


def test_every_simulated_robots_task_is_there_with_its_contact_sheet():
    for name, task in BUILT.items():
        if isinstance(task, RobotTask):
            assert f"[`{name}`](pictures/sheets/{name}.png)" in PAGE.text


def test_files_the_page_links_to_exist():
    assert not PAGE.missing_files()
