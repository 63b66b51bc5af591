"""The ids that Gymnasium knows without an import of ours, in an interpreter that has done nothing else yet."""

import subprocess
import sys
from importlib.metadata import entry_points

import gymnasium
import pytest
from relod_gymnasium import register_on_import

from services.robot_bridge.gymnasium_ids import gymnasium_id, register_tasks, tasks_by_id
from services.robot_bridge.tasks import TASKS


def run(code, directory):
    """Run Python outside of the repository, with warnings as errors; return what it printed."""
    process = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=directory,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    return process.stdout.splitlines()


@pytest.mark.parametrize(
    ("task", "expected"),
    [
        ("dot_reacher", "relod/DotReacher-v0"),
        ("visual_dot_reacher", "relod/VisualDotReacher-v0"),
        ("reacher_easy_visual", "relod/ReacherEasyVisual-v0"),
    ],
)
def test_an_id_is_the_task_id_in_camel_case(task, expected):
    assert gymnasium_id(task) == expected


def test_every_task_has_an_id_but_the_load_for_links_and_buffers():
    assert set(TASKS) - set(tasks_by_id().values()) == {"noise_frames"}
    assert len(tasks_by_id()) == len(TASKS) - 1


def test_gymnasium_alone_knows_all_ids(tmp_path):
    printed = run(
        "import gymnasium; print(*(i for i in gymnasium.registry if i.startswith('relod/')), sep='\\n')", tmp_path
    )
    assert printed == list(tasks_by_id())


def test_registration_imports_no_task_and_no_simulator(tmp_path):
    code = "import gymnasium, sys; print(*sys.modules, sep='\\n')"
    imported = set(run(code, tmp_path))
    assert "services.robot_bridge.tasks" in imported
    tasks = {row.partition(":")[0] for row in TASKS.values()}
    assert not imported & {*tasks, "torch", "mujoco", "dm_control", "cv2", "services.robot_bridge.gymnasium_env"}


def test_starting_python_imports_nothing_heavy(tmp_path):
    imported = run("import sys; print(*sys.modules, sep='\\n')", tmp_path)
    assert "relod_gymnasium" in imported
    # Nor anything of ours: a program that starts in another checkout must find its own.
    assert not {"gymnasium", "numpy", "common", "services"} & set(imported)


def test_looking_for_gymnasium_is_not_importing_it(tmp_path):
    code = """
import importlib.util, sys
assert importlib.util.find_spec("gymnasium").submodule_search_locations
before = len(sys.meta_path)
import gymnasium
print("relod/DotReacher-v0" in gymnasium.registry, before - len(sys.meta_path), vars(gymnasium.__spec__.loader).keys())
"""
    assert run(code, tmp_path) == ["True 1 dict_keys(['name', 'path'])"]


def test_a_module_can_be_named_with_the_id(tmp_path):
    code = """
import gymnasium
for identifier in [i for i in gymnasium.registry if i.startswith("relod/")]:
    del gymnasium.registry[identifier]
made = gymnasium.make("services.robot_bridge.gymnasium_env:relod/DotReacher-v0")
print(made.spec.id)
"""
    assert run(code, tmp_path) == ["relod/DotReacher-v0"]


def test_the_distribution_has_an_entry_point_that_registers():
    (entry_point,) = entry_points(group="gymnasium.envs", name="relod")
    assert entry_point.dist.name == "relod"
    assert entry_point.load() is register_tasks


def test_registering_again_changes_nothing():
    register_tasks()
    before = {identifier: gymnasium.registry[identifier] for identifier in tasks_by_id()}
    register_tasks()
    register_on_import()
    assert all(gymnasium.registry[identifier] is spec for identifier, spec in before.items())
