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
        arrays |= {f"{i} {key}": array for key in OF_POSES if (array := getattr(p, key)) is not None}
        if one.t is not None:
            arrays[f"{i} times"] = one.t
        about.append(
            {key: _plain(getattr(one, key)) for key in TEXTS}
            | {f"poses {key}": getattr(p, key) for key in TEXTS_OF_POSES}
            | {
                "path": str(one.path), "files": [str(file) for file in p.files], "alone": one.stated.alone,
                "groups": {name: [group.start, group.stop] for name, group in one.stated.groups.items()},
                "beside": p.true_t is p.t,
            }
        )  # fmt: skip
    partial = folder / f"{NUMBERS}.partial"
    with partial.open("wb") as file:
        np.savez(file, about=np.array(json.dumps(about)), **arrays)
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
        return [_estimator(i, one, arrays) for i, one in enumerate(about)]


def _estimator(i: int, about: dict[str, Any], arrays: dict[str, Any]) -> Estimator:
    own: dict[str, Any] = {key: arrays.get(f"{i} {key}") for key in OF_POSES}
    if about["beside"]:
        own["true_t"] = own["t"]  # the same array says that every estimate has its truth beside it
    texts = {key: about[f"poses {key}"] for key in TEXTS_OF_POSES}
    path = Path(about["path"])
    estimates, truth = (Path(file) for file in about["files"])
    place = Places(lambda row: f"{path}, row {row + 1}", np.arange(len(arrays[f"{i} t"])))
    poses = Poses(place=place, files=(estimates, truth), **own, **texts)
    groups = {name: slice(*ends) for name, ends in about["groups"].items()}
    return Estimator(
        path=path, runs=[poses], stated=Stated(groups, about["alone"]), t=arrays.get(f"{i} times"),
        **{key: about[key] for key in TEXTS} | {"axes": tuple(about["axes"])},
    )  # fmt: skip


def _plain(value: Any) -> Any:
    """A value as JSON holds it."""
    return list(value) if isinstance(value, (tuple, list)) else value
