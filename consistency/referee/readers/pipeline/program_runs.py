"""The runs of a program, each in a folder of its own, or tables of single runs beside truths of their own.

A run is finished when its ``run.json`` has been renamed into its folder. What a program wrote is read as any other
file; a run whose files cannot be read has failed.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.diagnostics.number_words import plural
from consistency.referee.diagnostics.planning import Design, sequential_design
from consistency.referee.diagnostics.record import Bound, Record
from consistency.referee.diagnostics.verdict_parts import Settings
from consistency.referee.errors import InputError
from consistency.referee.parsing import one_line, reading
from consistency.referee.readers.formats.columns import TRUE, stem_of
from consistency.referee.readers.formats.file_kinds import TRAJECTORIES, head_of, paired, table_files
from consistency.referee.readers.formats.table import read_tables
from consistency.referee.readers.formats.table_columns import has_nis
from consistency.referee.readers.options import Reading, flag_of, make_reading
from consistency.referee.readers.pipeline.records import records_of
from consistency.referee.readers.places import CutNote, Places, listed
from consistency.referee.readers.truth_matching import (
    PLACES,
    Bounds,
    Estimator,
    Poses,
    Stated,
    StatedError,
    make_poses,
)
from consistency.referee.system import read_manifest

RUN_KIND = "run of a program"  # of run.json: a program may write a file of that name itself
LOG = "program.log"  # standard output and error of a run
RUN_FILE = "run.json"
PATHS = ("truth", "covariance")  # options of files, each with a path of its own for every run
OF_NUMBERS = ("axes", "relative", "windows", "align", "split", "truth_errors", "truth_shared")  # options
Reader = Callable[[Path, Reading], Sequence[Estimator | Record]]
LATE = 1.5  # steps of the estimates: the truth may go on by less than two

NUMBERS = "numbers.npz"  # in the folder of a run
NO_NUMBERS = ("place", "by")  # of poses: the cells of a column may be words
OF_POSES = [name for name, (part, _) in PLACES.items() if part in ("own", "true") and name not in NO_NUMBERS]
TEXTS_OF_POSES = ("manifold", "convention", "max_dt", "run", "name", "numbered", "open_end")
TEXTS = ("name", "axes", "convention", "definition", "label", "notes", "causes", "judged", "in_space", "position",
         "innovations_alone")  # fmt: skip
OF_ERROR = ("axes", "convention", "definition", "judged", "in_space", "position")  # of these texts


def filled(text: str, values: Mapping[str, str]) -> str:
    """A text with ``{run}``, ``{seed}``, ... replaced by their values; all other braces stay."""
    if not values:
        return text
    return re.sub(r"\{(" + "|".join(values) + r")\}", lambda match: values[match[1]], text)


def is_recorded(path: str) -> bool:
    """Whether a path follows from a recorded file, and so is where the user stands."""
    return "{name}" in path or "{input}" in path


@dataclass(frozen=True)
class ProgramRun:
    """A finished run: its folder, what stands for ``{run}``, ``{seed}``, ... and how the program ended."""

    folder: Path
    run: int
    values: Mapping[str, str]
    failure: str  # why the program failed; "" if it ended well
    seconds: float = 0.0

    @property
    def log(self) -> Path:
        return self.folder / LOG

    @property
    def known(self) -> Mapping[str, str]:
        """What stands for each placeholder, also after the folder was moved."""
        return {**self.values, "out": str(self.folder)}

    @property
    def source(self) -> str:
        """What the run was made of: the name of its recorded file, or its seed."""
        return self.values.get("name", self.values["seed"])


def run_of(folder: Path) -> ProgramRun | None:
    """The finished run in a folder; None if it is not finished."""
    path = folder / RUN_FILE
    if not path.is_file():
        return None
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["kind"] != RUN_KIND:
            return None
        return ProgramRun(folder, int(data["run"]), data["values"], data["failure"], data["seconds"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def runs_in(folder: Path) -> dict[int, ProgramRun]:
    """Finished runs of a study by their number, in order."""
    found = {}
    for each in sorted((folder / "runs").glob("*")):
        run = run_of(each)
        if run is not None:
            found[run.run] = run
    return dict(sorted(found.items()))


@dataclass(frozen=True)
class ProgramStudy:
    """What the manifest of a folder of runs says."""

    folder: Path
    manifest: Mapping[str, Any]

    @cached_property
    def reading(self) -> Reading:
        """Options by which the files of each run are read."""
        given: dict[str, Any] = dict(self.manifest["reading"])
        for name in PATHS:
            if name in given:
                given[name] = Path(given[name])
        return make_reading(**given)

    @property
    def estimates(self) -> str:
        """File of the estimates of each run, with placeholders."""
        return str(self.manifest["estimates"])

    @property
    def name(self) -> str:
        """What the estimator is called that has no name in its table: the program, or the file in folders of before."""
        stem = Path(self.estimates).stem
        if "{" in stem:
            stem = "estimates"
        return str(self.manifest.get("program") or stem)

    @property
    def settings(self) -> Settings:
        """Settings by which the runs were judged."""
        return Settings(**self.manifest["settings"])

    @property
    def design(self) -> Design | None:
        """Looks at growing numbers of runs, if the runs were made until decided."""
        plan = self.manifest["until_decided"]
        return sequential_design(**plan) if plan else None

    @property
    def unfinished(self) -> str:
        """How many runs are there, where some are missing."""
        if self.manifest["complete"]:
            return ""
        of = f" of {self.manifest['runs']}" if self.manifest["runs"] else ""
        return f"only {len(runs_in(self.folder))}{of} runs are there"

    def files_of(self, run: ProgramRun, r: Reading) -> tuple[Path, Reading]:
        """The estimates of a run, and the options by which they are read, with its own truth.

        A relative path is in the folder of the run; with a recorded file's ``{name}`` or ``{input}`` in it, it is
        where the user stood.
        """
        own: dict[str, Any] = {}
        for name in r.given(PATHS):
            path = str(r.option(name))
            base = run.folder
            if "input" in run.values and is_recorded(path):
                base = Path(run.values["here"])
            own[name] = base / filled(path, run.known)
        estimates = run.folder / filled(self.estimates, run.known)
        beside = run.folder / f"truth{estimates.suffix}"
        named = r.given(("truth", "truth_topic"))
        if not named and beside.is_file() and _needs_truth(estimates, r):
            own["truth"] = beside
        return estimates, r.with_options(**own)


def study_in(folder: Path) -> ProgramStudy:
    """The study in a folder; raises InputError where its manifest is damaged."""
    manifest = read_manifest(folder)
    keys = ("reading", "estimates", "until_decided", "complete", "runs", "settings", "skip", "optimal_gain")
    if missing := [key for key in keys if key not in manifest]:
        raise InputError(f"{folder / 'manifest.json'}: key '{missing[0]}' is missing; run it again with --overwrite")
    return ProgramStudy(folder, manifest)


def with_options(study: ProgramStudy, r: Reading) -> Reading:
    """The options by which the runs were read, with those that are given in their place.

    Raises
    ------
    InputError
        An option of files that were deleted.
    """
    deleted = [name for name in r.given() if name not in OF_NUMBERS]
    if deleted and any(study.folder.glob(f"runs/*/{NUMBERS}")):
        raise InputError(f"{flag_of(deleted[0])}: {study.folder} has the numbers alone that were read (--keep failed)")
    return study.reading.with_options(**{name: value for name, value in r.as_options().items() if value})


# --- from runs to estimators -----------------------------------------------------------------------


def read_program_runs(folder: Path, r: Reading, found_in: Reader) -> list[Estimator]:
    """The estimators of all finished runs in a folder; those of a study until decided up to the first missing run.

    Raises
    ------
    InputError
        No run can be judged.
    """
    study = study_in(folder)
    runs = ProgramRuns(study, r, found_in)
    for run in runs_in(folder).values():
        runs.take(run)
    if not runs.found:
        why = next(iter(runs.failed.values()), "none is finished; the same command with --resume continues")
        raise InputError(f"{folder}: no run can be judged: {why}")
    return runs.estimators(runs.first if study.design else None)


class ProgramRuns:
    """Runs of a program as they come, each read once.

    Parameters
    ----------
    found_in : what the reader of any file gives, by its path and options
    """

    def __init__(self, study: ProgramStudy, r: Reading, found_in: Reader) -> None:
        self.study = study
        self.options = r
        self._found_in = found_in
        self.found: dict[int, Sequence[Estimator]] = {}
        self.failed: dict[int, str] = {}
        self.trials: dict[int, str] = {}
        self._ends: dict[int, tuple[float, str]] = {}  # last time of the estimates, and why that may be too early

    def take(self, run: ProgramRun) -> list[Record]:
        """Read a run, and return its records; none if it has failed."""
        if run.failure:
            self.failed[run.run] = with_log(run.failure, run)
            return []
        try:
            found = self._found(run)
            records = [record for one in found for record in records_of(one, self.options)]
            _require_whole(records)
        except InputError as error:
            self.failed[run.run] = with_log(str(error).replace(f"{run.folder}/", ""), run)
            return []
        self.found[run.run] = [_without_folder(one, run.folder) for one in found]
        first = found[0].runs[0]
        self._ends[run.run] = _end_of(first)
        truth = np.concatenate([first.true.t, first.true.values.ravel()])
        digest = hashlib.sha256(truth.tobytes()).hexdigest()[:16]
        self.trials[run.run] = f"{run.source} {digest}"
        return records

    def delete_files(self, run: ProgramRun) -> None:
        """Keep the numbers that were read of a run in place of its files, unless these are not whole."""
        if run.run in self._early(self.found):
            return
        estimates, r = self.study.files_of(run, self.options)
        if not (run.folder / NUMBERS).exists():
            keep_numbers(run.folder, self.found[run.run])
        for path in (estimates, r.sources.truth, r.sources.covariance):
            if path is None or not path.is_relative_to(run.folder):
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)

    def _early(self, runs: Iterable[int]) -> dict[int, str]:
        """Runs that left a part of a table, and why they count as failed.

        These end before their truth, unless all do, or before most of the runs, which have the same end. Recorded
        files are of any length.
        """
        if self.study.manifest.get("inputs"):
            return {}
        early = {}
        ends = {}
        for run in runs:
            ends[run], late = self._ends[run]
            if late:
                early[run] = late
        if len(early) == len(ends):
            early = {}
        longest = max(ends.values(), default=0.0)
        short = [run for run, end in ends.items() if end < longest]
        if 2 * len(short) < len(ends):
            for run in short:
                early.setdefault(run, f"its estimates end at {ends[run]:.6g}, those of most runs at {longest:.6g}")
        return early

    def _found(self, run: ProgramRun) -> list[Estimator]:
        if (run.folder / NUMBERS).exists():
            return kept_numbers(run.folder)
        estimates, r = self.study.files_of(run, self.options)
        paths = {"--estimates": estimates, "--truth": r.sources.truth, "--covariance": r.sources.covariance}
        for option, path in paths.items():
            if path is not None and not path.exists():
                raise InputError(_nothing(path, option, run))
        found = merged({run.run: self._found_in(estimates, r)}, self.study.name)
        if r.sources.truth is None or self.options.sources.truth is not None:
            return found
        note = f"{r.sources.truth}: taken as the truth of the run, as no column of {estimates.name} is one; see --truth"
        return [one.with_notes(note) for one in found]

    @property
    def first(self) -> int:
        """How many of runs 0, 1, ... are there, up to the first that is missing."""
        run = 0
        while run in self.found or run in self.failed:
            run += 1
        return run

    def estimators(self, count: int | None = None) -> list[Estimator]:
        """The estimators of the first ``count`` runs by number, or of all that are there."""
        if count is None:
            count = max([*self.found, *self.failed], default=-1) + 1
        found = {run: one for run, one in sorted(self.found.items()) if run < count}
        failed = {run: why for run, why in self.failed.items() if run < count}
        for run, why in self._early(found).items():
            del found[run]
            failed[run] = why
        return [replace(one, trials=self.trials) for one in merged(found, self.study.name, failed)]


def with_log(why: str, run: ProgramRun, lines: int = 3) -> str:
    """A reason with the last lines of a run's log."""
    last = log_lines(run.log, lines)
    return f"{why}; its log ends: {one_line(' | '.join(last), 300)}" if last else why


