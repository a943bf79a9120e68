"""What ``make`` installs for a target, and what it says where that cannot be done."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def checkout(tmp_path):
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    return tmp_path


def make(folder, *words):
    return subprocess.run(["make", *words], cwd=folder, capture_output=True, text=True)


def extras(folder, target):
    return re.findall(r'-e "\.\[(.*)\]"', make(folder, "-n", target).stdout)


@pytest.mark.parametrize("target, what", [("reproduce", "bench,report"), ("test", "dev"), (".venv/.done", "dev")])
def test_a_target_installs_what_it_needs(checkout, target, what):
    assert extras(checkout, target) == [what]


def test_the_tests_environment_has_what_reproduce_needs_and_not_the_reverse(checkout):
    python = checkout / "python"  # makes an environment of nothing
    made = f"mkdir -p .venv/bin && ln -sf {shutil.which('true')} .venv/bin/python"
    python.write_text(f'#!/bin/sh\n[ "$1" = -c ] || {{ {made}; }}\n')
    python.chmod(0o755)
    assert make(checkout, ".venv/.lab", f"PYTHON={python}").returncode == 0
    assert extras(checkout, "reproduce") == []
    assert extras(checkout, "test") == ["dev"]
    (checkout / ".venv/.lab").unlink()
    assert make(checkout, ".venv/.done", f"PYTHON={python}").returncode == 0
    assert extras(checkout, "reproduce") == []
    assert extras(checkout, "test") == []


def test_a_python_without_venv_is_told_in_one_line(checkout):
    done = make(checkout, "reproduce", "PYTHON=false")
    assert done.returncode == 2
    assert "false cannot make a virtual environment" in done.stderr.splitlines()[0]
    assert "apt install python3-venv" in done.stderr.splitlines()[0]
    assert "-m venv" not in done.stdout
    assert not (checkout / ".venv").exists()


def test_what_the_first_commands_of_the_readme_write_is_ignored_by_git():
    """The files of the example, the report, and what its pages name."""
    ignored = (ROOT / ".gitignore").read_text("utf-8").splitlines()
    assert {"/estimates.csv", "/truth.csv", "/look/"} <= set(ignored)
