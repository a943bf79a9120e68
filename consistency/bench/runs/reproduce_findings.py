"""Published findings beside measured ones: the scripts of ``experiments/``, found, run and compared."""

from __future__ import annotations

import importlib.util
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias, cast

import pandas as pd
from joblib.externals.loky import Future, ProcessPoolExecutor
from joblib.externals.loky.backend import get_context

from consistency.bench.filters import get_filter
from consistency.bench.runs.montecarlo import run_trials
from consistency.bench.runs.results_to_records import analyse, record_of
from consistency.bench.runs.run_outcome import compile_all, first_trials
from consistency.bench.runs.workers import worker_count
from consistency.bench.scenario import Scenario, data_folder, load_scenario
from consistency.bench.store.parquet import write_tables
from consistency.bench.store.results import Results, joined
from consistency.bench.types import OURS as OURS
from consistency.bench.types import Finding, outcome
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.errors import InputError
from consistency.referee.parsing import read_json, reading
from consistency.referee.show.blocks import Cell, Column, Status, Table, table
from consistency.referee.show.terminal import show
from consistency.referee.system import end_with_parent, link_to_parent, manifest_of, quiet, require_free, say

_Contribution: TypeAlias = tuple[list[Finding], dict[str, pd.DataFrame]]  # findings and tables of one script
WAITING = 30.0  # seconds between lines on a process that is waited for
REPRODUCED, NOT_REPRODUCED, NOT_SHOWN, REFUTED = "reproduced", "not reproduced", "not shown", "refuted"
NOT_RUN = ("experiment", "question", "findings", "how")  # keys of an experiment that was left out


class Study:
    """Runs trials for experiments, each (scenario, filter) once, and keeps what a report shows.

    Parameters
    ----------
    runs, seed, jobs : as in :func:`consistency.run_trials`
    only : ids of the findings that are wanted; none for all of them

    Raises
    ------
    InputError
        ``jobs`` is out of range.
    """

    def __init__(self, runs: int = 50, seed: int = 0, jobs: int = -1, *, only: Sequence[str] = ()) -> None:
        self.runs, self.seed, self.jobs, self.only = runs, seed, jobs, only
        self.workers = worker_count(jobs)
        self.kept: dict[str, Results] = {}
        self.tables: dict[str, pd.DataFrame] = {}
        self._judged: dict[tuple[str, str], tuple[Verdict, Record]] = {}

    def wants(self, finding: str) -> bool:
        """Whether a finding is asked for; one that takes long and is not need not be worked out."""
        return not self.only or finding in self.only

    def results(self, scenario: str | Scenario, filters: Sequence[str]) -> Results:
        """Results of all ``filters`` so far on a scenario; only those not yet run are run."""
        world = load_scenario(scenario)
        results_so_far = self.kept.get(world.name)
        if results_so_far is not None and results_so_far.manifest["scenario_hash"] != world.hash:
            raise ValueError(f"two different scenarios are named '{world.name}'")
        missing_filters = [name for name in filters if results_so_far is None or name not in results_so_far.filters]
        if missing_filters:
            say(f"{world.name}: {', '.join(missing_filters)}")
            new_results = cast(Results, run_trials(world, missing_filters, self.runs, self.seed, self.jobs))
            self.kept[world.name] = new_results if results_so_far is None else joined([results_so_far, new_results])
        return self.kept[world.name]

    def judged(self, scenario: str | Scenario, filter_name: str) -> tuple[Verdict, Record]:
        """Verdict and record of one filter on a scenario; each is worked out once."""
        results = self.results(scenario, [filter_name])
        key = str(results.manifest["scenario_hash"]), filter_name
        if key not in self._judged:
            self._judged[key] = analyse(results, [filter_name])[filter_name], record_of(results, filter_name)
        return self._judged[key]

    def finding(self, holds: bool | None, scenario: str, verdict_if_not: str = NOT_REPRODUCED, **text: str) -> Finding:
        """A finding with this study's runs and seed.

        ``holds`` says whether the rule of the finding was met; None where the runs show neither that it was nor that
        it was not.
        """
        verdict = NOT_SHOWN if holds is None else REPRODUCED if holds else verdict_if_not
        return Finding(verdict=verdict, runs=self.runs, seed=self.seed, scenario=scenario, **text)

    def write(
        self,
        out: Path,
        findings: Sequence[Finding],
        wall: float,
        overwrite: bool = False,
        not_run: Sequence[dict[str, str]] = (),
    ) -> None:
        """Write findings.json, extra tables and a folder for each scenario, moved into place as a whole."""
        manifest = manifest_of(kind="findings", seed=self.seed, runs=self.runs, wall=wall, complete=True)
        manifest["failures"] = sum(len(results.failures) for results in self.kept.values())
        manifest["studies"] = list(self.kept)
        manifest["not_run"] = list(not_run)
        manifest["scenarios"] = {name: results.manifest.get("scenario") for name, results in self.kept.items()}

        def contents(folder: Path) -> None:
            for name, results in self.kept.items():
                results.write(folder / name)
            for name, frame in self.tables.items():
                frame.to_parquet(folder / f"{name}.parquet", compression="zstd", index=False)
            text = json.dumps([asdict(finding) for finding in findings], indent=2, ensure_ascii=False)
            (folder / "findings.json").write_text(text + "\n", encoding="utf-8")

        write_tables(out, {}, manifest, contents, overwrite)


