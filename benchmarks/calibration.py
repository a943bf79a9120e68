"""Does the referee keep its promises? False alarms, power and wrong all-clears, counted over thousands of verdicts.

``make calibrate`` measures all rows and writes reports/reference/calibration.json, which the appendix of every report
shows, and the table of
docs/reference/rates.md. ``make calibrate-quick`` measures fewer gates of fewer rows with fresh random
numbers, writes nothing, and fails where a promise is broken: by chance less than once in 5,000 runs.

Worlds are in ``calibration_worlds.py`` and promises in ``calibration_cases.py``; ``calibration_monitor.py`` and
``calibration_compare.py`` have those on the monitor and on comparisons, ``calibration_questions.py`` those on questions
that are hard to keep a rate with.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
from calibration_cases import DETECT, MOST, POWER, QUICK_FAILURE, Case, cases, quick_cases, quick_confidence
from calibration_gates import DOF, SEED, STEPS, Draw, Gate, joined
from calibration_rows import CONFIDENCE, Row, document, kept, merged, percentage, write_docs
from calibration_worlds import HEAVY, LOGS, POOL, WORLDS
from script_options import options_of

import consistency as cs
from consistency.bench.runs.results_to_records import record_of
from consistency.diagnostics import Settings, Verdict, e_process, follow, judge, make_record, sequential_design
from consistency.referee.diagnostics.nees import nees
from consistency.referee.types import Array

MANY = 10**9  # gates: no limit
BATCH = 25  # gates handed to a worker at once
CLEAR = 50  # gates after which a quick row ends where its promise is kept as far as it has come
CHUNK = 2000  # runs of the Kalman filter in memory at once
POOLED, QUICK_POOLED = 54_000, 5_000  # of them in all: as many as the false alarms at 1 %, or 50 quick gates, take
MODULES = (
    "calibration_monitor",
    "calibration_compare",
    "calibration_map",
    "calibration_lost",
    "calibration_questions",
    "calibration_windows",
    "calibration_truth",
    "calibration_pieces",
    "calibration_uneven",
    "calibration_lengths",
    "calibration_spread",
    "calibration_groups",
    "calibration_bounds",
    "calibration_factors",
    "calibration_independent",
    "calibration_members",
)  # each: rows(quick, seed), and ABOUT, its worlds and questions
ANY = WORLDS | LOGS | HEAVY


@dataclass(frozen=True)
class Outcome:
    """What became of one gate."""

    status: str
    fault: bool
    wrong_scale: bool  # of whole trajectories, found
    located: bool  # an axis, or a late start, was named
    runs: int  # that it took


COUNTED: dict[str, Callable[[Outcome], bool]] = {
    "fault": lambda o: o.fault,
    "consistent": lambda o: o.status == "consistent",
    "overconfident": lambda o: o.status == "overconfident",
    "conservative": lambda o: o.status == "conservative",
    "scale": lambda o: o.status in ("overconfident", "conservative"),
    "wrong scale": lambda o: o.wrong_scale,
    "located": lambda o: o.located,
}


# --- the referee --------------------------------------------------------------------------------------------


def _evidence_values(means: Array, dof: int) -> Array:
    """E-values after each run, from run means of the NEES over its degrees of freedom."""
    return e_process(means, dof).both


def _outcome(verdict: Verdict, runs: int) -> Outcome:
    since = None if verdict.location is None else verdict.location.since
    located = verdict.subset is not None or since is not None
    return Outcome(verdict.status, bool(verdict.faults), "scale" in verdict.faults, located, runs)


# --- gates --------------------------------------------------------------------------------------------------


class Growing:
    """Runs of one gate, drawn when they are asked for."""

    def __init__(self, case: Case, number: int, seed: int) -> None:
        self.case = case
        self.first = number * case.runs
        key = zlib.crc32(f"{case.world} {case.ratio} {case.mode} {case.runs} {case.false_alarm} {case.steps}".encode())
        self.rng = np.random.default_rng((seed, key, number))
        self.parts: list[Gate] = []
        self.drawn = 0

    def __call__(self, runs: int) -> Gate:
        """The gate of the first ``runs`` runs."""
        if runs > self.drawn:
            draw = Draw(self.rng, runs - self.drawn, self.case.steps, self.first + self.drawn)
            self.parts = [joined([*self.parts, ANY[self.case.world].draw(draw).wrong_by(self.case.ratio)])]
            self.drawn = runs
        (gate,) = self.parts
        return gate if runs == self.drawn else gate.first(runs)


def judged(case: Case, numbers: Sequence[int], seed: int) -> list[Outcome]:
    """Outcomes of the gates with these numbers: a gate depends on the seed, its case and its number alone."""
    of_mode = {"gate": _at_once, "until decided": _until_decided, "e-process": _betting}[case.mode]
    return [of_mode(case, Growing(case, number, seed)) for number in numbers]


def _at_once(case: Case, gate_of: Growing) -> Outcome:
    evidence = make_record("gate", **vars(gate_of(case.runs)))
    return _outcome(judge(evidence, Settings(case.false_alarm, DETECT, POWER)), case.runs)


def _until_decided(case: Case, gate_of: Growing) -> Outcome:
    """The verdict of ``--until-decided``, and the runs it took."""
    design = sequential_design(ANY[case.world].dof or DOF, DETECT, case.false_alarm, POWER, MOST)
    return _outcome(*follow(design, lambda runs: make_record("gate", **vars(gate_of(runs)))))


def _betting(case: Case, gate_of: Growing) -> Outcome:
    gate, dof = gate_of(case.runs), ANY[case.world].dof
    assert dof is not None
    means = run_means(gate) / dof
    crossed = np.flatnonzero(_evidence_values(means, dof) >= 1.0 / case.false_alarm)
    if not len(crossed):
        return Outcome("undecided", False, False, False, case.runs)
    runs = int(crossed[0]) + 1
    return Outcome("overconfident" if means[:runs].mean() > 1.0 else "conservative", True, True, False, runs)


def run_means(gate: Gate) -> Array:
    """Mean NEES of each run over the steps it has, (R,)."""
    values = gate.nees
    if values is None:
        assert gate.error is not None
        assert gate.covariance is not None
        there = np.isfinite(gate.error).all(axis=-1)
        values = np.full(there.shape, np.nan)
        values[there] = nees(gate.error[there], gate.covariance[there])
    return np.asarray(np.nanmean(values, axis=1))


# --- rows ---------------------------------------------------------------------------------------------------


def measure(
    every: Sequence[Case], seed: int = SEED, workers: int = 2, pooled: int = POOLED, quick: bool = False
) -> Iterator[Row]:
    """Rows of the cases, in their order, as they are done.

    Quick ones end when no share is on the wrong side of its promise, after 50 gates at the earliest: that breaks no
    promise which is kept, and a rate of 15 % for 5 % then passes once in 70 rows.
    """
    wanted = max((case.gates * case.runs for case in every if case.world == "linear-gaussian"), default=0)
    with tempfile.TemporaryDirectory() as folder:
        pool_file = _kalman_runs(min(wanted, pooled), seed, Path(folder)) if wanted else None
        with ProcessPoolExecutor(workers, initializer=_share, initargs=(pool_file,)) as pool:
            batches = [
                [pool.submit(_until_clear, case, seed)]
                if quick
                else [pool.submit(judged, case, numbers, seed) for numbers in batches_of(case)]
                for case in every
            ]
            for case, futures in zip(every, batches, strict=True):
                yield from rows_of_case(case, [outcome for future in futures for outcome in future.result()])


def batches_of(case: Case) -> list[range]:
    """Numbers of the gates, in order."""
    return [range(k, min(k + BATCH, case.gates)) for k in range(0, case.gates, BATCH)]


def _until_clear(case: Case, seed: int) -> list[Outcome]:
    """In a worker, which no gates wait for that a row has no need of."""
    outcomes: list[Outcome] = []
    for numbers in batches_of(case):
        outcomes += judged(case, numbers, seed)
        if len(outcomes) >= CLEAR and all(map(is_kept_so_far, rows_of_case(case, outcomes))):
            break
    return outcomes


def is_kept_so_far(row: Row) -> bool:
    share = row.found / row.gates
    return share <= row.stated if row.bound == "<=" else share >= row.stated


def rows_of_case(case: Case, outcomes: Sequence[Outcome]) -> list[Row]:
    took = np.array([outcome.runs for outcome in outcomes])
    return [
        Row(
            case.world, claim.question, case.ratio, case.runs, int(case.mode == "gate"), claim.stated, claim.bound,
            len(outcomes), sum(map(COUNTED[claim.counted], outcomes)),
            round(float(took.mean()), 1), float(np.quantile(took, 0.95, method="higher")),
        )
        for claim in case.claims
    ]  # fmt: skip


def _kalman_runs(count: int, seed: int, folder: Path) -> Path:
    """Errors (count, T, 3) of the exact Kalman filter and the covariance that all its runs share, into a folder.

    From the first step on in which that is of full rank.
    """
    scenario = cs.load_scenario("linear-gaussian").variant("linear-gaussian-short", truth__steps=STEPS + 1)
    errors = []
    for chunk in range(-(-count // CHUNK)):
        runs = min(CHUNK, count - chunk * CHUNK)
        of_chunk = int(np.random.default_rng((seed, chunk)).integers(2**31))
        c = record_of(cs.run_trials(scenario, ["kf"], runs=runs, seed=of_chunk), "kf")
        assert c.errors.error is not None
        covariance = np.asarray(c.errors.covariance)
        assert (covariance == covariance[0]).all()
        errors.append(c.errors.error[:, 1:])
    np.save(folder / "covariance.npy", covariance[0, 1:])
    np.save(folder / "error.npy", np.concatenate(errors))
    return folder


def _share(folder: Path | None) -> None:
    """In a worker: the runs of the pool."""
    if folder is not None:
        error = np.load(folder / "error.npy", mmap_mode="r")
        POOL["linear-gaussian"] = error, np.load(folder / "covariance.npy")


def further_rows(
    quick: bool, seed: int, workers: int = 2, modules: Sequence[str] | None = None, **some: Any
) -> tuple[list[Row], dict[str, str]]:
    """Rows of other ``modules`` (all unless given), one a worker, and what their worlds and questions are.

    ``some`` are further arguments of their rows, as ``only``.
    """
    there = [name for name in modules or MODULES if importlib.util.find_spec(name) is not None]
    rows: list[Row] = []
    about: dict[str, str] = {}
    with ProcessPoolExecutor(workers) as pool:
        for found, its in pool.map(_rows_of, there, repeat(quick), repeat(seed), repeat(some)):
            rows += [Row(**row) for row in found]
            about |= its
    return rows, about


def _rows_of(name: str, quick: bool, seed: int, some: dict[str, Any]) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """In a worker: what a module measures."""
    module = importlib.import_module(name)
    return module.rows(quick, seed, **some), module.ABOUT


# --- command ------------------------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write what is asked for, and say whether all promises are kept."""
    options = _options(arguments)
    fresh = int(np.random.SeedSequence().generate_state(1)[0])
    seed = options.seed if options.seed is not None else fresh if options.quick else SEED
    print(f"seed {seed}", flush=True)
    started = time.monotonic()
    rows, about = _measured(options, seed)
    seconds = round(time.monotonic() - started, 1)
    table = document(rows, about, seed=seed, wall_time_s=seconds)
    if (options.module or options.only) and options.out is not None:
        table = merged(json.loads(options.out.read_text(encoding="utf-8")), rows, about)
    if options.out is not None:
        options.out.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    if options.docs is not None:
        write_docs(table, options.docs)
    broken = [row for row in rows if not kept(row, quick_confidence(len(rows)) if options.quick else CONFIDENCE)]
    chance = f" (by chance: less than once in {1 / QUICK_FAILURE:,.0f} runs)" if options.quick else ""
    print(f"{seconds} s, {len(rows)} rows, promises broken: {len(broken)}{chance}", *map(said, broken), sep="\n")
    return int(bool(broken))


