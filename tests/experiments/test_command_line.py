"""How a program's end is told: its own exit code, or what went wrong and by which option it can be changed."""

import errno
import os
from pathlib import Path

import pytest

from common.console import Console
from common.errors import ConfigError
from experiments.command_line import exit_code


def end(run, folder):
    return exit_code("experiments.some", "--out", folder, Console(), run)


def failing(error):
    def run():
        raise error

    return run


def refused(number, filename=None):
    return OSError(number, os.strerror(number), filename)


def test_a_program_that_comes_to_its_end_gives_its_own_code(tmp_path, capsys):
    assert [end(lambda code=code: code, tmp_path) for code in (0, 1, 130)] == [0, 1, 130]
    assert capsys.readouterr() == ("", "")


def test_ctrl_c_before_there_is_anything_to_keep_is_no_traceback(tmp_path, capsys):
    assert end(failing(KeyboardInterrupt()), tmp_path) == 130
    assert capsys.readouterr().out == "interrupted before anything was begun\n"


def test_an_error_of_ours_is_a_line(tmp_path, capsys):
    assert end(failing(ConfigError("--steps 0: expected at least 1")), tmp_path) == 1
    assert capsys.readouterr().err == "experiments.some: error: --steps 0: expected at least 1\n"


@pytest.mark.parametrize(
    ("number", "filename", "said"),
    [
        (errno.EEXIST, "{out}", "--out {out}: File exists; choose another folder with --out"),
        (
            errno.EACCES,
            "{out}/runs/x",
            "--out {out}: {out}/runs/x: Permission denied; choose another folder with --out",
        ),
        (errno.EACCES, "{parent}", "--out {out}: {parent}: Permission denied; choose another folder with --out"),
        (errno.ENOSPC, None, "--out {out}: No space left on device; choose another folder with --out"),
        (errno.ENOENT, "/somewhere/else", "/somewhere/else: No such file or directory"),
    ],
)
def test_what_the_system_refuses_names_the_option_if_it_is_about_the_folder(tmp_path, capsys, number, filename, said):
    out = tmp_path / "out"
    names = {"out": str(out), "parent": str(tmp_path)}
    assert end(failing(refused(number, filename and filename.format(**names))), out) == 1
    assert capsys.readouterr().err == f"experiments.some: error: {said.format(**names)}\n"


def test_a_folder_may_be_given_relative_to_here(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert end(failing(refused(errno.EACCES, str(tmp_path / "out" / "x"))), Path("out")) == 1
    assert "error: --out out: " in capsys.readouterr().err