# --- reproduce -------------------------------------------------------------------------------


def reproduce(
    only: Sequence[str] | None,
    runs: int,
    seed: int,
    jobs: int,
    out: Path,
    overwrite: bool = False,
    long: bool = False,
) -> list[Finding]:
    """Run the experiments, write ``out`` and return the findings.

    An experiment that breaks becomes findings that are not reproduced, with the error as what was measured. Those that
    share no trials with others have a process of their own where there are several workers.

    Parameters
    ----------
    only : ids of the findings wanted, or names of scripts for all of theirs; None or empty for all
    runs, seed, jobs : as in :func:`consistency.run_trials`
    out, overwrite : folder to write, and whether it may exist
    long : also experiments that take long; one that is named in ``only`` runs anyway

    Raises
    ------
    InputError
        An unknown id, a number out of range, or an output folder that cannot be written.
    """
    scripts = experiments()
    for name in only or ():
        for script_name, module in scripts.items():
            if hasattr(module, "NOT_SHIPPED") and name in (script_name, *module.FINDINGS):
                raise InputError(f"--only {name}: its data are not shipped; python {module.__file__} --help")
    only = [finding for name in only or () for finding in (scripts[name].FINDINGS if name in scripts else (name,))]
    selection = _selection(scripts, only, long)
    require_free(out, overwrite, "findings")
    study, started = Study(runs, seed, jobs, only=only), time.monotonic()
    # side by side, and before the first of the scripts
    needs = [need for module, _ in selection for need in getattr(module, "KERNELS", {}).items()]
    pairs = [(get_filter(name), load_scenario(world)) for world, names in needs for name in names]
    compile_all(first_trials(pairs), study.workers)
    findings = _findings_of(study, selection)
    study.write(out, findings, time.monotonic() - started, overwrite, [] if only else left_out(findings))
    return findings


def left_out(findings: Sequence[Finding]) -> list[dict[str, str]]:
    """Experiments without a finding, each with the keys :data:`NOT_RUN`."""
    ids = {finding.id for finding in findings}
    return [
        dict(zip(NOT_RUN, (name, first_line_of(module), ", ".join(module.FINDINGS), _how(name, module)), strict=True))
        for name, module in experiments().items()
        if not ids.intersection(module.FINDINGS)
    ]


def _how(name: str, module: ModuleType) -> str:
    """How an experiment is run by itself, and what it needs."""
    if hasattr(module, "NOT_SHIPPED"):
        return f"python experiments/{name}.py --data DIR --out DIR; not shipped: {module.NOT_SHIPPED}"
    return f"consistency reproduce --only {name}" + (f"; needs {module.NEEDS}" if hasattr(module, "NEEDS") else "")


