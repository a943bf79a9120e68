"""N runs of a program: done in parallel, read as they come, judged, and kept in a folder that is resumed."""

from __future__ import annotations

import itertools
import json
import os
import queue
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.diagnostics.judge_record import judge, looks, progress_text
from consistency.referee.diagnostics.planning import Design, sequential_design
from consistency.referee.diagnostics.record import Record, Skip
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.diagnostics.verdict_parts import Settings
from consistency.referee.errors import InputError, naming_arguments
from consistency.referee.gating.checked_input import planned_dof, planned_runs
from consistency.referee.parsing import one_line
from consistency.referee.programs.process import (
    OF_A_RUN,
    Processes,
    Program,
    Stopped,
    inputs_of,
    program_of,
    run_program,
    seed_of,
)
from consistency.referee.readers.options import VALUES, Reading, make_reading
from consistency.referee.readers.pipeline.program_runs import (
    PATHS,
    ProgramRun,
    ProgramRuns,
    ProgramStudy,
    filled,
    is_recorded,
    kind_of_failure,
    log_lines,
    runs_in,
    study_in,
    without_log,
)
from consistency.referee.readers.pipeline.read_files import (
    GUESS,
    PROGRAM_RUNS,
    checked_options,
    found_in,
    is_program_runs,
    records_of_found,
)
from consistency.referee.readers.truth_matching import Estimator
from consistency.referee.system import IN_PYTHON, PARTIAL, Advance, manifest_of, progress, say, write_whole, writing
from consistency.referee.verdicts.judge_sources import settings_of, skip_asked

FOR_STUDY = ("each", "cwd", "skip", "resume", "overwrite")  # options beside those of the plan and of files
FOR_PLAN = ("until_decided", "max_runs", "seed", "jobs", "timeout", "check_seed", "keep", "optimal_gain")
ALIKE = 3  # first runs that failed alike stop a study
HOPELESS = 20  # and so many that failed in any way
IS_WINDOWS = os.name == "nt"
PROOF = 2  # first runs whose tables must differ
LOCK = ".lock"
SAME = {  # keys of the manifest that a resumed study must have, and what they are called
    "words": "the words of the command have",
    "files": "{} has",
    "seed": "--seed has",
    "inputs": "the files of --each have",
    "cwd": "--cwd has",
}


@naming_arguments
def monte_carlo(
    argv: Sequence[str],
    runs: int | None = None,
    *,
    estimates: str = "estimates.csv",
    truth: str | Path | None = None,
    out: str | Path | None = None,
    each: str | None = None,
    filter: str | None = None,
    until_decided: bool = False,
    max_runs: int | None = None,
    seed: int = 0,
    jobs: int = -1,
    timeout: float | None = None,
    cwd: str | Path | None = None,
    check_seed: bool = False,
    keep: str = "all",
    resume: bool = False,
    overwrite: bool = False,
    optimal_gain: bool = False,
    skip: str | float | None = None,
    false_alarm: float | None = None,
    detect: float | None = None,
    power: float | None = None,
    tolerance: float | None = None,
    allow: str | None = None,
    lost: float | None = None,
    **reading: Any,
) -> Verdict:
    """Run any program many times, as ``consistency monte-carlo`` does, and judge the estimates that it writes.

    A filter in Python has :func:`consistency.run_trials`, a simulation :mod:`consistency.testing`.

    Parameters
    ----------
    argv : words of the command, the program first. In each run ``{run}``, ``{seed}`` (an integer from 1 to 2^31 - 1),
        ``{out}`` (the folder of the run, in which the program is started), ``{here}`` (the present folder) and
        ``{worker}`` are replaced; all other braces stay. No shell sees them
    runs : number of runs; as many as a verdict takes for the errors of the first run if not given
    estimates, truth : files that the program writes in the folder of a run; a truth of ``{here}/truth.csv`` serves all
        runs, and a table may have the truth in columns beside the estimates
    out : folder of the runs, which must not exist; a temporary one if not given
    each : pattern of recorded files or folders, with a run for each of them in place of ``runs``: ``{input}`` and, its
        name without suffix, ``{name}``
    filter : which estimator, where the tables hold several
    until_decided, max_runs : as many runs as the verdict takes, at looks whose error rates hold together
    seed : number from which the seeds of all runs follow
    jobs : runs at a time; -1 is one a core
    timeout : s a run, after which it is killed
    cwd : working folder of the program
    check_seed : do run 0 twice, and say whether its tables are the same
    keep : "failed" deletes the files of other runs when their numbers were read
    resume, overwrite : do the runs that are missing in ``out``; replace it
    optimal_gain, skip, false_alarm, detect, power, tolerance, allow, lost : as for :func:`consistency.judge`
    reading : further options of :func:`consistency.read`, as ``state`` or ``error``

    Raises
    ------
    InputError
        There is no such program; ``out`` cannot be used; the first runs all failed alike or wrote the same table; as
        :func:`consistency.read`.
    """
    settings = settings_of(
        false_alarm=false_alarm, detect=detect, power=power, tolerance=tolerance, allow=allow, lost=lost
    )
    options: dict[str, Any] = {
        "each": each, "cwd": cwd, "resume": resume, "overwrite": overwrite, "skip": skip,
        "until_decided": until_decided, "max_runs": max_runs, "seed": seed, "jobs": jobs, "timeout": timeout,
        "check_seed": check_seed, "keep": keep, "optimal_gain": optimal_gain,
    }  # fmt: skip
    records, verdicts = _run(argv, settings, runs, estimates, truth, out, options | reading)
    record = _chosen(records, filter)
    return verdicts[record.name]


