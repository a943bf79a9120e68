"""What a file holds, and the command line that judges it: its reader is tried with the options that it seems to need.

What is found is what readers note and hint at; nothing is judged here.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from datetime import datetime, timezone
from itertools import chain
from os.path import commonprefix
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.records.whitening import ROUNDED, Validity, classify
from consistency.referee.diagnostics.words.numbers import percent, plural, short
from consistency.referee.document.blocks import Block, Bullets, Document, Facts, Text, fragment
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.columns import CLOCKS, TRUE, covariance_columns, stem_of
from consistency.referee.readers.formats.file_kinds import (
    SUFFIXES,
    head_of,
    is_bag,
    is_drive,
    is_one_bag,
    is_solution,
    table_files,
    trajectory_files,
    unknown_kind,
)
from consistency.referee.readers.formats.flight_logs import ULOG_SUFFIX, is_dataflash
from consistency.referee.readers.formats.innovation_files import SeveralError
from consistency.referee.readers.options import Reading, flag_of
from consistency.referee.readers.pipeline.read_files import (
    checked_options,
    found_in,
    is_program_runs,
    kind_of,
    read_recordings,
    records_of_found,
)
from consistency.referee.readers.places import listed
from consistency.referee.readers.truth_matching import WHOLE, Estimator
from consistency.referee.types import Array
from consistency.referee.verdicts.monitor_sources import read_innovations

TRUTH = re.compile(
    r"truth|(?<![a-z])(gt|true|ref|reference|mocap|vicon|vrpn|optitrack|leica|rtk|oxts)(?![a-z])", re.IGNORECASE
)  # in names of files and topics
STATED = re.compile(r"cov|(?<![a-z])(p|sigma|std|deviations?)(?![a-z])", re.IGNORECASE)
FILTERED = re.compile(r"filter|fused|fusion|ekf|ukf|estimat|slam|vio|lio|state", re.IGNORECASE)  # in names of topics
QUALITY = re.compile(
    r"q|quality|ns|n_?sat.*|status|mode|fix.*|age|ratio|[hpv]dop|n_\w+|num_?\w+|.*(match|feature|inlier|track|turn|speed|"
    r"rate|weather|light|scene|sensor|battery|temperature).*",
    re.IGNORECASE,
)  # names of columns for --by
COUNTED = ("run", "step", "filter", "nees", "nis", "nis_dof")  # columns that are no components of a state
ADVICE = re.compile(r"\badd (--[a-z-]+) ([^\s;,()]+(?:,[^\s;,()]+)*)")  # in a note of a reader
DEEPEST = 4  # options that are added one after the other
MOST = 4  # candidates of one option
LARGE = 1e6  # a variance from which on it says that nothing is known
UNLIKE = 100.0  # ratio of two deviations of one unit
EPOCH = 1e9  # s: times since 1970
OPTIMAL = "declares the optimal (Kalman) gain, without which innovations cannot be judged"


@dataclass(frozen=True)
class Inspection:
    """What a file holds, and the command line that judges it.

    Attributes
    ----------
    path : Path
    kind : of the file
    facts : names and values: topics or columns, rows, rate, span, clock, covariances, truth
    findings : what its reader notes, and what looks wrong
    options : each option of the command line that is not given already, and why it is needed
    command : the command line; "" where something is missing
    missing : what is missing, and how to name it; "" where there is a command line
    arguments : ``cs.read(path, **arguments)`` reads what the command line does
    """

    path: Path
    kind: str
    facts: tuple[tuple[str, str], ...]
    findings: tuple[str, ...] = ()
    options: Mapping[str, str] | None = None
    command: str = ""
    missing: str = ""
    arguments: Mapping[str, Any] | None = None

    def __str__(self) -> str:
        return fragment(*inspection_document(self).opening)


def inspection_document(found: Inspection) -> Document:
    """Facts, findings, and the command line on the last line."""
    blocks: list[Block] = [Text(f"{found.path}: {found.kind}")]
    if found.facts:
        blocks.append(Facts(found.facts))
    if found.findings:
        blocks += [Text("Findings:"), Bullets(found.findings)]
    if found.options:
        blocks += [Text("Options of the command below, and why:"), Facts(tuple(found.options.items()))]
    if found.missing:
        blocks.append(Text(f"Missing: {found.missing}"))
    if found.command:
        blocks += [Text("To judge it:"), Text(f"  {found.command}")]
    data = asdict(found) | {"path": str(found.path), "arguments": {k: str(v) for k, v in found.arguments.items()}
                            if found.arguments else {}}  # fmt: skip
    return Document(str(found.path), "", (), tuple(blocks), data)


class Attempt(NamedTuple):
    """What readers gave with some options, or why they refused."""

    reading: Reading
    why: Mapping[str, str]  # of options that were added, by name
    found: Sequence[Estimator | Record] = ()
    records: Sequence[Record] = ()
    refusal: str = ""


def inspect(path: Path, reading: Reading | None = None) -> Inspection:
    """Inspect a file or folder; ``reading`` has options that are known already.

    Raises
    ------
    InputError
        There is no such file, or its kind is unknown.
    """
    r = reading or Reading()
    if not path.exists():
        raise InputError(f"{path}: no such file")
    if path.suffix.lower() == ULOG_SUFFIX or is_dataflash(path):
        return _innovations(path, r, "flight log")
    if is_program_runs(path):
        records = read_recordings(path, r)
        return Inspection(
            path, "runs of a program, by 'consistency monte-carlo'", tuple(_of_record(records[0])), records[0].notes,
            {}, _command("analyse", path, r), arguments=_arguments(r),
        )  # fmt: skip
    if (path / "manifest.json").is_file():
        what = "folder of results, by a command of the bench"
        return Inspection(path, what, (), (), {}, _command("analyse", path, r))
    kind = kind_of(path, r)
    if kind is None or (path.is_dir() and not (is_bag(path) or trajectory_files(path) or table_files(path))):
        raise unknown_kind(path)
    facts = _contents(path, r)
    tried = _search(path, r, {}, DEEPEST)
    if tried.refusal:
        return _unjudged(path, kind.name, facts, tried)
    tried = _advised(path, tried)
    facts += list(chain.from_iterable(map(_of_found, tried.found)))
    e = tried.found[0]
    if isinstance(e, Estimator) and e.innovations_alone and len(e.runs) == 1:
        return _innovations(path, r, kind.name, facts)
    notes = [*dict.fromkeys(note for record in tried.records for note in record.notes)]
    notes += [note for each in tried.found if isinstance(each, Estimator) for note in _suspects(each)]
    why = {flag_of(name): text for name, text in tried.why.items()}
    extra = ()
    if isinstance(e, Estimator) and e.innovations_alone:
        extra = ("--innovations", "optimal")
        why["--innovations"] = OPTIMAL
    notes += _groups(path, tried)
    command = _command("analyse", path, tried.reading, extra)
    return Inspection(path, kind.name, tuple(facts), tuple(notes), why, command, "", _arguments(tried.reading))


def says_more(path: Path, r: Reading) -> bool:
    """Whether an inspection would try options that are not given."""
    try:
        return path.exists() and kind_of(path, r) is not None and next(_proposals(path, r), None) is not None
    except InputError:
        return False


# --- trials ------------------------------------------------------------------------------------------


def _attempt(path: Path, r: Reading, why: Mapping[str, str]) -> Attempt:
    try:
        checked = checked_options(r)
        found = found_in(path, checked)
        return Attempt(r, why, found, records_of_found(found, checked))
    except InputError as error:
        return Attempt(r, why, refusal=str(error))


def _search(path: Path, r: Reading, why: Mapping[str, str], depth: int) -> Attempt:
    """The first attempt that is not refused, with options added one by one; the one that came furthest otherwise."""
    furthest = _attempt(path, r, why)
    if not furthest.refusal or not depth:
        return furthest
    for name, value, reason in _proposals(path, r):
        tried = _search(path, replace(r, **{name: value}), {**why, name: reason}, depth - 1)
        if not tried.refusal:
            return tried
        if len(tried.why) > len(furthest.why) and not tried.refusal.startswith(flag_of(name)):
            furthest = tried
    return furthest


def _proposals(path: Path, r: Reading) -> Iterator[tuple[str, Any, str]]:
    """Options that the file may need next, the likelier first: name, value, reason."""
    if is_bag(path):
        yield from _topic_proposals(path, r)
        return
    if r.truth is None:
        for other in _beside(path, TRUTH):
            yield "truth", other, "called a truth, beside the estimates"
    if r.covariance is None and not (table_files(path) if path.is_dir() else path.suffix == ".csv"):
        for other in _beside(path, STATED):
            if other != r.truth:
                yield "covariance", other, "called a covariance, beside the estimates"
    if r.state is None and (state := _state(path, r)):
        yield "state", state, "columns of numbers with a truth and a stated covariance"


def _topic_proposals(path: Path, r: Reading) -> Iterator[tuple[str, Any, str]]:
    from consistency.referee.readers.formats.ros_bag import ESTIMATES, FIX, POSES, topics_of

    topics = topics_of(path)
    if r.topic is None:
        there = [each for each in topics if each.kind in ESTIMATES and not TRUTH.search(each.name)]
        there.sort(key=lambda each: (each.kind in FIX, not FILTERED.search(each.name), -each.messages))
        for each in there[:MOST]:
            others = ", ".join(other.name for other in there if other is not each)
            also = f"; {others} would do, too" if others else ""
            yield "topic", each.name, f"has poses with covariances, and its name is no truth's{also}"
    elif r.truth_topic is None:
        for each in sorted(topics, key=lambda each: -each.messages):
            if each.kind in POSES and each.name != r.topic and TRUTH.search(each.name):
                yield "truth_topic", each.name, "has poses, and is called a truth"


def _beside(path: Path, words: re.Pattern[str]) -> list[Path]:
    """Files near a file, or folders near a folder, in whose names one of some words stands, the most alike first."""
    path = path if path.name else path.resolve()
    near = [other for other in path.parent.iterdir() if words.search(other.stem) and other != path]
    near = [other for other in near if is_drive(other) or other.is_dir() == path.is_dir()]
    if not path.is_dir():
        folders = (each for each in path.parent.parent.iterdir() if each.is_dir() and words.search(each.name))
        near += [each / path.name for each in folders if (each / path.name).is_file()]
    near = [other for other in near if other.is_dir() or other.suffix.lower() in SUFFIXES]
    near.sort(key=lambda other: (-len(commonprefix([other.name, path.name])), other.name))
    return near[:MOST]


def _state(path: Path, r: Reading) -> list[str]:
    """Columns of a table that have a truth, beside it or in its file, and a covariance; none where a pose is there."""
    names = _names(path, r)
    true = {stem for name in names if (stem := stem_of(name, TRUE))}
    if r.truth is not None and not r.truth.is_dir():
        true |= set(_names(r.truth, Reading(columns=r.truth_columns)))
    state = [name for name in names if name in true and name.lower() not in (*COUNTED, *CLOCKS)]
    stated = [axis for axis in state if covariance_columns(names, [axis]).in_order(1)]
    return stated if stated and covariance_columns(names, stated).in_order(len(stated)) else []


def _names(path: Path, r: Reading) -> list[str]:
    """Names of the columns of a table; of a folder those of its first one."""
    if path.is_dir():
        path = next(iter((*table_files(path), *trajectory_files(path))), path)
    if path.suffix.lower() in (".parquet", ".pq", ".jsonl", ".ndjson"):
        from consistency.referee.readers.formats.sheet import read_sheet

        return list(read_sheet(path, r.columns).data)
    head = head_of(path, r.columns)
    return [] if head is None else list(head.names)


def _advised(path: Path, tried: Attempt) -> Attempt:
    """With options that notes advise, each where its note is then gone; not where a note leaves a choice."""
    options = {flag_of(each.name): each for each in fields(Reading)}
    for note in chain.from_iterable(record.notes for record in tried.records):
        advised = ADVICE.search(note)
        if advised is None or note.count("--") > 1 or "or if" in note or advised[1] not in options:
            continue
        name, parse = options[advised[1]].name, options[advised[1]].metadata["parse"]
        if getattr(tried.reading, name) is not None:
            continue
        value = advised[2] if parse is None else parse(advised[2])
        reason = note.partition(": ")[2].partition("; ")[0]
        again = _attempt(path, replace(tried.reading, **{name: value}), {**tried.why, name: reason})
        if not again.refusal and all(note not in record.notes for record in again.records):
            tried = again
    return tried


def _groups(path: Path, tried: Attempt) -> list[str]:
    """A line on columns that make groups, of which the first is tried."""
    if tried.reading.by is not None:
        return []
    names = [name for name in _names(path, tried.reading) if QUALITY.fullmatch(name)]
    if is_bag(path):
        names = ["turn_rate", "speed"]
    elif is_solution(path):
        names = ["Q", "ns"]
    names = [name for name in names if name.lower() not in COUNTED and not STATED.search(name)]
    for name in names[:MOST]:
        if not _attempt(path, replace(tried.reading, by=name), {}).refusal:
            also = [other for other in names if other != name]
            more = f"; also {listed(also)}" if also else ""
            return [f"--by {name} says where the covariance is wrong{more}"]
    return []


# --- files that are not judged with their truth -------------------------------------------------------


def _unjudged(path: Path, kind: str, facts: list[tuple[str, str]], tried: Attempt) -> Inspection:
    """Innovations, or poses without a covariance; what is missing otherwise."""
    r = tried.reading
    try:
        if path.is_file() and not is_one_bag(path):
            return _innovations(path, r, kind, facts)
    except InputError:
        pass
    why = {flag_of(name): text for name, text in tried.why.items()}
    try:
        found = _bare(path, r)
    except InputError:
        named = ["by its name it is the truth; inspect the estimates"] if TRUTH.search(path.stem) else []
        return Inspection(path, kind, tuple(facts), tuple(named), why, "", tried.refusal)
    facts += list(chain.from_iterable(map(_of_found, found)))
    why["--span"] = "length of the motions whose covariance is needed: metres, seconds (1s) or steps (10)"
    command = _command("fit-covariance", path, r, ("--span", "1m"))
    notes = (f"{tried.refusal}; if the estimator has one, write it; 'fit-covariance' finds one for its motions",)
    return Inspection(path, kind, tuple(facts), notes, why, command)


def _bare(path: Path, r: Reading) -> Sequence[Estimator | Record]:
    """Poses whose covariances are not looked at."""
    kind = kind_of(path, r)
    if kind is None or (r.truth is None and r.truth_topic is None):
        raise InputError(f"{path}: states no covariance, and no truth is found")
    return kind.read(path, checked_options(r), True)


def _innovations(
    path: Path, r: Reading, kind: str, facts: Sequence[tuple[str, str]] = (), choice: Mapping[str, Any] | None = None
) -> Inspection:
    """Innovations of one run, which the monitor judges."""
    choice = choice or {}
    why = {f"--{name}": "the first that is there" for name in choice}
    try:
        log = read_innovations(path, choice.get("filter"), choice.get("run"), replace(r, truth=None))
    except SeveralError as several:
        if several.option in choice:
            raise
        there = (f"{several.what}s", listed(several.there, 30))
        return _innovations(path, r, kind, (*facts, there), {**choice, several.option: several.there[0]})
    extra = [word for name, value in choice.items() for word in (f"--{name}", str(value))]
    command = _command("monitor", path, Reading(columns=r.columns, dof=r.dof), (*extra, "--innovations", "optimal"))
    nis = log.nis[log.dof > 0]
    size = plural(len(nis), "innovation") + _span(log.t)
    facts = (*facts, ("innovations", f"{size}, of {listed(np.unique(log.dof[log.dof > 0]).astype(int))} components"))
    why["--innovations"] = OPTIMAL
    return Inspection(path, f"{kind}, innovations", facts, log.notes, why, command)


# --- facts -------------------------------------------------------------------------------------------


def _contents(path: Path, r: Reading) -> list[tuple[str, str]]:
    """Topics of a bag, columns of a table, files of a folder."""
    if is_bag(path):
        from consistency.referee.readers.formats.ros_bag import topics_of

        return [("topic", each.text) for each in topics_of(path)]
    facts = []
    if path.is_dir():
        files = trajectory_files(path) or table_files(path)
        facts.append(("files", f"{len(files)}, {listed([each.name for each in files], 3)}"))
    if names := _names(path, r):
        facts.append(("columns", listed(names, 30)))
    return facts


def _of_found(found: Estimator | Record) -> Iterator[tuple[str, str]]:
    if isinstance(found, Record):
        yield from _of_record(found)
        return
    e = found
    yield "estimator", e.name
    rows = [len(p.t) for p in e.runs]
    yield "rows", f"{sum(rows)} in {plural(len(rows), 'run')}{_span(e.runs[0].seconds)}{' each' if len(rows) > 1 else ''}"
    if e.runs[0].numbered:
        yield "clock", f"numbers of steps, {e.runs[0].t[0]:g} to {e.runs[0].t[-1]:g}"
    else:
        start = float(e.runs[0].t[0])
        is_date = EPOCH < start < 4 * EPOCH
        since = datetime.fromtimestamp(start, timezone.utc).strftime("%Y-%m-%d %H:%M UTC") if is_date else f"{start:g} s"
        yield "clock", f"times, from {since}"
    if e.innovations_alone:
        return
    if any(p.stated.any() for p in e.runs):
        yield "covariance", "; ".join(_covariance(e))
    else:
        yield "covariance", "none is stated"
    if all(np.asarray(p.truth).any() for p in e.runs):
        known = [p.known() for p in e.runs]
        share = sum(len(one.rows) for one in known) / max(sum(rows), 1)
        true = [p.true_t for p in e.runs]
        rate = "" if e.runs[0].numbered else _span(true[0])
        yield "truth", f"{plural(len(true[0]), 'row')}{rate}; beside {percent(share, 3)} of the estimates"


def _of_record(record: Record) -> Iterator[tuple[str, str]]:
    yield "runs", f"{len(record.run_numbers)} of {plural(len(record.t), 'step')}"
    yield "judged", listed(record.names, 20) if record.axes else f"{record.dof} components"


def _span(t: Array) -> str:
    """Rate and span of times, s; "" of steps that have none."""
    t = t[np.isfinite(t)]
    step = np.median(np.diff(t)) if len(t) > 1 else 0.0
    return f", {short(1.0 / step)} Hz, {short(t[-1] - t[0])} s" if step > 0 else ""


def _covariance(e: Estimator) -> Iterator[str]:
    """Deviations of all components in words, in the median of all rows, and which never change or are not stated."""
    P = np.concatenate([p.covariance[p.stated] for p in e.runs])
    variances = np.diagonal(P, axis1=1, axis2=2)
    parts = "whole matrix" if e.stated == WHOLE else "deviations alone" if e.stated.alone else "in blocks"
    usual = np.sqrt(np.abs(np.nanmedian(variances, axis=0)))
    yield f"{parts}; sigma {', '.join(f'{axis} {_brief(s)}' for axis, s in zip(e.axes, usual, strict=True))}"
    for words, rows in (
        ("0 throughout", (variances == 0).all(axis=0)),
        ("-1, not known", (variances == -1).all(axis=0)),
        ("huge, a dummy", (variances >= LARGE).all(axis=0)),
        ("constant", (variances == variances[0]).all(axis=0) & (variances[0] > 0) & (variances[0] < LARGE)),
    ):
        if rows.any() and len(variances) > 1:
            yield f"{words}: {', '.join(np.array(e.axes)[rows])}"


def _brief(value: float) -> str:
    return f"{value:.2g}"


def _suspects(e: Estimator) -> Iterator[str]:
    """What looks unlike an estimate of all that is stated: placeholders, broken and constant covariances, unlike sizes."""
    if e.innovations_alone:
        return
    P = np.concatenate([p.covariance[p.stated] for p in e.runs])
    if len(P):
        bad = int((classify(P, ROUNDED) != Validity.VALID).sum())
        if bad:
            yield f"the covariance of {bad} of {len(P)} rows is not positive definite"
        if len(P) > 1 and (P == P[0]).all():
            yield "the covariance is the same in every row: a number that was set once, rather than a filter's"
        variances = np.abs(np.nanmedian(np.diagonal(P, axis1=1, axis2=2), axis=0))
        for unit in (("x", "y", "z"), ("roll", "pitch", "yaw"), ("vx", "vy", "vz")):
            own = {axis: variances[i] for i, axis in enumerate(e.axes) if axis in unit and 0 < variances[i] < LARGE}
            if own and max(own.values()) > UNLIKE**2 * min(own.values()):
                low, high = min(own, key=own.__getitem__), max(own, key=own.__getitem__)
                times = np.sqrt(own[high] / own[low])
                yield f"the stated deviation of {high} is {short(times)} times that of {low}; one may be a placeholder"
    if e.in_space and e.runs[0].manifold == "spatial":
        for name, values in (("estimates", "estimate"), ("truth", "truth")):
            q = np.concatenate([getattr(p, values)[:, 3:7] for p in e.runs])
            if len(q) > 1 and (q == q[0]).all():
                yield f"the orientation of the {name} is the same in every row; if it is a placeholder, --axes x,y,z"


# --- the command line --------------------------------------------------------------------------------


def _command(name: str, path: Path, r: Reading, extra: Sequence[str] = ()) -> str:
    """A command line that a shell runs as it stands."""
    words = ["consistency", name, str(path)]
    for option in r.given():
        value = getattr(r, option)
        words += [flag_of(option)] if value is True else [flag_of(option), _spelled(value)]
    return shlex.join([*words, *extra])


def _spelled(value: Any) -> str:
    """The value of an option as the command line takes it."""
    if isinstance(value, Mapping):
        return ",".join(f"{new}={old}" for new, old in value.items())
    if isinstance(value, (list, tuple)):
        return ",".join(map(str, value))
    return str(value)


def _arguments(r: Reading) -> dict[str, Any]:
    return {name: getattr(r, name) for name in r.given()}