def _selection(
    scripts: Mapping[str, ModuleType], only: Sequence[str], long: bool
) -> list[tuple[ModuleType, Sequence[str]]]:
    """The scripts to run, in order, each with the ids of its findings that are wanted."""
    known_findings = [finding for module in scripts.values() for finding in module.FINDINGS]
    if unknown := [name for name in only if name not in known_findings]:
        known = ", ".join([*known_findings, *scripts])
        raise InputError(f"--only {unknown[0]}: no such finding or experiment; known: {known}")
    selection: list[tuple[ModuleType, Sequence[str]]] = []
    for module in scripts.values():
        ids = [name for name in module.FINDINGS if not only or name in only]
        if ids and not hasattr(module, "NOT_SHIPPED") and (only or long or not getattr(module, "LONG", False)):
            selection.append((module, ids))
    return selection


def _findings_of(study: Study, selection: Sequence[tuple[ModuleType, Sequence[str]]]) -> list[Finding]:
    """The wanted findings in order of their scripts, whichever script ends first."""
    in_own_process = [module for module, _ in selection if study.workers > 1 and getattr(module, "OWN_PROCESS", False)]
    context = get_context("loky")
    pool = None
    if in_own_process:
        initializer = {"initializer": end_with_parent, "initargs": link_to_parent(context)}
        pool = ProcessPoolExecutor(len(in_own_process), context=context, **initializer)
    futures: dict[ModuleType, Future[_Contribution]] = {}

    def main(module: ModuleType) -> list[Finding]:
        if module not in futures:
            findings: list[Finding] = module.main(study)
            return findings
        findings, tables = _waited_for(futures[module])
        study.tables |= tables
        return findings

    by_script: dict[ModuleType, list[Finding]] = {}
    try:
        for module in in_own_process:
            assert pool is not None
            futures[module] = pool.submit(_contribution, module.__file__, study.runs, study.seed, study.jobs)
        ordered = sorted(selection, key=lambda pair: pair[0] in futures)  # processes are waited for last
        for number, (module, ids) in enumerate(ordered, start=1):
            say(f"[{number} of {len(ordered)}] {Path(str(module.__file__)).stem}: {first_line_of(module)}")
            by_script[module] = _guarded(main, module, study, ids)
    finally:
        if pool is not None:
            pool.shutdown(kill_workers=True)
    return [finding for module, ids in selection for finding in by_script[module] if finding.id in ids]


def _waited_for(future: Future[_Contribution]) -> _Contribution:
    """What a process leaves; a line now and then says that it still works."""
    started = time.monotonic()
    while True:
        try:
            contribution: _Contribution = future.result(timeout=WAITING)
            return contribution
        except TimeoutError:
            if future.done():  # of the script itself
                raise
            say(f"still at it in a process of its own, {time.monotonic() - started:.0f} s")


def _contribution(path: str, runs: int, seed: int, jobs: int) -> _Contribution:
    """Run one script by itself, in a process that knows no other's trials."""
    study = Study(runs, seed, jobs)
    with quiet():  # others write to the same terminal
        findings = load_script(Path(path)).main(study)
    if study.kept:
        raise ValueError("OWN_PROCESS is for scripts that run no filter")
    return findings, study.tables


def _guarded(
    main: Callable[[ModuleType], list[Finding]], module: ModuleType, study: Study, ids: Sequence[str]
) -> list[Finding]:
    """Findings of a script; where it breaks, findings that say so."""
    try:
        return main(module)
    except InputError:
        raise
    except Exception as error:
        claim = first_line_of(module)
        unsaid = dict.fromkeys(("source", "statistic", "published", "accept"), "the experiment broke before it said")
        measured = f"{type(error).__name__}: {error}"
        return [study.finding(False, "none", id=name, claim=claim, measured=measured, **unsaid) for name in ids]


def script(main: Callable[[Study], list[Finding]], arguments: Sequence[str] | None = None) -> None:
    """Main function of an experiment that is run alone: ``python experiments/eNN_….py [RUNS] [SEED]``."""
    try:
        values = [int(value) for value in (sys.argv[1:] if arguments is None else arguments)]
        show(findings_table(main(Study(*values))))
    except (InputError, ValueError) as error:
        print(f"{Path(sys.argv[0]).name} [RUNS] [SEED]: {error}", file=sys.stderr)
        sys.exit(2)


