"""One estimator of the tables or files of single runs, of which each has a truth of its own."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.errors import InputError
from consistency.referee.parsing import reading
from consistency.referee.readers.formats.file_kinds import paired, table_files
from consistency.referee.readers.formats.table import read_tables
from consistency.referee.readers.options import Reading
from consistency.referee.readers.places import Places
from consistency.referee.readers.truth_matching import OF_ESTIMATES, OF_TRUTH, Estimator, Poses, Stated


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
    if r.truth is not None:
        r = replace(r, truth=paired(r.truth, file, "--truth", "table '{}'"))
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
        if (one.axes, one.stated, one.convention) != (first.axes, first.stated, first.convention):
            raise InputError(f"{one.path}: has another state or kind of covariance than {first.path}")
        poses.append(replace(one.runs[0], run=run))
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


def _without_paths(note: str, one: Estimator) -> str:
    """A note as the files of every run would have it."""
    for path in (one.path, *one.runs[0].files):
        note = note.replace(str(path), "")
    return note


# --- numbers of a run in place of its files ----------------------------------------------------------

NUMBERS = "numbers.npz"  # in the folder of a run
OF_POSES = tuple(name for name in (*OF_ESTIMATES, *OF_TRUTH) if name != "by")  # whose cells may be words
TEXTS_OF_POSES = ("manifold", "convention", "max_dt", "run", "name", "numbered", "open_end")
TEXTS = ("name", "axes", "convention", "definition", "label", "notes", "causes", "judged", "in_space", "position",
         "innovations_alone")  # fmt: skip


def keep_numbers(folder: Path, estimators: Sequence[Estimator]) -> None:
    """Write the numbers of a run, one set of poses for each of its estimators, into its folder."""
    arrays: dict[str, Any] = {}
    about = []
    for i, one in enumerate(estimators):
        p = one.runs[0]
        for key in OF_POSES:
            arrays[f"{i} {key}"] = getattr(p, key)
        arrays[f"{i} times"] = one.t
        texts: dict[str, Any] = {
            "path": str(one.path),
            "files": list(map(str, p.files)),
            "alone": one.stated.alone,
            "groups": {name: [group.start, group.stop] for name, group in one.stated.groups.items()},
            "beside": p.true_t is p.t,
        }
        for key in TEXTS:
            texts[key] = getattr(one, key)
        for key in TEXTS_OF_POSES:
            texts[f"poses {key}"] = getattr(p, key)
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
    poses = Poses(place=place, files=(estimates, truth), **own)
    groups = {name: slice(*ends) for name, ends in texts["groups"].items()}
    of_estimator = {key: texts[key] for key in TEXTS}
    of_estimator["axes"] = tuple(texts["axes"])
    stated = Stated(groups, texts["alone"])
    return Estimator(path=path, runs=[poses], stated=stated, t=arrays.get(f"{i} times"), **of_estimator)
