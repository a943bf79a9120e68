"""The step of the action that judges: runs pytest and ``consistency``, and writes the job summary and the outputs.

Reads its inputs from the environment. Exit status 0 if all is well, 1 if a gate fails, 2 if an input cannot be used.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

FAILED = {
    "tests": "an estimator test failed",
    "consistent": "an estimator is not consistent",
    "no worse": "an estimator is less consistent than before",
}  # by what should have passed
FAIL_ON = ("inconsistent", "worse", "nothing")
NO_TESTS = 5  # exit status of pytest
OF_ANALYSE = ("--confidence", "--detect", "--innovations", "--tolerance")  # which compare has not
Data = dict[str, Any]


class Unusable(Exception):
    """An input that cannot be used; says which, and what to do."""


class Inputs(NamedTuple):
    tests: list[str]
    estimates: list[str]
    options: list[str]
    compare_with: str
    fail_on: str
    report: Path


class Row(NamedTuple):
    """A line of the table in the summary."""

    what: str
    verdict: str
    ratio: str
    runs: str
    why: str


def read_inputs() -> Inputs:
    def words(name: str) -> list[str]:
        try:
            return shlex.split(os.environ.get(name, ""))
        except ValueError as error:
            raise Unusable(f"{name.lower()}: {error}; quotes must be closed") from None

    estimates = [line.strip() for line in os.environ.get("ESTIMATES", "").splitlines() if line.strip()]
    given = Inputs(
        words("TESTS"), estimates, words("OPTIONS"), os.environ.get("COMPARE_WITH", "").strip(),
        os.environ.get("FAIL_ON", FAIL_ON[0]), Path(os.environ.get("REPORT") or "consistency-report").absolute(),
    )  # fmt: skip
    if not given.tests and not given.estimates:
        raise Unusable("neither tests nor estimates are given; name one of them, such as tests: tests")
    if given.fail_on not in FAIL_ON:
        raise Unusable(f"fail-on: must be one of {', '.join(FAIL_ON)}, got '{given.fail_on}'")
    if given.compare_with and len(given.estimates) != 1:
        raise Unusable(f"compare-with: needs one entry of estimates, got {len(given.estimates)}")
    if given.fail_on == "worse" and not given.compare_with:
        raise Unusable("fail-on: worse than what? Name a baseline in compare-with")
    for name, path in [("estimates", one) for one in estimates] + [("compare-with", given.compare_with or ".")]:
        if not Path(path).exists():
            raise Unusable(f"{name}: {path}: no such file or folder in {Path.cwd()}; write it in a step before")
    if given.report.exists() and not given.report.is_dir():
        raise Unusable(f"report: {given.report} is not a folder; name another")
    return given


def plain(text: str) -> str:
    """Text on one line, without control characters."""
    return " ".join("".join(char if char.isprintable() else " " for char in text).split())


@contextmanager
def no_commands() -> Iterator[None]:
    """What goes to the log inside is no workflow command of the runner, whatever a line begins with."""
    mark = uuid.uuid4().hex
    print(f"::stop-commands::{mark}", flush=True)
    try:
        yield
    finally:
        print(f"::{mark}::", flush=True)


def run(*words: str, capture: bool = True) -> tuple[int, str]:
    """Exit status of a Python module, and its output unless that goes to the log, as what it says on stderr does.

    Only a module whose output goes to the log, which is pytest, may give the runner commands.
    """
    with no_commands() if capture else nullcontext():
        print("+", plain(shlex.join(words)), flush=True)
        pipe = subprocess.PIPE if capture else None
        done = subprocess.run([sys.executable, "-m", *words], stdout=pipe, text=True, check=False)
    return done.returncode, done.stdout or ""


def ratio(value: float | None, interval: list[float | None] | None) -> str:
    if value is None or not interval or None in interval:
        return ""
    return f"x{value:.3g} [{interval[0]:.3g}, {interval[1]:.3g}]"


def expected(gate: Data) -> str:
    """Of a negative control: the gate found a fault, as its test wants."""
    return " (expected)" if gate["outcome"] != "passed" and gate["test_outcome"] == "passed" else ""


def run_tests(given: Inputs) -> tuple[bool, list[Row]]:
    """Whether they pass, and a row for each gate."""
    path = given.report / "gates.json"
    path.unlink(missing_ok=True)
    status, _ = run("pytest", *given.tests, "--consistency-report", str(path), capture=False)
    if status not in (0, 1) or not path.exists():
        why = "no test was found" if status == NO_TESTS else f"pytest ended with exit status {status}; the log says why"
        raise Unusable(f"tests: {shlex.join(given.tests)}: {why}")
    gates: list[Data] = json.loads(path.read_text(encoding="utf-8"))["gates"]
    if not gates and not status:
        raise Unusable(f"tests: {shlex.join(given.tests)}: no gate ran; call assert_consistent in a test")
    rows = [
        Row(
            gate["test"], gate["status"] + expected(gate), ratio(gate["inflation"], gate["inflation_interval"]),
            str(gate["runs"]), gate["reasons"][0],
        )
        for gate in gates
    ]  # fmt: skip
    if status and all(gate["test_outcome"] == "passed" for gate in gates):
        rows.append(Row(shlex.join(given.tests), "failed", "", "", "a test without a gate failed; the log says which"))
    return status == 0, rows


def judge(given: Inputs, estimates: str) -> tuple[bool, list[Row]]:
    """Whether they are consistent, and a row for each filter in them."""
    page = given.report / "-".join(part for part in Path(estimates).with_suffix("").parts if part not in ("/", ".."))
    words = ["consistency", "analyse", *given.options, "--json", "--fail-on", "inconsistent"]
    if not (Path(estimates) / "estimates.parquet").exists():  # of `consistency run`, which has a report of its own
        words += ["--report", str(page), "--overwrite"]
    status, said = run(*words, "--", estimates)
    if status not in (0, 1):
        raise Unusable(f"estimates: {estimates}: exit status {status}; the log says why")
    verdicts: dict[str, Data] = json.loads(said)
    rows = []
    for name, verdict in verdicts.items():
        of = verdict["statistics"]
        value = ratio(of.get("ratio"), of.get("ratio_interval"))
        rows.append(Row(f"{estimates}: {name}", verdict["status"], value, str(of["runs"]), verdict["reasons"][0]))
    return status == 0, rows


def shared(options: list[str]) -> list[str]:
    """Those of the options of ``analyse`` that ``compare`` has, too."""
    pairs = zip(["", *options], options, strict=False)
    return [word for last, word in pairs if last not in OF_ANALYSE and word.split("=")[0] not in OF_ANALYSE]


def compare(given: Inputs, estimates: str) -> tuple[bool, list[Row]]:
    """Whether they are no worse than the baseline, and a row for each filter."""
    options = ["--json", "--fail-on", "worse", *shared(given.options)]
    words = ["consistency", "compare", *options, "--", estimates, given.compare_with]
    status, said = run(*words)
    if status not in (0, 1):
        raise Unusable(f"compare-with: {given.compare_with}: exit status {status}; the log says why")
    rows = [
        Row(f"{estimates} against {given.compare_with}", "worse" if one["worse"] else "not worse", "",
            str(one["runs"]), one["sentence"])
        for one in json.loads(said)
    ]  # fmt: skip
    return status == 0, rows


def markdown(verdict: str, rows: list[Row], why: str = "") -> str:
    """The summary of the job."""
    from consistency.referee.show.as_md import render
    from consistency.referee.show.blocks import Column, Document, table

    heads = tuple(map(Column, ("what", "verdict", "ratio of covariances", "runs", "why")))
    return render(Document(f"Consistency: {verdict}", why, (), (table(heads, rows, "Verdicts"),) if rows else ()))


def append(variable: str, text: str) -> None:
    """To one of the files that GitHub names in the environment; to the log where it names none."""
    if path := os.environ.get(variable):
        with open(path, "a", encoding="utf-8") as file:
            file.write(text)
    else:
        print(text)


def output(name: str, value: str) -> None:
    mark = uuid.uuid4().hex  # so that no value can end its own block
    append("GITHUB_OUTPUT", f"{name}<<{mark}\n{value}\n{mark}\n")


def finish(verdict: str, rows: list[Row], why: str = "") -> None:
    append("GITHUB_STEP_SUMMARY", markdown(verdict, rows, why))
    output("verdict", verdict)


def main() -> int:
    rows: list[Row] = []
    passed = {"tests": True, "consistent": True, "no worse": True}
    try:
        given = read_inputs()
        given.report.mkdir(parents=True, exist_ok=True)
        output("report", str(given.report))
        if given.tests:
            passed["tests"], found = run_tests(given)
            rows += found
        for estimates in given.estimates:
            good, found = judge(given, estimates)
            passed["consistent"] &= good
            rows += found
        if given.compare_with:
            passed["no worse"], found = compare(given, *given.estimates)
            rows += found
    except Unusable as error:
        print(f"::error title=Consistency gate::{plain(str(error)).replace('%', '%25')}")
        finish("unusable", rows, str(error))
        return 2
    tolerated = "consistent" if given.fail_on == "worse" else ""
    failed = [name for name, good in passed.items() if not good and name != tolerated]
    finish("fail" if failed else "pass", rows)
    with no_commands():
        for row in rows:
            print(plain(f"{row.what}: {row.verdict} - {row.why}"))
    if failed:
        why = ", ".join(FAILED[name] for name in failed)
        print(f"::error title=Consistency gate::{why}; the summary has the verdicts")
    return 1 if failed and given.fail_on != "nothing" else 0


if __name__ == "__main__":
    sys.exit(main())