def read_findings(folder: Path) -> list[dict[str, Any]]:
    """``findings.json`` of a folder, or an empty list where there is none."""
    path = folder / "findings.json"
    if not path.exists():
        return []
    with reading(path, "not a list of findings"):
        entries, finding_fields = read_json(path), [each.name for each in fields(Finding)]
        if not isinstance(entries, list):
            raise ValueError("no list")
        if not all(isinstance(entry, dict) and {*entry} == {*finding_fields} for entry in entries):
            raise ValueError(f"a finding has the keys {', '.join(finding_fields)}")
        return [asdict(Finding(**entry)) for entry in entries]


def findings_table(findings: Sequence[Finding]) -> Table:
    columns = tuple(map(Column, ("finding", "published", "measured", "verdict")))
    rows: list[tuple[Cell, ...]] = [
        (f.id, f.published, f.measured, Status(outcome(f.source, f.verdict))) for f in findings
    ]
    return table(columns, rows, "Findings", style="prose")


def not_run_table(entries: list[dict[str, str]]) -> Table:
    """What :func:`left_out` returns, as a table.

    Raises
    ------
    ValueError
        The entries are not a list of experiments with these keys.
    """
    if not isinstance(entries, list) or not all(isinstance(each, dict) and {*each} == {*NOT_RUN} for each in entries):
        raise ValueError(f"an experiment has the keys {', '.join(NOT_RUN)}")
    columns = tuple(map(Column, ("experiment", "question", "findings", "how to run it")))
    rows: list[tuple[Cell, ...]] = [tuple(str(each[key]) for key in NOT_RUN) for each in entries]
    return table(columns, rows, "Not run", style="prose")


def experiments() -> dict[str, ModuleType]:
    """Scripts of ``experiments/`` by name; each has FINDINGS (ids) and ``main(study)``.

    KERNELS, names of filters by scenario, says what is compiled before the first script runs; what it leaves out is
    compiled when it is needed.

    A script that takes long says so with ``LONG = True``; one that runs no filter, and so shares no trials with the
    others, with ``OWN_PROCESS = True``; one whose data are not shipped with NOT_SHIPPED, what these are, and it
    needs no ``main``. NEEDS says what else a script needs.

    Raises
    ------
    InputError
        A script cannot be imported, or the folder is not there.
    """
    folder = data_folder("experiments")
    if not folder.is_dir():
        raise InputError(f"{folder}: the experiments are missing; install the package again")
    return {path.stem: load_script(path) for path in sorted(folder.glob("e[0-9][0-9]_*.py"))}


@cache
def figure_scripts() -> dict[str, ModuleType]:
    """Scripts of ``experiments/figures/`` by name, each a chapter of a report on the tables that experiments leave.

    A script has CHAPTER (anchor, title, entry in the contents), ``blocks(report)``, empty without its tables, and
    ON_PAPER: whether the PDF of several studies has it, too.

    Raises
    ------
    InputError
        A script cannot be imported.
    """
    folder = data_folder("experiments") / "figures"
    return {path.stem: load_script(path) for path in sorted(folder.glob("*.py"))}


def load_script(path: Path) -> ModuleType:
    try:
        return _executed(path, f"consistency_experiment_{path.stem}")
    except Exception as error:
        raise InputError(f"{path}: cannot be imported ({type(error).__name__}: {error})") from error


def sibling(script: str, name: str) -> ModuleType:
    """The module ``name`` beside a script, whose folder need not be on the path."""
    return _executed(Path(script).with_name(f"{name}.py"), name)


def _executed(path: Path, name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where dataclasses of the script look for their names
    spec.loader.exec_module(module)
    return module


def first_line_of(module: ModuleType) -> str:
    return (module.__doc__ or "").strip().splitlines()[0]


def command_line(command: Callable[[], None]) -> None:
    """Run a script that reads its own arguments: unusable input ends in one line and exit status 2."""
    try:
        command()
    except InputError as error:
        print(f"{Path(sys.argv[0]).stem}: {error}", file=sys.stderr)
        sys.exit(2)