def _measured(options: argparse.Namespace, seed: int) -> tuple[list[Row], dict[str, str]]:
    """All rows that are asked for, each printed as it comes, and what further worlds are."""
    every = (
        []
        if options.module
        else [
            replace(case, gates=min(case.gates, options.gates))
            for case in (quick_cases() if options.quick else cases())
            if options.only in f"{case.world} {case.claims}"
        ]
    )
    rows = []
    pooled = QUICK_POOLED if options.quick else POOLED
    for row in measure(every, seed, options.workers, pooled, options.quick):
        rows.append(row)
        print(said(row), flush=True)
    modules = options.module or MODULES
    some: dict[str, Any] = {"only": options.only} if options.only else {}
    if options.module and options.gates < MANY:
        some["most"] = options.gates
    further, about = (
        further_rows(options.quick, seed, options.workers, modules, **some)
        if options.module or not options.only
        else ([], {})
    )
    for row in further:
        print(said(row), flush=True)
    return rows + further, about


def said(row: Row) -> str:
    runs = f"{row.runs} runs" if row.looks == 1 else f"{row.mean_runs:.0f} runs, 95 %: {row.late_runs:.0f}"
    return (
        f"{row.question:<28} {row.world:<24} x{row.ratio:<5.3g} {runs:<20} "
        f"{row.bound} {100 * row.stated:g} %: {percentage(row)} of {row.gates}"
    )


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    return options_of(
        "Measure the rates of the referee.",
        arguments,
        quick=(False, "fewer gates of fewer rows, with fresh random numbers"),
        out=(Path, "JSON file to write"),
        docs=(Path, "document whose table to replace"),
        only=("", "rows whose world or question contains this text, put into --out; of a --module its worlds"),
        module=(str, "rows of this module alone, put into --out", {"action": "append", "choices": MODULES}),
        gates=(MANY, "of a row, at most"),
        seed=(int, None),
        workers=(2, None),
    )


if __name__ == "__main__":
    sys.exit(main())