def record_of_program(
    argv: Sequence[str],
    settings: Settings,
    runs: int | None,
    estimates: str,
    truth: str | Path | None,
    out: str | Path | None,
    filter: str | None,
    options: Mapping[str, Any],
) -> Record:
    """Record of the runs of a program, whose number follows from the settings; as :func:`monte_carlo`."""
    records, _ = _run(argv, settings, runs, estimates, truth, out, options)
    return _chosen(records, filter)


def _run(
    argv: Sequence[str],
    settings: Settings,
    runs: int | None,
    estimates: str,
    truth: str | Path | None,
    out: str | Path | None,
    options: Mapping[str, Any],
) -> tuple[list[Record], dict[str, Verdict]]:
    here = Path.cwd()
    of_plan = {name: value for name, value in options.items() if name in FOR_PLAN}
    of_files: dict[str, Any] = {}
    for name, value in options.items():
        if name in VALUES:
            of_files[name] = value
        elif name not in (*FOR_PLAN, *FOR_STUDY):
            raise TypeError(f"monte_carlo: unknown option '{name}'")
    of_files["truth"] = truth
    for name in PATHS:
        if of_files.get(name) is not None:
            of_files[name] = Path(of_files[name])
    each, cwd, skip, resume, overwrite = map(options.get, FOR_STUDY)
    if cwd is not None:
        cwd = Path(cwd)
    program = program_of(argv, here, cwd)
    inputs = () if each is None else inputs_of(each, here)
    plan = ProgramPlan(runs, inputs=inputs, settings=settings, skip=skip_asked(skip), **of_plan)
    reading = make_reading(**of_files)
    if out is not None:
        return run_study(program, plan, Path(out), estimates, reading, bool(resume), bool(overwrite))
    with tempfile.TemporaryDirectory(prefix="consistency-") as folder:
        return run_study(program, plan, Path(folder) / "runs", estimates, reading, bool(resume), bool(overwrite))


def _chosen(records: Sequence[Record], name: str | None) -> Record:
    """The record of the estimator of that name, or of the only one."""
    named = {record.name: record for record in records}
    if name is None and len(named) > 1:
        raise InputError(f"the program writes several estimators ({', '.join(named)}); choose one with filter=")
    if name is not None and name not in named:
        raise InputError(f"filter '{name}' is not in the estimates; there are: {', '.join(named)}")
    return named[name or next(iter(named))]


@dataclass(frozen=True)
class ProgramPlan:
    """How many runs there are, and how each is done and judged."""

    runs: int | None = None  # None: as many as a verdict takes, planned from the first run
    until_decided: bool = False
    max_runs: int | None = None
    seed: int = 0
    jobs: int = -1
    timeout: float | None = None  # s
    check_seed: bool = False
    keep: str = "all"  # files of the runs; "failed" keeps only the numbers of the others
    inputs: Sequence[Path] = ()  # recorded files or folders, one for each run
    settings: Settings = field(default_factory=Settings)
    skip: Skip | None = None
    optimal_gain: bool = False

    @property
    def workers(self) -> int:
        """Number of runs at a time."""
        if self.jobs != -1:
            return self.jobs
        if hasattr(os, "sched_getaffinity"):
            return len(os.sched_getaffinity(0))
        return os.cpu_count() or 1


