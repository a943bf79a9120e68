"""The C++ example of docs/any-program.md: the page shows what is in the files, and its commands do what it says."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from documents import ROOT, blocks, typed

EXAMPLE = ROOT / "docs/examples/cpp"
PAGE, PART = "docs/any-program.md", "A Kalman filter in C++"
BIN = Path(sys.executable).parent


def require(*programs):
    """Skip the test where one is missing, but not in CI."""
    missing = [program for program in programs if not shutil.which(program)]
    if missing and os.environ.get("CONSISTENCY_REQUIRE_CPP") == "1":
        pytest.fail(f"CONSISTENCY_REQUIRE_CPP=1, but not on the PATH: {', '.join(missing)}")
    if missing:
        pytest.skip(f"builds C++, and this machine lacks {', '.join(missing)}")


def shell(text, folder, path=BIN):
    environment = os.environ | {"PATH": f"{path}{os.pathsep}{os.environ['PATH']}"}
    return subprocess.run(["sh", "-c", text], cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


def commands_of_the_page():
    """To compile, to run with the right and with half of the noise, to configure, to build, to test."""
    return [command.text for block in blocks(PAGE, "indented", part=PART) for command in typed(block)]


@pytest.fixture
def folder(tmp_path):
    """The example where a new user has copied it."""
    return Path(shutil.copytree(EXAMPLE, tmp_path / "my kalman"))


def test_right_and_halved_noise(folder):
    """False-alarm rate 0: the seed of the runs is fixed."""
    require("c++")
    compile_it, right, halved, *_ = commands_of_the_page()
    done = shell(f"{compile_it} -Wall -Wextra -Werror", folder)
    assert (done.returncode, done.stderr) == (0, "")
    shown = [line for block in blocks(PAGE, "text", part=PART) for line in block.text.splitlines() if " is " in line]
    for command, status, line in zip((right, halved), (0, 1), shown, strict=True):
        done = shell(command, folder)
        assert done.returncode == status, done.stderr
        assert re.match(r"\D*", line)[0] in done.stdout  # the numbers are those of one standard library of C++


@pytest.mark.slow
def test_the_gates_of_the_page(folder):
    """In pytest, CTest and GoogleTest, the last where it is installed. False-alarm rate 0: the seeds are fixed."""
    require("c++", "cmake", "ctest", "make")
    compile_it, _, _, configure, build, test = commands_of_the_page()
    (block,) = blocks(PAGE, "python", part=PART)
    (folder / "test_kalman.py").write_text(block.text)
    done = shell(f"{compile_it} && python -m pytest -q -p no:cacheprovider test_kalman.py", folder)
    assert "1 passed" in done.stdout

    done = shell(f"{configure} && {build} && {test} --verbose", folder)
    assert done.returncode == 0, done.stdout + done.stderr
    first, *_ = re.findall(r"is consistent: .*", done.stdout)
    assert first in shell(f"{test} --verbose -R 'gate$'", folder).stdout

    source = folder / "kalman.cpp"
    source.write_text(source.read_text().replace("double Q = 1.0;", "double Q = 0.5;"))
    done = shell(f"{build} && {test}", folder)
    assert done.returncode
    assert re.search(r"is overconfident: covariance too small by x1\.[3-7]", done.stdout)
    failed = set(re.findall(r"- (\w+) \(Failed\)", done.stdout))
    assert failed == set(re.findall(r"Test +#\d+: (\w+)", done.stdout))


def test_what_the_page_shows_is_in_the_files():
    shown = [block.text for block in blocks(PAGE, "text", part=PART)]
    for name, begin in (("CMakeLists.txt", "add_test("), ("gate_test.cpp", "TEST(")):
        (excerpt,) = (text for text in shown if text.startswith(begin))
        assert excerpt in (EXAMPLE / name).read_text()


def test_a_node_that_died_is_seen(tmp_path):
    """The wrapper of ROS 2, with a stand-in for ``ros2``."""
    (script,) = (block.text for block in blocks(PAGE, "text", part="ROS 2") if block.text.startswith("#!/bin/bash"))
    for name, text in (
        ("run.sh", script),
        ("ros2", '#!/bin/sh\necho "$@ in $ROS_DOMAIN_ID"\ncat said\nexit $(cat status)\n'),
    ):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    died, well = "[ERROR] [ekf-1]: process has died", "[INFO] [ekf-1]: process has finished cleanly"
    for said, launched, status in ((well, 0, 0), (died, 0, 1), (well, 1, 1)):
        (tmp_path / "said").write_text(said)
        (tmp_path / "status").write_text(str(launched))
        done = shell("./run.sh 7 3", tmp_path, tmp_path)
        assert done.returncode == status
        assert "seed:=7 in 53" in done.stdout
