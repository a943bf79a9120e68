"""``consistency monte-carlo`` of a program that copies ready tables: false alarms, our own time for a run, SIGKILL.

    python benchmarks/programs.py                         # 400 studies of either kind: an hour on two idle cores
    python benchmarks/programs.py --studies 0 --kills 0   # the time for a run alone: a minute

The tables have Gaussian errors of the stated covariance, so that every fault that is found is a false alarm. Exit
status 1 where more are found than a rate of 5 % gives with probability 0.99, or where a study that was killed and
resumed differs from one that was not.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats
from script_options import options_of

import consistency as cs
from consistency.referee.programs.process import program_of
from consistency.referee.programs.study import ProgramPlan, run_study
from consistency.referee.readers.options import make_reading
from consistency.referee.readers.pipeline.program_runs import ProgramRuns
from consistency.referee.system import quiet

STATE = ("a", "b", "c")
STEPS = 10
RATE = 0.05
HEAD = "step,a,b,c,true_a,true_b,true_c,P_a_a,P_a_b,P_a_c,P_b_b,P_b_c,P_c_c"
COPY = ("cp", "{here}/tables/{run}.csv", "estimates.csv")


def write_tables(folder: Path, runs: int, draws: np.random.Generator) -> None:
    """tables/0.csv, ...: a filter that is right, of three components that depend on each other over the steps."""
    shutil.rmtree(folder / "tables", ignore_errors=True)
    (folder / "tables").mkdir()
    root = np.linalg.cholesky(np.array([[1.0, 0.3, 0.0], [0.3, 2.0, -0.4], [0.0, -0.4, 0.5]]))
    P = root @ root.T
    triangle = ",".join(map(repr, P[np.triu_indices(3)].tolist()))
    for run in range(runs):
        errors = np.empty((STEPS, 3))
        white = draws.normal(size=(STEPS, 3))
        errors[0] = white[0]
        for step in range(1, STEPS):
            errors[step] = 0.8 * errors[step - 1] + 0.6 * white[step]
        truth = draws.normal(size=(STEPS, 3)).cumsum(axis=0)
        both = np.hstack([truth - errors @ root.T, truth]).tolist()
        rows = [f"{step + 1},{','.join(map(repr, row))},{triangle}" for step, row in enumerate(both)]
        (folder / "tables" / f"{run}.csv").write_text("\n".join([HEAD, *rows]) + "\n")


def false_alarms(studies: int, until_decided: bool, draws: np.random.Generator) -> bool:
    """Count the faults found in so many studies; whether they are as few as the rate allows."""
    counts: Counter[str] = Counter()
    for _ in range(studies):
        write_tables(Path.cwd(), 400, draws)
        verdict = cs.monte_carlo(
            COPY, state=STATE, until_decided=until_decided, max_runs=400 if until_decided else None
        )
        counts[verdict.status] += 1
    found = studies - counts["consistent"] - counts["undecided"]
    most = int(stats.binom.ppf(0.99, studies, RATE))
    how = "until decided" if until_decided else "planned number of runs"
    print(f"{how}: {found} false alarms in {studies} studies, at most {most} at a rate of {RATE:g}; {dict(counts)}")
    return found <= most


def time_for_a_run(runs: int) -> None:
    """Processor time of this process for each run, with reading and judging told apart."""
    write_tables(Path.cwd(), runs, np.random.default_rng(0))
    spent: Counter[str] = Counter()

    def timed(call: Callable[..., Any], name: str) -> Callable[..., Any]:
        def inner(*given: Any) -> Any:
            start = time.thread_time()
            try:
                return call(*given)
            finally:
                spent[name] += time.thread_time() - start  # type: ignore[assignment]
                spent[f"calls of {name}"] += 1

        return inner

    ProgramRuns.take = timed(ProgramRuns.take, "reading")  # type: ignore[method-assign]
    ProgramRuns.estimators = timed(ProgramRuns.estimators, "merging")  # type: ignore[method-assign]
    before = resource.getrusage(resource.RUSAGE_SELF)
    with tempfile.TemporaryDirectory() as place:
        plan = ProgramPlan(runs, jobs=1)
        run_study(program_of(COPY, Path.cwd()), plan, Path(place) / "out", reading=make_reading(state=STATE))
    after = resource.getrusage(resource.RUSAGE_SELF)
    whole = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    rest = whole - spent["reading"]
    print(
        f"{runs} runs: {1e3 * rest / runs:.2f} ms of our processor time a run with judging and without reading; "
        f"{1e3 * spent['reading'] / runs:.2f} ms for reading, {spent['calls of reading'] / runs:g} times a run"
    )


def same_after_a_kill(kills: int) -> bool:
    """Kill the command at random times and resume it; whether tables and verdict are always those of a whole study."""
    write_tables(Path.cwd(), 120, np.random.default_rng(0))
    words = [sys.executable, "-m", "consistency", "monte-carlo", "--state", ",".join(STATE), "--runs", "120", "--json"]
    start = time.monotonic()
    whole = subprocess.run([*words, "--out", "whole", "--", *COPY], capture_output=True, check=True)
    lasts, same = time.monotonic() - start, 0
    for _ in range(kills):
        shutil.rmtree("killed", ignore_errors=True)
        command = subprocess.Popen([*words, "--out", "killed", "--", *COPY], stdout=-3, stderr=-3)
        time.sleep(random.uniform(0.0, lasts))
        command.kill()
        command.wait()
        resumed = subprocess.run([*words, "--out", "killed", "--resume", "--", *COPY], capture_output=True, check=False)
        same += resumed.stdout == whole.stdout and tables_of("killed") == tables_of("whole")
    print(f"{same} of {kills} studies that were killed and resumed are the same as one that was not")
    return same == kills


def tables_of(folder: str) -> dict[int, bytes]:
    found = {}
    for path in Path(folder).glob("runs/*/run.json"):
        found[json.loads(path.read_text())["run"]] = (path.parent / "estimates.csv").read_bytes()
    return found


def main() -> int:
    options = options_of(
        __doc__,
        studies=(400, "studies of either kind"),
        kills=(20, "commands that are killed"),
        runs=(1000, "runs that are timed"),
        seed=(0, "seed of the tables"),
    )
    good = True
    with tempfile.TemporaryDirectory() as place, quiet():
        os.chdir(place)
        time_for_a_run(options.runs)
        if options.kills:
            good &= same_after_a_kill(options.kills)
        draws = np.random.default_rng(options.seed)
        for until_decided in (False, True) if options.studies else ():
            good &= false_alarms(options.studies, until_decided, draws)
        os.chdir("/")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
