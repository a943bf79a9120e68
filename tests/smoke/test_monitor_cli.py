"""``consistency monitor`` as a newcomer types it, in a process of its own, from an empty folder."""

import json
import subprocess
import sys

import pytest
from own_process import consistency

OPTIMAL = ("--innovations", "optimal")


@pytest.fixture
def folder(tmp_path):
    """``good.csv``, whose NIS is always the expected one, and ``bad.csv``, where it is 4 times that from row 101 on."""
    for name, ratio in (("good", 1.0), ("bad", 4.0)):
        rows = "".join(f"{k / 10},{2.0 if k <= 100 else 2.0 * ratio},2\n" for k in range(1, 201))
        (tmp_path / f"{name}.csv").write_text("t,nis,nis_dof\n" + rows)
    return tmp_path


def test_a_log_without_an_alarm(folder):
    done = consistency("monitor", "good.csv", *OPTIMAL, "--fail-on", "alarm", cwd=folder)
    assert "no alarm" in done.stdout
    assert "says anything about the pose" in done.stdout
    assert not done.stderr


def test_an_alarm_with_plot_json_and_status(folder):
    options = ("--tolerance", "1", "--false-alarm", "0.01", "--plot", "new/plot.png", "--json")
    done = consistency("monitor", "bad.csv", *OPTIMAL, *options, cwd=folder)
    data = json.loads(done.stdout)
    assert (data["alarm"]["since"], data["alarm"]["since_t"]) == (101, 10.1)
    assert (data["tolerance"], data["threshold"]) == (1.0, 100.0)
    assert (folder / "new/plot.png").stat().st_size > 10_000
    consistency("monitor", "bad.csv", *OPTIMAL, *options, cwd=folder, status=2)  # the plot is there
    done = consistency(
        "monitor", "bad.csv", *OPTIMAL, *options, "--overwrite", "--fail-on", "alarm", cwd=folder, status=1
    )
    assert json.loads(done.stdout) == data
    done = consistency("monitor", "bad.csv", *OPTIMAL, "--gate", "0.99", "--mission", "500", "--json", cwd=folder)
    data = json.loads(done.stdout)
    assert (data["gate"], data["mission"]) == (0.99, 500)


def test_lines_as_they_come(folder):
    """The alarm is there before the stream ends."""
    command = [sys.executable, "-m", "consistency", "monitor", "-", *OPTIMAL, "--fail-on", "alarm"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=folder, text=True, **pipes) as process:  # type: ignore[call-overload]
        process.stdin.write((folder / "bad.csv").read_text())
        process.stdin.flush()
        assert "overconfident since step 101" in process.stderr.readline()
        process.stdin.write("20.1,2.0,2\n")
        out, _ = process.communicate(timeout=60)
        assert process.returncode == 1
    assert " 201 " in out


@pytest.mark.parametrize(
    "arguments, said",
    [
        (("good.csv",), "--innovations must be 'optimal'"),
        (("good.csv", "--innovations", "fixed"), "--innovations must be 'optimal', got 'fixed'"),
        (("none.csv", *OPTIMAL), "none.csv: no such file"),
        (("good.csv", *OPTIMAL, "--gate", "0.5"), "--gate must be a probability of at least 0.95"),
        (("good.csv", *OPTIMAL, "--fail-on", "fault"), "--fail-on must be 'alarm'"),
        (("good.csv", *OPTIMAL, "--plot", "plot.jpg"), "must end in .png"),
        (("-", *OPTIMAL, "--plot", "plot.png"), "--plot: does not go with lines as they come"),
        ((".", *OPTIMAL), "manifest"),
    ],
)
def test_bad_input(refused, arguments, said, folder):
    assert said in refused(folder, "monitor", *arguments)
