"""What a file holds, and the command line that judges it: its reader is tried with the options that it seems to need.

What is found is what readers note and hint at; nothing is judged here.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from itertools import chain, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from scipy import special

from consistency.referee.column_names import POSE
from consistency.referee.diagnostics.number_words import percent, plural, short
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.whitening import ROUNDED, Validity, classify
from consistency.referee.errors import InputError
from consistency.referee.readers.formats import file_kinds, flight_logs
from consistency.referee.readers.formats.columns import (
    CLOCKS,
    OWN,
    TRUE,
    covariance_columns,
    run_column,
    state_columns,
    stem_of,
)
from consistency.referee.readers.formats.innovation_files import SeveralError
from consistency.referee.readers.options import OPTIONS, Reading, flag_of, make_reading
from consistency.referee.readers.pipeline import read_files
from consistency.referee.readers.pipeline.program_runs import run_of
from consistency.referee.readers.places import listed
from consistency.referee.readers.runs_to_record import not_estimated
from consistency.referee.readers.truth_matching import WHOLE, Estimator, submatrices
from consistency.referee.show.blocks import Block, Bullets, Document, Facts, Text, fragment
from consistency.referee.system import read_manifest
from consistency.referee.types import Array
from consistency.referee.verdicts.compare_sources import is_baseline
from consistency.referee.verdicts.monitor_sources import read_innovations

TRUTH = re.compile(
    r"truth|(?<![a-z])(gt|true|ref|reference|mocap|vicon|vrpn|optitrack|leica|rtk)(?![a-z])", re.IGNORECASE
)  # in names of files and topics
COVARIANCE = re.compile(r"cov|(?<![a-z])(p|sigma|std|deviations?)(?![a-z])", re.IGNORECASE)
FILTERED = re.compile(r"filter|fused|fusion|ekf|ukf|estimat|slam|vio|lio|state", re.IGNORECASE)  # in names of topics
QUALITY = re.compile(
    r"q|ns|age|ratio|mode|status|[hpv]dop|fix.*|n_?sat.*|n_\w+|num_?\w+|.*(quality|match|feature|inlier|track|turn|speed|"
    r"rate|weather|light|scene|sensor).*",
    re.IGNORECASE,
)  # names of columns for --by
COUNTED = ("run", "step", "filter", "nees", "nis", "nis_dof", *CLOCKS)  # columns beside the state
ADVICE = re.compile(r"\badd (--[a-z-]+) ([^\s;()]+)")  # in a note of a reader
OF_DRIVES = {"truth", "topic", "truth_topic", "columns", "truth_columns"}  # options of 'fit-covariance', too
FEWEST_ROWS = 30  # below, correlated rows and independent ones look alike
CORRELATED = 0.01  # false-alarm rate at which neighbouring rows are found to be correlated
DEEPEST, MOST = 4, 4  # options that are added one after the other; candidates for one of them
LARGE = 1e6  # a variance from which on it says that nothing is known
UNLIKE = 100.0  # ratio of two deviations of one unit
EPOCH = 1e9  # s: times since 1970
OPTIMAL = "declares the optimal (Kalman) gain, without which innovations cannot be judged"
JUDGING = ("analyse", "monitor", "correct", "fit-covariance")
PAGE = "report.html"
NOT_JUDGED = f"{{path}}: holds no estimates; inspect those that it was made from. {PAGE} in it shows the result"
NOT_RUN = "a filter to run: consistency run --log {path} --filter F --out results; see 'consistency list'"
STORED: dict[str, tuple[str, tuple[str, ...]]] = {
    "results": ("results of 'consistency run'", ("analyse", "{path}")),
    "log": ("recorded log of the bench", ()),
    "findings": ("findings of 'consistency reproduce'", ("report", "{path}", "--html", PAGE)),
    "sweep": ("sweep over a grid of worlds", ("sweep", "{path}")),
    "cell": ("one world of a sweep", ("sweep", "{path}/../..")),
    "correction": ("correction of 'consistency correct'", ("inspect", "{path}/held-out")),
    "verdict": ("report of 'consistency analyse'", ()),
    "noise": ("noise model of 'consistency fit-covariance'", ()),
}  # kinds of folders by their manifest: what each is, and the command that reads it
Pairs = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Inspection:
    """What a file holds, and the command line that judges it; ``print`` shows it.

    ``facts`` are names and values. ``options`` has the reason for each option of ``command`` that was found. Without a
    command, ``missing`` says what would make one. ``cs.read(path, **arguments)`` reads what the command judges.
    """

    path: Path
    kind: str
    facts: Pairs = ()
    findings: tuple[str, ...] = ()
    options: Pairs = ()
    command: str = ""
    missing: str = ""
    arguments: Mapping[str, Any] | None = None

    def __str__(self) -> str:
        missing = [Text(f"Missing: {self.missing}")] if self.missing else []
        return fragment(*inspection_document(self).opening, *missing)


def inspection_document(found: Inspection) -> Document:
    """Facts, findings, and the command line on the last line."""
    blocks: list[Block] = [Text(f"{found.path}: {found.kind}")]
    if found.facts:
        blocks.append(Facts(found.facts))
    if found.findings:
        blocks += [Text("Findings:"), Bullets(found.findings)]
    if found.options:
        blocks += [Text("Options of the command, and why:"), Facts(found.options)]
    if found.command:
        judges = found.command.split()[1] in JUDGING
        blocks += [Text("To judge it:" if judges else "To read it:"), Text(f"  {found.command}")]
    return Document(str(found.path), "", (), tuple(blocks), {**vars(found), "path": str(found.path), "arguments": None})


@dataclass(frozen=True)
class Attempt:
    """What readers gave with some options, or why they refused."""

    reading: Reading
    why: Mapping[str, str]  # of options that were added, by name
    found: Sequence[Estimator | Record] = ()
    records: Sequence[Record] = ()
    refusal: str = ""

    @property
    def is_without_truth(self) -> bool:
        return any(isinstance(each, Estimator) and each.innovations_alone for each in self.found)

    @property
    def facts(self) -> list[tuple[str, str]]:
        return list(chain.from_iterable(map(_facts, self.found)))


def inspect_files(path: Path, r: Reading | None = None) -> Inspection:
    """Inspect a file or folder; ``r`` has options that are known already.

    Raises
    ------
    InputError
        The file is missing, its kind is unknown, or it cannot be opened.
    """
    r = r or Reading()
    if not path.exists():
        raise InputError(f"{path}: no such file")
    if path.suffix.lower() == flight_logs.ULOG_SUFFIX:
        return _innovations(path, r, "flight log of PX4")
    if flight_logs.is_dataflash(path):
        return _dataflash(path, r)
    if read_files.is_program_runs(path):
        facts = tuple(chain.from_iterable(map(_facts, read_files.read_recordings(path, r))))
        return Inspection(path, "runs of 'consistency monte-carlo'", facts, command=_command("analyse", path, r))
    if (path / "manifest.json").is_file() or (path / "estimates.parquet").is_file():
        return _stored(path, r)
    try:
        read_files.is_recording(path, r)
    except InputError:
        if not (path / PAGE).is_file():
            raise
        return Inspection(path, "page of this bench", missing=NOT_JUDGED.format(path=path))
    if path.suffix.lower() == ".json" and is_baseline(path):
        what = f"newer estimates, to be compared with it: consistency compare NEW {path}"
        return Inspection(path, "file of 'consistency baseline'", missing=what)
    kind = read_files.kind_of(path, r)
    if kind is None:
        raise file_kinds.unknown_kind(path)
    contents = _contents(path, r)
    tried = _with_runs(path, r) or _search(path, r, {}, DEEPEST)
    tried = _advised(path, _without_idle(path, tried))
    facts = (*contents, *tried.facts)
    if tried.refusal:
        return _refused(path, kind, facts, tried)
    if tried.is_without_truth and len(tried.records[0].run_numbers) == 1:
        return _innovations(path, r, kind.name, facts)
    notes = [*dict.fromkeys(note for record in tried.records for note in record.origin.notes)]
    notes += [note for each in tried.found if isinstance(each, Estimator) for note in _suspects(each)]
    why = [(flag_of(name), text) for name, text in tried.why.items()]
    extra: tuple[str, ...] = ()
    if tried.is_without_truth:
        extra = ("--innovations", "optimal")
        why.append(("--innovations", OPTIMAL))
    command = _command("analyse", path, tried.reading, extra)
    arguments = tried.reading.as_options()
    notes += _groups(path, tried)
    if run_of(path) is not None:
        notes.append(
            f"one of the runs of a study: {_command('analyse', path.absolute().parents[1], Reading())} judges all"
        )
    return Inspection(path, kind.name, facts, tuple(notes), tuple(why), command, arguments=arguments)


def _stored(path: Path, r: Reading) -> Inspection:
    """A folder that a command of the bench wrote, by its manifest, and the command that reads it."""
    manifest = read_manifest(path) if (path / "manifest.json").is_file() else {}
    read_files.is_recording(path, r)  # refuses options that do not go with it
    kind = manifest.get("kind", "results")
    scenario = manifest.get("scenario")
    facts = [
        ("written by", manifest.get("command")),
        ("scenario", scenario.get("name") if isinstance(scenario, Mapping) else None),
        ("filters", listed(manifest.get("filters", ()), 30)),
        ("runs", manifest.get("runs")),
    ]
    shown = tuple((name, str(value)) for name, value in facts if value not in (None, ""))
    what, words = STORED.get(kind, (f"{kind} of this bench", ()))
    if words:
        command = shlex.join(["consistency", *(word.format(path=path) for word in words)])
        return Inspection(path, what, shown, command=command)
    return Inspection(path, what, shown, missing=(NOT_RUN if kind == "log" else NOT_JUDGED).format(path=path))


def says_more(path: Path, r: Reading) -> bool:
    """Whether an inspection would try options that are not given."""
    with suppress(InputError):
        return path.exists() and read_files.kind_of(path, r) is not None and any(True for _ in _proposals(path, r))
    return False


# --- trials ------------------------------------------------------------------------------------------


def _attempt(path: Path, r: Reading, why: Mapping[str, str]) -> Attempt:
    found: Sequence[Estimator | Record] = ()
    try:
        checked = read_files.checked_options(r)
        found = read_files.found_in(path, checked)
        return Attempt(r, why, found, read_files.records_of_found(found, checked))
    except InputError as error:
        return Attempt(r, why, found, refusal=str(error))


def _with_runs(path: Path, r: Reading) -> Attempt | None:
    """With a column of another name as the run, as far as such a table is not refused."""
    name = run_column(_names(path, r))
    if name is None:
        return None
    with_run = r.with_options(columns={"run": name, **(r.components.columns or {})})
    tried = _search(path, with_run, {"columns": f"'{name}' numbers the runs, by its name"}, DEEPEST)
    return None if tried.refusal else tried


def _without_idle(path: Path, tried: Attempt) -> Attempt:
    """Without components of a state that was found whose errors are 0 in every row: nobody estimates them."""
    estimators = [each for each in tried.found if isinstance(each, Estimator)]
    if tried.refusal or "state" not in tried.why or not estimators:
        return tried
    idle = np.all([not_estimated([p.errors() for p in e.runs], [p.variances for p in e.runs]) for e in estimators], 0)
    if not idle.any():
        return tried
    axes = np.array(estimators[0].error.axes)
    reason = f"{tried.why['state']}; without {', '.join(axes[idle])}, whose errors are 0 in every row"
    return _attempt(path, tried.reading.with_options(state=axes[~idle].tolist()), {**tried.why, "state": reason})


def _search(path: Path, r: Reading, why: Mapping[str, str], depth: int) -> Attempt:
    """The first attempt that is not refused, with options added one by one; the one that came furthest otherwise."""
    furthest = _attempt(path, r, why)
    if not (furthest.refusal or furthest.is_without_truth) or not depth:
        return furthest
    for name, value, reason in _proposals(path, r):
        tried = _search(path, r.with_options(**{name: value}), {**why, name: reason}, depth - 1)
        if not tried.refusal:
            return tried
        is_of_option = flag_of(name) in tried.refusal or str(value) in tried.refusal
        if len(tried.why) > len(furthest.why) and furthest.refusal not in ("", tried.refusal) and not is_of_option:
            furthest = tried
    return furthest


def _proposals(path: Path, r: Reading) -> Iterator[tuple[str, Any, str]]:
    """Options that the file may need next, the likelier first: name, value, reason."""
    if file_kinds.is_bag(path):
        yield from _topics(path, r)
        return
    if r.sources.truth is None and not TRUTH.search(path.stem):
        for other in _beside(path, TRUTH):
            yield "truth", other, "called a truth, beside the estimates"
    if r.sources.covariance is None and path.suffix != ".csv" and not (path.is_dir() and file_kinds.table_files(path)):
        for other in _beside(path, COVARIANCE):
            yield "covariance", other, "called a covariance, beside the estimates"
    if r.components.state is None and (state := _state(path, r)):
        yield "state", state, "columns of numbers with a truth and a stated covariance"


def _topics(path: Path, r: Reading) -> Iterator[tuple[str, Any, str]]:
    """Topics of estimates, then of the truth of one."""
    from consistency.referee.readers.formats.ros_bag import ESTIMATES, FIX, POSES, topics_of

    topics = sorted(topics_of(path), key=lambda one: -one.messages)
    if r.sources.topic is None:
        there = [one for one in topics if one.kind in ESTIMATES and not TRUTH.search(one.name)]
        there.sort(key=lambda one: (one.kind in FIX, not FILTERED.search(one.name)))
        for one in there[:MOST]:
            others = ", ".join(other.name for other in there if other is not one)
            reason = "has poses with covariances, and is not called a truth"
            yield "topic", one.name, reason + (f"; {others} would do, too" if others else "")
    elif r.sources.truth_topic is None:
        for one in topics:
            if one.kind in POSES and one.name != r.sources.topic and TRUTH.search(one.name):
                yield "truth_topic", one.name, "has poses, and is called a truth"


def _beside(path: Path, words: re.Pattern[str]) -> list[Path]:
    """Files near a file, or folders near a folder, in whose names one of some words stands, the most alike first."""
    near = [other for other in path.parent.iterdir() if other != path and other.is_dir() == path.is_dir()]
    near = [other for other in near if words.search(other.stem)]
    if words is TRUTH:
        near += filter(file_kinds.is_drive, path.parent.iterdir())
    near = [other for other in near if other.is_dir() or other.suffix.lower() in file_kinds.SUFFIXES]

    def alike(other: Path) -> int:
        return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(other.name, path.name, strict=False)))

    return sorted(near, key=lambda other: (-alike(other), other.name))[:MOST]


def _state(path: Path, r: Reading) -> list[str]:
    """Columns of a table that have a truth, beside it or in its file, and a covariance; none where a pose is there."""
    names = _names(path, r)
    true = {stem_of(name, TRUE) for name in names}
    if r.sources.truth is not None and not r.sources.truth.is_dir():
        true |= {*_names(r.sources.truth, make_reading(columns=r.components.truth_columns))}
    state = [name for name in names if name in true and name.lower() not in COUNTED]
    stated = [axis for axis in state if covariance_columns(names, [axis]).in_order(1)]
    is_pose = len(state_columns(names, POSE, OWN)) == len(POSE) and covariance_columns(names, POSE).places
    if is_pose or not stated:
        return []
    return stated if covariance_columns(names, stated).in_order(len(stated)) else []


def _names(path: Path, r: Reading) -> list[str]:
    """Names of the columns of a table; of a folder those of its first one."""
    if path.is_dir():
        path = next(iter((*file_kinds.table_files(path), *file_kinds.trajectory_files(path))), path)
    if path.suffix.lower() in file_kinds.TABLES[1:]:
        from consistency.referee.readers.formats.sheet import read_sheet

        return list(read_sheet(path, r.components.columns).data)
    head = None if file_kinds.is_solution(path) else file_kinds.head_of(path, r.components.columns)
    return [] if head is None else list(head.names)


def _advised(path: Path, tried: Attempt) -> Attempt:
    """With options that notes advise, each where its note is then gone; not where a note leaves a choice."""
    options = {flag_of(each.name): each for each in OPTIONS}
    for note in chain.from_iterable(record.origin.notes for record in tried.records):
        advised = ADVICE.search(note)
        if advised is None or note.count("--") > 1 or "or if" in note or advised[1] not in options:
            continue
        name, parse = options[advised[1]].name, options[advised[1]].parse
        value: Any = advised[2] if parse is None else parse(advised[2])
        why = {**tried.why, name: note.partition(": ")[2].partition("; ")[0]}
        if tried.reading.option(name) is None:
            again = _attempt(path, tried.reading.with_options(**{name: value}), why)
            if not again.refusal and all(note not in record.origin.notes for record in again.records):
                tried = again
    return tried


def _groups(path: Path, tried: Attempt) -> list[str]:
    """A line on columns that make groups, of which the first that is not refused is named."""
    names = [name for name in _names(path, tried.reading) if QUALITY.fullmatch(name)]
    names = [name for name in names if name.lower() not in COUNTED and not COVARIANCE.search(name)]
    if file_kinds.is_bag(path):
        from consistency.referee.readers.formats.ros_bag import ESTIMATES, SINCE, topics_of

        used = (tried.reading.sources.topic, tried.reading.sources.truth_topic)
        topics = [one.name for one in topics_of(path) if one.kind in ESTIMATES and one.name not in used]
        # a filter may take other topics of poses or fixes as measurements
        names = ["turn_rate", "speed", *(SINCE + topic for topic in topics if not TRUTH.search(topic))]
        path = path if file_kinds.is_one_bag(path) else min(filter(file_kinds.is_one_bag, path.iterdir()))
    elif file_kinds.is_solution(path):
        names = ["Q", "ns"]
    for name in names[:MOST] if tried.reading.groups.by is None else ():
        if not _attempt(path, tried.reading.with_options(by=name), {}).refusal:
            others = listed([other for other in names if other != name])
            return [f"--by {name} says where the covariance is wrong" + (f"; also {others}" if others else "")]
    return []


# --- files that are not judged with their truth -------------------------------------------------------


def _refused(path: Path, kind: read_files.Kind, facts: Pairs, tried: Attempt) -> Inspection:
    """Innovations, or poses that state no covariance; what is missing otherwise."""
    r = tried.reading
    if path.is_file() and not file_kinds.is_bag(path):
        with suppress(InputError):
            return _innovations(path, r, kind.name, facts)
    why = [(flag_of(name), text) for name, text in tried.why.items()]
    if not tried.found and (r.sources.truth or r.sources.truth_topic) and set(r.given()) <= OF_DRIVES:
        with suppress(InputError):
            found = kind.read(path, read_files.checked_options(r), True)
            facts = (*facts, *Attempt(r, {}, found).facts)
            option, how = "--span", "'fit-covariance' finds one for its motions"
            reason = "length of the motions that need a covariance: metres, seconds (1s) or steps (10)"
            command = _command("fit-covariance", path, r, ("--span", "1m"))
            rows = _attempt(path, r.with_options(unstated=True, independent=True), {})
            if not rows.refusal and all(map(_is_of_rows, _attempt(path, r.with_options(unstated=True), {}).records)):
                option = "--independent"
                reason = "no correlation of neighbouring rows is found, at a false-alarm rate of 1 %"
                how = f"'correct' finds one, judged row by row. If rows are poses of a drive: {command}"
                command = _command("correct", path, r.with_options(independent=True))
            note = f"{tried.refusal}; if the estimator has one, write it; {how}"
            why.append((option, reason))
            return Inspection(path, kind.name, facts, (note,), tuple(why), command)
    notes = ("by its name it is the truth; inspect the estimates",) if TRUTH.search(path.stem) else ()
    if not tried.found and r.sources.truth is None and not file_kinds.is_bag(path):  # beside itself, for the facts
        own = _attempt(path, r.with_truth(path), {}).facts
        facts = (*facts, *(fact for fact in own if fact[0] != "truth"))
    missing = tried.refusal
    if "--truth FILE" in missing and not notes:
        missing += f"; what to run then says: {_command('inspect', path, r, ('--truth', 'FILE'))}"
    return Inspection(path, kind.name, facts, notes, tuple(why), missing=missing)


def _is_of_rows(record: Record) -> bool:
    """Whether errors of rows may be independent, as of detections: no correlation of neighbours is found.

    The sum of their products is compared with the root of that of the squared products, so that errors of any size in
    each row keep the rate, which all components share.
    """
    e = record.errors.error
    if e is None or np.isfinite(e).all(axis=-1).sum() < FEWEST_ROWS:
        return False
    centred = e - np.nanmean(e, axis=1, keepdims=True)
    products = centred[:, 1:] * centred[:, :-1]
    with np.errstate(invalid="ignore"):
        z = np.nansum(products, axis=(0, 1)) / np.sqrt(np.nansum(np.square(products), axis=(0, 1)))
    return bool((z < -special.ndtri(CORRELATED / e.shape[-1])).all())


def _innovations(path: Path, r: Reading, kind: str, facts: Pairs = (), choice: Mapping[str, Any] = {}) -> Inspection:
    """Innovations of one run, which the monitor judges; ``choice`` of a filter and a run."""
    try:
        log = read_innovations(path, choice.get("filter"), choice.get("run"), r.with_truth(None))
    except SeveralError as several:
        there = (f"{several.what}s", listed(several.there, 30))
        return _innovations(path, r, kind, (*facts, there), {several.option: several.there[0], **choice})
    extra = [word for name, value in choice.items() for word in (f"--{name}", str(value))]
    own = make_reading(columns=r.components.columns, dof=r.statement.dof)
    command = _command("monitor", path, own, (*extra, "--innovations", "optimal"))
    judged = log.dof > 0
    dof = listed(np.unique(log.dof[judged]).astype(int).tolist())
    facts = (*facts, ("innovations", f"{judged.sum()}{_span(log.t)}, degrees of freedom {dof}"))
    why = (*((f"--{name}", "the first that is there") for name in choice), ("--innovations", OPTIMAL))
    return Inspection(path, f"{kind}, innovations", facts, log.notes, why, command)


def _dataflash(path: Path, r: Reading) -> Inspection:
    """A log of ArduPilot: a sensor with variances of its innovations, or test ratios, of which nothing is judged."""
    kind = "flight log of ArduPilot"
    for sensor in flight_logs.STATED:
        with suppress(InputError):
            return _innovations(path, r, kind, (), {"filter": sensor})
    ratios, notes = flight_logs.read_ratios(path)
    what = "it holds test ratios and no variances of innovations: they are shown, and nothing is judged"
    facts = (("sensors", listed([each.sensor for each in ratios], 30)),)
    return Inspection(path, kind, facts, (*notes, what), command=_command("monitor", path, Reading()))


# --- facts -------------------------------------------------------------------------------------------


def _contents(path: Path, r: Reading) -> Pairs:
    """Topics of a bag, columns of a table, files of a folder."""
    if file_kinds.is_bag(path):
        from consistency.referee.readers.formats.ros_bag import topics_of

        return tuple(("topic", one.text) for one in topics_of(path))
    facts = []
    if path.is_dir():
        files = file_kinds.trajectory_files(path) or file_kinds.table_files(path)
        facts.append(("files", f"{len(files)}, {listed([each.name for each in files], 3)}"))
    if names := _names(path, r):
        facts.append(("columns", listed(names, 30)))
    return tuple(facts)


def _facts(found: Estimator | Record) -> Iterator[tuple[str, str]]:
    if isinstance(found, Record):
        yield "rows", f"{plural(len(found.run_numbers), 'run')} of {plural(len(found.runs.t), 'step')}"
        return
    runs, first = found.runs, found.runs[0]
    rows = [len(p.own.t) for p in runs]
    size = plural(rows[0], "row") if min(rows) == max(rows) else f"{min(rows)} to {max(rows)} rows"
    yield "rows", f"{found.name}: {plural(len(runs), 'run')} of {size}{_span(first.seconds)}"
    clock = f"{'steps' if first.source.numbered else 'times'}, {first.own.t[0]:.10g} to {first.own.t[-1]:.10g}"
    if not first.source.numbered and EPOCH < first.own.t[0] < 4 * EPOCH:
        clock += f", from {datetime.fromtimestamp(first.own.t[0], timezone.utc):%Y-%m-%d %H:%M} UTC"
    yield "clock", clock
    if found.innovations_alone:
        return
    yield "covariance", "; ".join(_covariance(found))
    share = sum(len(p.known().rows) for p in runs) / max(sum(rows), 1)
    of_truth = "" if first.source.numbered else _span(first.true.t)
    yield "truth", f"{plural(len(first.true.t), 'row')}{of_truth}; at {percent(share, 3)} of the estimates"


def _span(t: Array) -> str:
    """Rate and span of times, s; "" of steps that have none."""
    t = t[np.isfinite(t)]
    step = np.median(np.diff(t)) if len(t) > 1 else 0.0
    return f", {1.0 / step:.3g} Hz, {t[-1] - t[0]:.4g} s" if step > 0 else ""


def _stated(e: Estimator) -> Array:
    """All covariances that are stated, (N, n, n)."""
    return np.concatenate([p.own.covariance[p.own.stated] for p in e.runs])


def _covariance(e: Estimator) -> Iterator[str]:
    """Median deviations of all components, and components that are not stated or never change."""
    variances = np.diagonal(_stated(e), axis1=1, axis2=2)
    if not len(variances):
        yield "none is stated"
        return
    usual = np.sqrt(np.abs(np.nanmedian(variances, axis=0)))
    parts = "matrix" if e.error.stated == WHOLE else "deviations alone" if e.error.stated.alone else "blocks"
    yield f"{parts}, sigma {', '.join(f'{axis} {s:.2g}' for axis, s in zip(e.error.axes, usual, strict=True))}"
    same = (variances == variances[0]).all(axis=0)
    value = variances[0]
    for words, some in (
        ("0 throughout", same & (value == 0)),
        ("-1, so not known", same & (value == -1)),
        ("huge, so not known", (variances >= LARGE).all(axis=0)),
        ("constant", same & (value > 0) & (value < LARGE)),
    ):
        if some.any() and len(variances) > 1:
            yield f"{words}: {', '.join(np.array(e.error.axes)[some])}"


def _suspects(e: Estimator) -> Iterator[str]:
    """Placeholders, broken and constant covariances, and deviations of unlike size."""
    P = np.zeros((0, 1, 1)) if e.innovations_alone else _stated(e)
    if len(P) > 1:
        some = np.flatnonzero(P.any(axis=(0, 1))).tolist()  # components with a variance
        bad = int((classify(submatrices(P, some), ROUNDED) != Validity.VALID).sum())
        if bad and e.error.stated == WHOLE:
            yield f"the covariance of {bad} of {len(P)} rows is not positive definite"
        if (P[0] == P).all():
            yield "the covariance is the same in every row: a number that was set once, rather than a filter's"
        sigma = np.sqrt(np.abs(np.nanmedian(np.diagonal(P, axis1=1, axis2=2), axis=0)))
        usual = dict(zip(e.error.axes, sigma, strict=True))
        for unit in (("x", "y", "z"), ("roll", "pitch", "yaw"), ("vx", "vy", "vz")):
            of = {usual[axis]: axis for axis in unit if axis in usual and 0 < usual[axis] ** 2 < LARGE}
            if of and max(of) > UNLIKE * min(of):
                times = f"{short(max(of) / min(of))} times that of {of[min(of)]}"
                yield f"the stated deviation of {of[max(of)]} is {times}; one of them may be a placeholder"
    if e.error.in_space and e.runs[0].manifold == "spatial":
        for name, values in (("estimates", "estimate"), ("truth", "truth")):
            q = np.concatenate([p.value(values)[:, 3:7] for p in e.runs])
            if len(q) > 1 and (q == q[0]).all():
                yield f"the orientation of the {name} is the same in every row; if it is a placeholder, --axes x,y,z"


# --- the command line --------------------------------------------------------------------------------


def _command(name: str, path: Path, r: Reading, extra: Sequence[str] = ()) -> str:
    """A command line that a shell runs as it stands."""
    words = ["consistency", name, str(path)]
    for option, value in r.as_options().items():
        if isinstance(value, Mapping):
            value = ",".join(f"{new}={old}" for new, old in value.items())
        elif isinstance(value, (list, tuple)):
            value = ",".join(map(str, value))
        words += [flag_of(option)] if value is True else [flag_of(option), str(value)]
    return shlex.join([*words, *extra])