def run_study(
    program: Program,
    plan: ProgramPlan,
    out: Path,
    estimates: str = "estimates.csv",
    reading: Reading | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> tuple[list[Record], dict[str, Verdict]]:
    """Run a program N times, each in a folder of its own in ``out``, and judge what it wrote.

    Parameters
    ----------
    estimates : file of the estimates in the folder of a run, with placeholders
    reading : options of that file

    Returns
    -------
    A record and a verdict for each estimator

    Raises
    ------
    InputError
        Options that do not go together; ``out`` cannot be used; the first runs all failed alike, or wrote the same
        table; no run can be judged.
    """
    r = _required(plan, reading or Reading())
    require_usable(out, resume, overwrite)
    _require_paths(program, plan, estimates, r)
    if resume and not out.exists():
        say(f"consistency: --resume: {out} is not there yet; all runs are done")
    out = Path(os.path.abspath(out))
    program.warn_of_relative_paths()
    if not program.uses_run:
        what = "{input}" if plan.inputs else "{seed}"
        say(
            f"consistency: no word of the command holds {what}; runs then differ only if the program reads it by itself"
        )
    about = _manifest(program, plan, estimates, r)
    with opened_study(out, about, resume) as study:
        loop = _Loop(program, plan, study, r, about)
        loop.do_runs()
        records, verdicts = loop.judged()
        write_manifest(out, {**loop.fields, "complete": True})
    return records, verdicts


def _required(plan: ProgramPlan, r: Reading) -> Reading:
    """The options, checked before any work."""
    if plan.runs is not None and plan.runs < 1:
        raise InputError(f"--runs must be at least 1, got {plan.runs}")
    if plan.seed < 0:
        raise InputError(f"--seed must be 0 or more, got {plan.seed}")
    if plan.jobs == 0 or plan.jobs < -1:
        raise InputError(f"--jobs must be at least 1, or -1 for one a core, got {plan.jobs}")
    if plan.timeout is not None and not 0.0 < plan.timeout < 1e9:
        raise InputError(f"--timeout must be a positive number of seconds, got {plan.timeout:g}")
    if plan.until_decided and plan.runs is not None:
        raise InputError("--until-decided finds the number of runs; give --max-runs instead of --runs")
    if plan.keep not in ("all", "failed"):
        raise InputError(f"--keep must be 'all' or 'failed', got '{plan.keep}'")
    if plan.max_runs is not None and not plan.until_decided:
        raise InputError("--max-runs goes with --until-decided")
    if plan.inputs and (plan.runs is not None or plan.until_decided):
        raise InputError("--runs and --until-decided do not go with --each, which has a run for each file")
    if r.conventions.error == GUESS:
        raise InputError(f"--error {GUESS}: goes with 'consistency analyse DIR' when the runs are there")
    if r.sources.repeats:
        raise InputError("--truth repeats: monte-carlo takes runs with a truth; put the estimates of all runs into one "
                         "table, with a column run, for 'consistency analyse TABLE --truth repeats'")  # fmt: skip
    if IS_WINDOWS:
        raise InputError("monte-carlo needs process groups of POSIX; on Windows run it in WSL")
    return checked_options(r)


def _require_paths(program: Program, plan: ProgramPlan, estimates: str, r: Reading) -> None:
    """Refuse one file for all runs, a placeholder without its option, and a truth that is not where it should be."""
    for part in ("{input}", "{name}"):
        if not plan.inputs and any(part in word for word in program.words):
            raise InputError(f"{part} in the command needs --each 'FILES'")
    here = {"here": str(program.here)}
    if Path(filled(estimates, here)).is_absolute() and not any(part in estimates for part in OF_A_RUN):
        raise InputError(f"--estimates {estimates}: is one file for all runs; let the program write into {{out}}")
    for name in PATHS:
        path = r.option(name)
        if path is None:
            continue
        inputs = [here | {"input": str(each), "name": each.stem} for each in plan.inputs]
        if not is_recorded(str(path)):
            inputs = [here] if Path(filled(str(path), here)).is_absolute() else []
        found = [program.here / filled(str(path), values) for values in inputs]
        missing = [each for each in found if "{" not in str(each) and not each.exists()]
        if missing:
            more = f" (nor are {len(missing) - 1} others)" if len(missing) > 1 else ""
            raise InputError(f"--{name}: {missing[0]} is not there{more}")


def _manifest(program: Program, plan: ProgramPlan, estimates: str, r: Reading) -> dict[str, Any]:
    reading = {name: str(value) if name in PATHS else value for name, value in r.as_options().items()}
    here = program.here
    return {
        "program": program.name, "words": list(program.words),
        "files": program.files(), "cwd": program.cwd and str(program.cwd),
        "seed": plan.seed, "inputs": [os.path.relpath(path, here) for path in plan.inputs] or None,
        "estimates": estimates, "reading": reading, "runs": plan.runs, "until_decided": None, "complete": False,
        "keep": plan.keep, "settings": {key: value for key, value in vars(plan.settings).items() if value is not None},
        "skip": plan.skip and plan.skip.option, "optimal_gain": plan.optimal_gain,
    }  # fmt: skip


class _Loop:
    """Runs in progress and done, and what is known of them so far."""

    def __init__(
        self, program: Program, plan: ProgramPlan, study: ProgramStudy, r: Reading, fields: dict[str, Any]
    ) -> None:
        self.program, self.plan, self.study, self.options = program, plan, study, r
        self.fields = fields  # of the manifest
        self.runs = ProgramRuns(study, r, found_in)
        self.logs: dict[int, ProgramRun] = {}
        self.total = len(plan.inputs) or plan.runs
        self.design: Design | None = None
        self.names: list[str] = []
        self.decided: dict[str, Verdict] = {}
        self.counts: Iterator[int] = iter(())
        self.next_look: int | None = None
        self.advance: Advance | None = None
        self.processes = Processes()
        self.idle: queue.SimpleQueue[int] = queue.SimpleQueue()

    def do_runs(self) -> None:
        """Do the runs that are missing.

        Raises
        ------
        InputError
            The first runs all failed alike, or wrote the same table, or none can be judged.
        """
        with ExitStack() as stack:
            for run in runs_in(self.study.folder).values():
                self._take(run, stack)
            self._start_all(stack)
        if not self.runs.found:
            raise self._all_failed()

    def _start_all(self, stack: ExitStack) -> None:
        workers = self.plan.workers
        for worker in range(workers):
            self.idle.put(worker)
        missing = (run for run in itertools.count() if run not in self.logs)
        pending: set[Future[ProgramRun]] = set()
        pool = stack.enter_context(ThreadPoolExecutor(workers))
        try:
            if self.plan.check_seed:
                self._check_seed(stack)
            run = next(missing)
            while not self._is_decided:
                at_once = workers
                if len(self.runs.found) < PROOF:  # the first ones are to show that the program works
                    at_once = min(workers, PROOF)
                while len(pending) < at_once and (self.total is None or run < self.total):
                    pending.add(pool.submit(self._done, run, new_folder(self.study.folder, run)))
                    run = next(missing)
                if not pending:
                    break
                finished, pending = wait(pending, return_when=FIRST_COMPLETED)
                for future in finished:
                    self._take(future.result(), stack)
        finally:
            self.processes.close()  # also runs beyond the one that decided
            pool.shutdown(cancel_futures=True)

    @property
    def _is_decided(self) -> bool:
        return bool(self.names) and len(self.decided) == len(self.names)

    def _done(self, run: int, folder: Path) -> ProgramRun:
        """Do a run, in a thread."""
        worker = self.idle.get()
        values = {
            "run": str(run), "seed": str(seed_of(self.plan.seed, run)), "out": str(folder),
            "here": str(self.program.here), "worker": str(worker),
        }  # fmt: skip
        if self.plan.inputs:
            path = self.plan.inputs[run]
            values |= {"input": str(path), "name": path.stem}
        try:
            return run_program(self.program, folder, run, values, self.plan.timeout, self.processes)
        except Stopped:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            self.idle.put(worker)

    # --- what a run says -----------------------------------------------------------------------------

    def _take(self, run: ProgramRun, stack: ExitStack) -> None:
        """Read a finished run, stop where the program cannot work, and look if it is time."""
        self.logs[run.run] = run
        records = self.runs.take(run)
        if records and self.plan.keep == "failed" and not any(record.failures for record in records):
            self.runs.delete_files(run)
        if records and not self.names:
            self._plan_runs(records, stack)
        elif self.advance is not None:
            self.advance(1)
        if self._is_hopeless:
            raise self._all_failed()
        if len(self.runs.found) == PROOF and records:
            self._require_different()
        while self.next_look is not None and self.runs.first >= self.next_look:
            runs = self.next_look
            self.next_look = next(self.counts, None)
            say(f"{runs} runs: {progress_text(self.decided, self.names)}")

    def _plan_runs(self, records: Sequence[Record], stack: ExitStack) -> None:
        """Plan the number of runs, or looks, from the dimension of the first run's errors."""
        settings = self.plan.settings
        self.names = [record.name for record in records]
        planned = max(planned_runs(record, settings, settings.false_alarm) for record in records)
        if self.plan.until_decided:
            _require_looks(records)
            dof = min(planned_dof(record) for record in records)
            looked: dict[str, Any] = {
                "dof": dof, "detect": settings.detect, "false_alarm": settings.false_alarm, "power": settings.power,
                "max_runs": self.plan.max_runs,
            }  # fmt: skip
            looked |= {} if settings.lost is None else {"lost": settings.lost}
            self.design = sequential_design(**looked)
            self.counts = looks(self.design, self.names, self._record, self.decided)
            self.next_look = next(self.counts)
            self.total = self.plan.max_runs
            self.fields |= {"until_decided": looked}
        else:
            self.total = max(self.total or planned, len(runs_in(self.study.folder)))
        self.fields |= {"runs": self.total}
        write_manifest(self.study.folder, self.fields)
        self.advance = stack.enter_context(progress("runs", self.total or planned))
        if self.total is None or len(self.logs) < self.total:
            self.advance(len(self.logs))

    def _record(self, runs: int, name: str) -> Record:
        """Record of the first runs of an estimator."""
        return next(record for record in self._records(runs) if record.name == name)

    def _records(self, runs: int | None) -> list[Record]:
        records = records_of_found(self.runs.estimators(runs), self.options)
        records = [record.without_first(self.plan.skip) for record in records]
        if self.plan.optimal_gain:
            records = [record.with_optimal_gain() for record in records]
        return records

    def judged(self) -> tuple[list[Record], dict[str, Verdict]]:
        """Records and verdicts of all runs; those of a study until decided up to the first missing run."""
        records = self._records(self.runs.first if self.design else None)
        return records, {record.name: judge(record, self.plan.settings, self.design, True) for record in records}

    # --- programs that cannot work -------------------------------------------------------------------

    @property
    def _is_hopeless(self) -> bool:
        """Whether the first runs have all failed, alike or many of them."""
        failed = self.runs.failed
        if self.runs.found or len(failed) < ALIKE:
            return False
        return len(failed) >= HOPELESS or len(set(map(kind_of_failure, failed.values()))) == 1

    def _all_failed(self) -> InputError:
        """Message that no run can be judged, after the last lines of the first one's log."""
        first, why = min(self.runs.failed.items())
        log = self.logs[first].log
        for line in log_lines(log, 10):
            say(f"  {line}")
        count = len(self.runs.failed)
        which = f"the first {count} runs failed" if count > 1 else "the first run failed"
        return InputError(f"{which}: {without_log(why)}; the log is {log}")

    def _require_different(self) -> None:
        (one, first), (other, second) = sorted(self.runs.found.items())[:PROOF]
        if not _are_same(first, second):
            return
        what = "{input}" if self.plan.inputs else "{seed}"
        raise InputError(f"runs {one} and {other} wrote the same table; does your program use {what}?")

    def _check_seed(self, stack: ExitStack) -> None:
        """Do run 0 twice, and say whether its tables are the same."""
        if 0 not in self.logs:
            self._take(self._done(0, new_folder(self.study.folder, 0)), stack)
        folder = self.study.folder / "run 0 again"
        shutil.rmtree(folder, ignore_errors=True)
        again = ProgramRuns(self.study, self.options, found_in)
        again.take(self._done(0, folder))
        shutil.rmtree(folder, ignore_errors=True)
        if 0 not in self.runs.found or 0 not in again.found:
            say("--check-seed: run 0 failed, so that its tables cannot be compared")
        elif _are_same(self.runs.found[0], again.found[0]):
            say("--check-seed: run 0 done twice gave the same table; the program is reproducible")
        else:
            say("--check-seed: run 0 done twice gave different tables; the program is not reproducible by {seed}")


def _require_looks(records: Sequence[Record]) -> None:
    """Refuse records whose verdict has no form for looks at growing numbers of runs."""
    for record in records:
        if (
            record.errors.bounded
            or record.errors.ensemble is not None
            or record.errors.parts
            or record.runs.independent
            or record.origin.unshown
            or record.truth.covariance is not None
        ):
            what = "bounds, members, components, windows or a truth that are judged by themselves"
            raise InputError(f"--until-decided: {record.name} has {what}; give --runs")


def _are_same(one: Sequence[Estimator], other: Sequence[Estimator]) -> bool:
    """Whether two runs have the same estimates and truth, to the last digit."""
    return [_digits(each) for each in one] == [_digits(each) for each in other]


def _digits(one: Estimator) -> list[bytes]:
    p = one.runs[0]
    arrays = (p.own.t, p.own.estimate, p.true.values, p.own.nis)
    return [np.ascontiguousarray(array).tobytes() for array in arrays if array is not None]


def require_usable(folder: Path, resume: bool, overwrite: bool) -> None:
    """Refuse, before any work, a folder that is not to be written.

    Raises
    ------
    InputError
        It exists without ``resume`` or ``overwrite``, is not a folder of this command, or cannot be written.
    """
    if resume and overwrite:
        raise InputError("--resume continues with what --overwrite would replace; give one of them")
    try:
        there = folder.exists() or folder.is_symlink()
    except (OSError, ValueError) as error:
        raise InputError(f"--out {one_line(folder)}: no folder can have that name ({one_line(error, 60)})") from None
    if not there:
        return
    if not folder.is_dir() or not (is_program_runs(folder) or _is_begun(folder)):
        raise InputError(f"--out {folder}: is not a folder of 'consistency monte-carlo'; name another one")
    if not (resume or overwrite or _is_begun(folder)):
        raise InputError(
            f"--out {folder}: exists already; choose another folder, or add --resume or --overwrite {IN_PYTHON}"
        )


def _is_begun(folder: Path) -> bool:
    """Whether a folder is empty, or that of a command that was killed before it wrote a manifest."""
    names = [path.name for path in folder.iterdir()]
    return all(name == LOCK or name.endswith(PARTIAL) for name in names)


@contextmanager
def opened_study(folder: Path, manifest: Mapping[str, Any], resume: bool) -> Iterator[ProgramStudy]:
    """The folder with its manifest, locked; without ``resume`` runs that it held are removed.

    Raises
    ------
    InputError
        Another process works on it, it cannot be written, or the study to resume is another one.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder):
        if resume and is_program_runs(folder):
            before = study_in(folder).manifest
            for key, what in SAME.items():
                if before.get(key) != manifest.get(key):
                    what = what.format(_changed(before.get(key), manifest.get(key)))
                    raise InputError(f"--resume: {what} changed since the runs in {folder}; use --overwrite")
        else:
            aside = folder / f".replaced-{os.getpid()}"  # another name first, so that none is taken for a new one
            with writing(folder), suppress(FileNotFoundError):
                (folder / "runs").rename(aside)
            for old in folder.glob(".replaced-*"):
                shutil.rmtree(old, ignore_errors=True)
        with writing(folder):
            (folder / "runs").mkdir(exist_ok=True)
            study = ProgramStudy(folder, write_manifest(folder, manifest))
        yield study


def write_manifest(folder: Path, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Write ``manifest.json`` with these fields, whole or not at all, and return it."""
    manifest = manifest_of(kind=PROGRAM_RUNS, **fields)
    write_whole(folder / "manifest.json", (json.dumps(manifest, indent=1) + "\n").encode())
    return manifest


def new_folder(study: Path, run: int) -> Path:
    """A name for a run that no folder has: a child of an earlier try may still write into that one's."""
    base = study / "runs" / f"{run:04d}"
    names = itertools.chain([base], (base.with_name(f"{base.name}-{number}") for number in itertools.count(2)))
    return next(path for path in names if not path.exists())


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder; the system releases it when this process ends, however it ends."""
    import fcntl

    with (folder / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"--out {folder}: another 'consistency monte-carlo' works on it") from None
        yield


def _changed(old: Any, new: Any) -> str:
    """Which file changed."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return ""
    return str(next(name for name in {**old, **new} if old.get(name) != new.get(name)))
