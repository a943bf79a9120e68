"""The output folder of a study of a program: made, locked, resumed or replaced."""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from consistency.referee.errors import InputError
from consistency.referee.parsing import one_line
from consistency.referee.readers.pipeline.program_runs import ProgramStudy, study_in
from consistency.referee.readers.pipeline.read_files import PROGRAM_RUNS, is_program_runs
from consistency.referee.system.atomic import PARTIAL, write_whole
from consistency.referee.system.folders import IN_PYTHON, writing
from consistency.referee.system.provenance import manifest_of

LOCK = ".lock"
SAME = {  # keys of the manifest that a resumed study must have, and what they are called
    "words": "the words of the command have",
    "files": "{} has",
    "seed": "--seed has",
    "inputs": "the files of --each have",
    "cwd": "--cwd has",
}


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
            _require_same(study_in(folder), manifest)
        else:
            _clear(folder)
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


def _clear(folder: Path) -> None:
    """Remove runs of an earlier study; their folder has another name first, so that none is taken for a new one."""
    aside = folder / f".replaced-{os.getpid()}"
    with writing(folder), suppress(FileNotFoundError):
        (folder / "runs").rename(aside)
    for old in folder.glob(".replaced-*"):
        shutil.rmtree(old, ignore_errors=True)


def _require_same(before: ProgramStudy, manifest: Mapping[str, Any]) -> None:
    """Refuse to resume another study."""
    for key, what in SAME.items():
        if before.manifest.get(key) != manifest.get(key):
            what = what.format(_changed(before.manifest.get(key), manifest.get(key)))
            raise InputError(f"--resume: {what} changed since the runs in {before.folder}; use --overwrite")


def _changed(old: Any, new: Any) -> str:
    """Which file changed."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return ""
    return str(next(name for name in {**old, **new} if old.get(name) != new.get(name)))
