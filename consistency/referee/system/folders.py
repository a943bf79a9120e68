"""Output folders: files and a manifest, written whole or not at all.

A manifest says where files came from. The data that come with the package are found here, too.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import itertools
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from importlib import metadata, resources
from pathlib import Path
from typing import Any

from consistency.referee.errors import InputError
from consistency.referee.parsing import one_line, read_json
from consistency.referee.system.stopping import (
    AT_STOP,
    left_beside,
    make_durable,
    partial_folder,
    remove_at_stop,
    umask,
)

IN_PYTHON = "(overwrite=True in Python)"
NOT_OURS = "opencv"  # brings a BLAS of its own, with which no run is computed
SCHEMA_VERSION = 1
PACKAGES = (
    "filter-consistency", "numpy", "scipy", "numba", "filterpy", "pandas", "pyarrow", "joblib", "matplotlib",
    "typst",
)  # fmt: skip
SUMMARY = re.compile(r'^summary = "(.*)"$', re.MULTILINE)

# --- writing -------------------------------------------------------------------------------------


def require_free(folder: Path, overwrite: bool, kind: str = "results", option: str = "--out") -> None:
    """Refuse, before any work, a folder that exists or cannot be made.

    With ``overwrite`` only a folder that this bench wrote may be replaced, and only by one of its own
    ``kind`` (results, log, findings).
    """
    try:
        folder.exists()
    except (OSError, ValueError) as error:
        raise InputError(f"{option} {one_line(folder)}: no folder can have that name ({one_line(error, 60)})") from None
    with writing(folder, option):
        _clear(folder)
    if folder.exists() or folder.is_symlink():
        if not overwrite:
            raise InputError(f"{option} {folder}: exists already; choose another folder or add --overwrite {IN_PYTHON}")
        try:
            before = read_manifest(folder).get("kind")
            if before != kind:
                raise InputError(f"it holds {before}, not {kind}")
        except InputError as error:
            raise InputError(
                f"{option} {folder}: is not an output folder of this bench; not overwritten ({error})"
            ) from None
    with writing(folder, option):
        partial_folder(folder, _above(folder)).rmdir()


def _clear(folder: Path) -> None:
    """Remove what commands that were killed have left, and put back the folder that one was replacing."""
    for left in left_beside(folder, _above(folder)):
        replaced = left / "replaced"
        if replaced.exists() and not folder.exists():
            os.replace(replaced, folder)
        shutil.rmtree(left)


@contextmanager
def writing(folder: Path, option: str = "--out") -> Iterator[None]:
    """Where the system refuses, say it of the option."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{option} {folder}: cannot be written ({error.strerror or error})") from error


def _above(folder: Path) -> Path:
    return next((parent for parent in folder.absolute().parents if parent.exists()), folder)  # itself: the root


