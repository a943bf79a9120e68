"""Documents of small files as they were: words and keys exactly, numbers to 1e-9, on every version of the libraries.

``python tests/referee/test_goldens.py`` writes ``goldens.json`` anew.
"""

import contextlib
import io
import json
import os
import tempfile
from pathlib import Path

import inputs
import pytest

from consistency.commands import main

GOLDENS = Path(__file__).with_name("goldens.json")
COMMANDS = {
    "consistent": "analyse fair.csv --truth truth.csv --json",
    "overconfident": "analyse bold.csv --truth truth.csv --json",
    "conservative": "analyse shy.csv --truth truth.csv --tolerance 1.1 --skip 1 --json",
    "innovations": "analyse gains.csv --truth truth.csv --innovations optimal --json",
    "in space": "analyse est --truth true --covariance cov --error so3 --json",
    "fitted": "analyse est --truth true --covariance cov --error so3 --align posyaw --json",
    "arrays": "analyse errors.npz --detect 1.2 --json",
    "windows": "analyse drive.csv --truth driven.csv --relative 20 --motions --json",
    "worse": "compare bold.csv fair.csv --truth truth.csv --json",
    "monitored": "monitor gains.csv --run 3 --innovations optimal --json",
    "planned": "plan --dof 6 --json",
}


def consistency(folder, command):
    """What a command prints as JSON."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
            main(command.split())
    finally:
        os.chdir(before)
    return json.loads(out.getvalue())


def write(at):
    for name, scale in (("fair", 1.0), ("bold", 1.6), ("shy", 0.6)):
        inputs.planar(at, name, scale)
    inputs.planar(at, "gains", 1.1, optimal=True)
    inputs.trajectories(at)
    inputs.archive(at)
    inputs.drive(at)
    return at


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write(tmp_path_factory.mktemp("goldens"))


def differences(now, before, place=""):
    """Places where two documents differ: in a key, a word, or a number by more than 1e-9, beyond 1 of its size.

    Student's quantiles of SciPy before 1.12 are right to 1e-9. The sign of an eigenvector is left to LAPACK.
    """
    if isinstance(before, dict) and isinstance(now, dict):
        if list(now) != list(before):
            return [f"{place}: keys {list(now)}, not {list(before)}"]
        now, before = turned(now), turned(before)
        return [line for key in before for line in differences(now[key], before[key], f"{place}.{key}")]
    if isinstance(before, list) and isinstance(now, list) and len(now) == len(before):
        return [
            line for k, pair in enumerate(zip(now, before, strict=True)) for line in differences(*pair, f"{place}[{k}]")
        ]
    if isinstance(before, float) and isinstance(now, (int, float)) and not isinstance(now, bool):
        return [] if abs(now - before) <= 1e-9 * max(1.0, abs(before)) else [f"{place}: {now!r}, not {before!r}"]
    return [] if type(now) is type(before) and now == before else [f"{place}: {now!r}, not {before!r}"]


def turned(document):
    direction = document.get("largest_direction")
    if not direction or max(direction, key=abs) > 0.0:
        return document
    return {**document, "largest_direction": [-value for value in direction]}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_document_is_as_it_was(name, folder):
    before = json.loads(GOLDENS.read_text(encoding="utf-8"))
    assert list(before) == list(COMMANDS)
    assert differences(consistency(folder, COMMANDS[name]), before[name]) == []


def test_differences_are_found():
    assert differences({"largest_direction": [0.8, -0.6]}, {"largest_direction": [-0.8, 0.6]}) == []
    assert len(differences({"largest_direction": [0.8, 0.6]}, {"largest_direction": [-0.8, 0.6]})) == 1
    before = {"a": [1.0, "x", None], "b": 2}
    assert differences({"a": [1.0 + 1e-12, "x", None], "b": 2}, before) == []
    for now in (
        {"a": [1.0 + 1e-8, "x", None], "b": 2}, {"a": [1.0, "y", None], "b": 2}, {"a": [1.0, "x"], "b": 2},
        {"a": [1.0, "x", None], "b": 3}, {"a": [1.0, "x", None], "c": 2}, {"b": 2, "a": [1.0, "x", None]},
    ):  # fmt: skip
        assert len(differences(now, before)) == 1


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        at = write(Path(name))
        documents = {name: consistency(at, command) for name, command in COMMANDS.items()}
        GOLDENS.write_text(json.dumps(documents, indent=1) + "\n", encoding="utf-8")