def without_log(why: str) -> str:
    """A reason without the lines of a log."""
    return why.partition("; its log ends: ")[0]


def kind_of_failure(why: str) -> str:
    """A reason without its numbers and log: what failures that are alike have in common."""
    return re.sub(r"\d+", "#", without_log(why))


def failures_in_words(records: Sequence[Record], folder: Path) -> list[str]:
    """A sentence for each kind of failure, with the runs that failed so and the log of the first."""
    kinds: dict[str, dict[int, str]] = {}
    for record in records:
        for failure in record.failures:
            kinds.setdefault(kind_of_failure(failure.reason), {})[failure.run] = failure.reason
    runs = runs_in(folder) if kinds else {}
    sentences = []
    for of_runs in kinds.values():
        first, why = min(of_runs.items())
        which = f"{plural(len(of_runs), 'run')} failed ({listed(sorted(of_runs))})"
        sentences.append(f"{which}: {without_log(why)}; log {runs[first].log}, seed {runs[first].values['seed']}")
    return sentences


def log_lines(path: Path, lines: int) -> list[str]:
    """The last lines of a log that are not empty."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, file.seek(0, 2) - 16384))
            text = file.read().decode("utf-8", "replace")
    except OSError:
        return []
    return [line.rstrip() for line in text.splitlines() if line.strip()][-lines:]


def _needs_truth(path: Path, r: Reading) -> bool:
    """Whether no column of a text file of estimates is a truth, an innovation or a NIS."""
    names = []
    if path.suffix.lower() in (".csv", *TRAJECTORIES) and (head := head_of(path, r.components.columns)) is not None:
        names = head.names
    return not (has_nis(names) or any(stem_of(name, TRUE) for name in names))


def _nothing(path: Path, option: str, run: ProgramRun) -> str:
    """Message that a file of a run is not there."""
    if not path.is_relative_to(run.folder):
        return f"{option}: {path} is not there"
    relative = path.relative_to(run.folder)
    here = Path(run.values["here"]) / relative
    if option != "--estimates" and here.exists():
        return f"the program wrote no {relative}; for the one where you stand write {option} {{here}}/{relative}"
    others = sorted({each.name for each in run.folder.iterdir()} - {LOG, RUN_FILE})
    wrote = f"; it wrote {', '.join(others[:5])}" if others else ", and nothing else"
    return f"the program wrote no {relative} ({option}){wrote}"


def _without_folder(one: Estimator, folder: Path) -> Estimator:
    """An estimator whose notes name the files of a run as any run has them."""
    notes = [note.replace(f"{folder}/", "") for note in one.notes]
    causes = [cause.replace(f"{folder}/", "") for cause in one.causes]
    return replace(one, notes=notes, causes=causes)


def _require_whole(records: Sequence[Record]) -> None:
    """Refuse a file whose last line is cut short: the program has ended."""
    for record in records:
        for note in record.origin.notes:
            if isinstance(note, CutNote):
                raise InputError(f"{note.rpartition(': ')[0]}: its last line is cut short")


def _end_of(p: Poses) -> tuple[float, str]:
    """Time or step of the last estimate, and what to say where the truth continues."""
    if len(p.own.t) < 2 or not len(p.true.t):
        return float(p.own.t[-1]), ""
    period = float(np.median(np.diff(p.own.t)))
    late = ""
    if p.true.t[-1] - p.own.t[-1] > LATE * period:
        late = f"its estimates end at {p.own.t[-1]:.6g}, its truth at {p.true.t[-1]:.6g}"
    return float(p.own.t[-1]), late


def read_table_folder(folder: Path, r: Reading, poses_alone: bool = False) -> list[Estimator]:
    """The estimators of a folder with a table for each run, by name, and a truth of the same stem where it is a folder.

    Raises
    ------
    InputError
        A table holds several runs, or has no truth; as :func:`read_tables`.
    """
    found = {}
    for run, file in enumerate(table_files(folder)):
        found[run] = read_table_of_run(file, r, poses_alone)
    return merged(found, folder.stem)


def read_table_of_run(file: Path, r: Reading, poses_alone: bool = False) -> list[Estimator]:
    """What a table of a folder holds, beside the truth of the same stem where the truth is a folder.

    Raises
    ------
    InputError
        It has no truth; as :func:`read_tables`.
    """
    if r.sources.truth is not None:
        r = r.with_truth(paired(r.sources.truth, file, "--truth", "table '{}'"))
    return read_tables(file, r, poses_alone)


def merged(
    found: Mapping[int, Sequence[Estimator | Record]], name: str, failed: Mapping[int, str] | None = None
) -> list[Estimator]:
    """The estimators of all runs by name, from what a reader gives of each run.

    Parameters
    ----------
    found : by run, the estimators in its files; a run without one of them has failed for it
    name : of an estimator that is called after its file
    failed : runs without any estimates, and why they have none

    Raises
    ------
    InputError
        The files of a run hold several runs, or the runs have different states or kinds of covariances.
    """
    by_name: dict[str, dict[int, Estimator]] = {}
    for run, of_run in found.items():
        for one in of_run:
            if isinstance(one, Record):
                raise InputError(f"{one.name}: a run needs errors with covariances, not their NEES alone")
            if len(one.runs) != 1:
                raise InputError(f"{one.path}: holds {len(one.runs)} runs; write one run into each file")
            label = one.name if one.name != one.path.stem else name
            by_name.setdefault(label, {})[run] = one
    return [_one_estimator(label, runs, found, failed or {}) for label, runs in by_name.items()]


def _one_estimator(
    name: str, own: Mapping[int, Estimator], all_runs: Iterable[int], failed: Mapping[int, str]
) -> Estimator:
    first = next(iter(own.values()))
    poses: list[Poses] = []
    for run, one in own.items():
        if _kind_of(one.error) != _kind_of(first.error):
            raise InputError(f"{one.path}: has another state or kind of covariance than {first.path}")
        poses.append(one.runs[0].with_values(run=run))
    without = dict.fromkeys(set(all_runs).difference(own), f"it holds no estimates of '{name}'")
    t = first.t
    notes: dict[str, str] = {}
    causes: dict[str, str] = {}
    if t is not None:
        t = max((one.t for one in own.values() if one.t is not None), key=len)
    for one in reversed(list(own.values())):
        notes |= {_without_paths(note, one): note for note in one.notes}
        causes |= {_without_paths(cause, one): cause for cause in one.causes}
    return replace(
        first,
        name=name,
        label=name,
        runs=poses,
        t=t,
        failed={**without, **failed},
        notes=list(reversed(notes.values())),
        causes=list(reversed(causes.values())),
    )


def _kind_of(error: StatedError) -> tuple[Sequence[str], Stated, str, Bounds | None]:
    """What the errors of all runs of an estimator have in common."""
    return error.axes, error.stated, error.convention, error.bounds


def _without_paths(note: str, one: Estimator) -> str:
    """A note as the files of every run would have it."""
    for path in (one.path, *one.runs[0].source.files):
        note = note.replace(str(path), "")
    return note


# --- numbers of a run in place of its files ----------------------------------------------------------


def keep_numbers(folder: Path, estimators: Sequence[Estimator]) -> None:
    """Write the numbers of a run, one set of poses for each of its estimators, into its folder."""
    arrays: dict[str, Any] = {}
    about = []
    for i, one in enumerate(estimators):
        p = one.runs[0]
        for key in OF_POSES:
            arrays[f"{i} {key}"] = p.value(key)
        arrays[f"{i} times"] = one.t
        texts: dict[str, Any] = {
            "path": str(one.path),
            "files": list(map(str, p.source.files)),
            "alone": one.error.stated.alone,
            "groups": {name: [group.start, group.stop] for name, group in one.error.stated.groups.items()},
            "beside": p.true.t is p.own.t,
            "bounds": one.error.bounds and [list(map(list, one.error.bounds.bounds)), *one.error.bounds[1:]],
        }
        for key in TEXTS:
            texts[key] = getattr(one.error if key in OF_ERROR else one, key)
        for key in TEXTS_OF_POSES:
            texts[f"poses {key}"] = p.value(key)
        about.append(texts)
    there = {key: array for key, array in arrays.items() if array is not None}
    partial = folder / f"{NUMBERS}.partial"
    with partial.open("wb") as file:
        np.savez(file, about=np.array(json.dumps(about, default=list)), **there)
    partial.replace(folder / NUMBERS)


def kept_numbers(folder: Path) -> list[Estimator]:
    """Estimators of a run from the numbers in its folder.

    Raises
    ------
    InputError
        The file is damaged.
    """
    path = folder / NUMBERS
    with reading(path), np.load(path, allow_pickle=False) as archive:
        arrays = {key: archive[key] for key in archive.files}
        about = json.loads(str(arrays.pop("about")))
        return [_estimator(i, texts, arrays) for i, texts in enumerate(about)]


def _estimator(i: int, texts: dict[str, Any], arrays: dict[str, Any]) -> Estimator:
    own: dict[str, Any] = {key: arrays.get(f"{i} {key}") for key in OF_POSES}
    for key in TEXTS_OF_POSES:
        own[key] = texts[f"poses {key}"]
    if texts["beside"]:
        own["true_t"] = own["t"]  # the same array says that every estimate has its truth beside it
    path = Path(texts["path"])
    estimates, truth = map(Path, texts["files"])
    place = Places(lambda row: f"{path}, row {row + 1}", np.arange(len(own["t"])))
    poses = make_poses(place=place, files=(estimates, truth), **own)
    groups = {name: slice(*ends) for name, ends in texts["groups"].items()}
    of_estimator = {key: texts[key] for key in TEXTS if key not in OF_ERROR}
    of_error = {key: texts[key] for key in OF_ERROR}
    of_error["axes"] = tuple(texts["axes"])
    bounds = None
    if texts.get("bounds"):  # folders written before lack them
        stated, places, *rest = texts["bounds"]
        bounds = Bounds(tuple(Bound(*each) for each in stated), tuple(map(tuple, places)), *rest)
    error = StatedError(stated=Stated(groups, texts["alone"]), bounds=bounds, **of_error)
    return Estimator(path=path, runs=[poses], error=error, t=arrays.get(f"{i} times"), **of_estimator)