class NewFolder:
    """An output folder in the making, beside its place; as a context it is gone at the end unless it was put there.

    ``path`` is where its files are written: in the folder ``within``, or where none is given in one of its own.
    Whatever is refused is refused at the beginning, see :func:`require_free`. With ``overwrite`` an output folder of
    this bench is replaced; with ``keep_others`` the files in it that are not written again stay. ``is_placed`` says
    whether it stands where it stays.
    """

    def __init__(
        self, folder: Path, kind: str, overwrite: bool = False, keep_others: bool = False, within: Path | None = None
    ) -> None:
        require_free(folder, overwrite, kind)
        self.folder = folder
        self.kind = kind
        self.overwrite = overwrite
        self.keep_others = keep_others
        self.within = within
        self.is_placed = False
        self._removal: Callable[[], None] | None = None
        if within is not None:
            self.path = within / "tables"
            shutil.rmtree(self.path, ignore_errors=True)  # of a process that was ended
            return
        with self.writing():
            self.path = partial_folder(folder, _above(folder))
        self._removal = remove_at_stop(self.path)

    def __enter__(self) -> NewFolder:
        return self

    def __exit__(self, *_: object) -> None:
        if self._removal in AT_STOP:
            AT_STOP.remove(self._removal)
        shutil.rmtree(self.path, ignore_errors=True)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Where the system refuses, say it of the option ``--out``."""
        with writing(self.folder):
            yield

    def put_in_place(self, manifest: dict[str, Any]) -> None:
        """Write the manifest and move the folder to its place as a whole.

        Raises
        ------
        InputError
            The place was taken meanwhile; the folder then stands beside it, by the name that is said. The system
            refuses.
        """
        with self.writing():
            (self.path / "manifest.json").write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
            self.path.chmod(0o777 & ~umask())
            for path in (*self.path.iterdir(), self.path):
                make_durable(path)
            self.folder.parent.mkdir(parents=True, exist_ok=True)
        try:
            require_free(self.folder, self.overwrite, self.kind)  # the work may have taken hours
        except InputError as error:
            raise InputError(f"{error}; the finished work is in {self._put_beside()}") from None
        with self.writing():
            _put_in_place(self.path, self.folder, self.keep_others, self.within)
            make_durable(self.folder.parent)
        self.is_placed = True

    def _put_beside(self) -> Path:
        """Move the folder to the first free name: the place was taken while the work was done."""
        names = (self.folder.with_name(f"{self.folder.name}-{number}") for number in itertools.count(2))
        beside = next(path for path in names if not (path.exists() or path.is_symlink()))
        with self.writing():
            os.replace(self.path, beside)
        self.is_placed = True
        return beside


def write_folder(
    folder: Path,
    manifest: dict[str, Any],
    contents: Callable[[Path], None],
    overwrite: bool = False,
    keep_others: bool = False,
    complete: Callable[[NewFolder, dict[str, Any]], dict[str, Any]] = lambda _, manifest: manifest | {"tables": []},
) -> None:
    """The manifest, which says what ``kind`` of folder it is, and what ``contents`` writes, as a :class:`NewFolder`.

    ``complete`` gives the manifest with what is known of the files when they are written.
    """
    with NewFolder(folder, manifest["kind"], overwrite, keep_others) as new:
        with new.writing():
            contents(new.path)
        new.put_in_place(complete(new, manifest))


def _put_in_place(partial: Path, folder: Path, keep_others: bool, within: Path | None) -> None:
    if not folder.exists():
        os.replace(partial, folder)
        return
    if keep_others:
        for path in folder.iterdir():
            copy = partial / path.name
            if path.is_dir() and not copy.exists():
                shutil.copytree(path, copy)
            elif not copy.exists():
                shutil.copy2(path, copy)
    aside = within or partial_folder(folder, folder.parent)
    shutil.rmtree(aside / "replaced", ignore_errors=True)
    os.replace(folder, aside / "replaced")
    os.replace(partial, folder)
    if within is None:
        shutil.rmtree(aside)


def unfinished_of(out: Path) -> Path:
    """Return the folder beside an output folder in which unfinished work on it is kept."""
    return out.absolute().parent / f".{out.absolute().name}.unfinished"


# --- reading -------------------------------------------------------------------------------------


def read_manifest(folder: Path) -> dict[str, Any]:
    """``manifest.json`` of an output folder."""
    path = folder / "manifest.json"
    if not folder.exists() and unfinished_of(folder).is_dir():
        raise InputError(
            f"{folder}: not written yet, its runs are in a journal; the same 'consistency run' with --resume "
            "continues, and with --resume --runs 1 writes what is finished"
        )
    if not folder.is_dir():
        fault = "no such folder"
        if folder.exists():
            fault = "a file, not a folder"
        raise InputError(f"{folder}: {fault}")
    if not path.exists():
        raise InputError(f"{path}: missing; give a folder that 'consistency' wrote")
    manifest = read_json(path)
    if not isinstance(manifest, dict) or manifest.get("schema_version") != SCHEMA_VERSION:
        raise InputError(f"{path}: key 'schema_version' must be {SCHEMA_VERSION}; write the folder again")
    return manifest


@functools.cache
def _found() -> tuple[tuple[str, str], ...]:
    cores = set()
    with suppress(ImportError):  # nothing is simulated then
        from threadpoolctl import threadpool_info

        for library in threadpool_info():
            if library["user_api"] == "blas" and NOT_OURS not in library["filepath"]:
                cores.add(str(library.get("architecture")))
    return ("cpu", _cpu()), ("blas", ", ".join(sorted(cores)) or "unknown")


def digest_of_sources(root: Path, places: Iterable[str]) -> str:
    """SHA-256 of modules below ``root``, their names and contents; a place is a file or a folder.

    Raises
    ------
    FileNotFoundError
        A place is gone.
    """
    digest = hashlib.sha256()
    for name in places:
        place = root / name
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def this_machine() -> dict[str, str]:
    """``cpu``: model of the processor; ``blas``: for which architecture the loaded BLAS has chosen its code.

    The last bits of results depend on both.
    """
    return dict(_found())


def in_words(machines: Iterable[Mapping[str, str]]) -> str:
    """Machines as :func:`this_machine` has them, for a sentence."""
    return " and ".join(f"{machine.get('cpu')} (BLAS: {machine.get('blas')})" for machine in machines)


def _cpu() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine() or "unknown"


def manifest_of(kind: str = "results", **fields: Any) -> dict[str, Any]:
    """Provenance that every output folder of a ``kind`` (results, log, findings) carries."""
    wall = fields.pop("wall", None)
    if wall is not None:
        wall = round(wall, 3)
    return {
        "schema_version": SCHEMA_VERSION,
        "kind": kind,
        "date": datetime.now(timezone.utc).date().isoformat(),
        "versions": dict(_versions()),
        "machines": [this_machine()],
        "command": command_line(),
        "git_commit": _git_commit(),
        "wall_time_s": wall,
        **fields,
    }


def command_line() -> str:
    """The command line of this process, as a shell takes it."""
    program = Path(sys.argv[0]).name
    if program == "__main__.py":
        program = "consistency"
    return shlex.join([program, *sys.argv[1:]])


@functools.cache
def _versions() -> tuple[tuple[str, str], ...]:
    """Python and the packages that results depend on; reading them takes milliseconds, so once a process."""
    versions = [("python", platform.python_version())]
    for package in PACKAGES:
        try:
            versions.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            versions.append((package, "not installed"))
    return tuple(versions)


@functools.cache
def _git_commit() -> str | None:
    """Commit of the checkout that the package runs from, with ``-dirty`` where it was changed; None elsewhere.

    Asked once a process, as its modules are read once.
    """
    root = Path(__file__).parents[3]
    if not (root / ".git").exists():  # installed, perhaps inside somebody else's repository
        return None
    command = ["git", "-C", str(root), "status", "--porcelain=v2", "--branch", "--untracked-files=no"]
    try:
        lines = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout.splitlines()
    except (OSError, subprocess.SubprocessError):
        return None
    commit, changed = None, ""
    for line in lines:
        if line.startswith("# branch.oid "):
            commit = line.split()[-1]
        elif not line.startswith("#"):
            changed = "-dirty"
    if commit in (None, "(initial)"):
        return None
    return f"{commit}{changed}"


def data_folder(name: str) -> Path:
    """Folder of shipped data (``scenarios``, ``experiments``): inside the wheel, else beside the package."""
    inside = Path(str(resources.files("consistency"))) / "_data" / name
    beside = Path(str(resources.files("consistency"))).parent / name
    if inside.is_dir():
        return inside
    return beside


def summaries() -> dict[str, dict[str, str]]:
    """A line about each shipped scenario, experiment and sweep, by its name."""
    experiments = data_folder("experiments")
    return {
        "scenarios": _summaries_in(data_folder("scenarios"), "*.toml"),
        "experiments": _summaries_in(experiments, "e[0-9][0-9]_*.py"),
        "sweeps": _summaries_in(experiments / "sweeps", "*.toml"),
    }


def _summaries_in(folder: Path, pattern: str) -> dict[str, str]:
    """The ``summary`` of each table, or the first line of each script's docstring; "" without."""
    summaries = {}
    for path in sorted(folder.glob(pattern)):
        text = path.read_text(encoding="utf-8")
        summary = ""
        if path.suffix == ".py":
            summary = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]
        elif (line := SUMMARY.search(text)) is not None:
            summary = line[1]
        summaries[path.stem] = summary
    return summaries
