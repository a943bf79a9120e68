"""The numbers that were read of a run, kept in place of its files, which may be large."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.parsing import reading
from consistency.referee.readers.places import Places
from consistency.referee.readers.truth_matching import Estimator, Poses, Stated

NUMBERS = "numbers.npz"  # in the folder of a run
OF_POSES = ("t", "estimate", "covariance", "stated", "true_t", "truth", "cross", "true_covariance", "clock",
            "true_clock", "nis", "nis_dof")  # fmt: skip
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
