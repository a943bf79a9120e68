"""What commands ask of the operating system: files and folders that appear whole or not at all, and signals.

A folder of output has a manifest, which says where its files came from. Also the data that come with the package,
processes that end with their parent, and progress of long work: a bar with rate and time left on a terminal, plain
lines elsewhere.
"""

from __future__ import annotations

import ast
import ctypes
import errno
import glob
import hashlib
import itertools
import json
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from contextvars import ContextVar
from datetime import datetime, timezone
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import Any, TypeVar

from consistency.referee.errors import InputError
from consistency.referee.parsing import one_line, read_json

T = TypeVar("T")
Advance = Callable[[int], None]
IN_PYTHON = "(overwrite=True in Python)"
NOT_OURS = "opencv"  # brings a BLAS of its own, with which no run is computed
SCHEMA_VERSION = 1
PACKAGES = (
    "filter-consistency", "numpy", "scipy", "numba", "filterpy", "pandas", "pyarrow", "joblib", "matplotlib",
    "typst",
)  # fmt: skip
SUMMARY = re.compile(r'^summary = "(.*)"$', re.MULTILINE)
FULL = {errno.ENOSPC, errno.EFBIG, errno.EIO, getattr(errno, "EDQUOT", errno.ENOSPC)}  # a disk, a quota, a limit
PARTIAL = ".partial"  # at the end of the name of what is being written
IS_LINUX = sys.platform == "linux"
AT_STOP: list[Callable[[], None]] = []  # what is to be ended before a signal ends this process
WRITERS = 3  # times that a folder is removed, as a thread may be writing into it
PR_SET_PDEATHSIG = 1  # linux/prctl.h
EVERY = 3.0  # seconds between lines of progress
_quiet = ContextVar("quiet", default=False)


# --- output folders ---------------------------------------------------------------------------------------------------


def require_free(folder: Path, overwrite: bool, kind: str = "results", option: str = "--out") -> None:
    """Refuse, before any work, a folder that exists or cannot be made; one that was being replaced is put back.

    With ``overwrite`` only a folder that this bench wrote may be replaced, and only by one of its own
    ``kind`` (results, log, findings).
    """
    try:
        folder.exists()
    except (OSError, ValueError) as error:
        raise InputError(f"{option} {one_line(folder)}: no folder can have that name ({one_line(error, 60)})") from None
    with writing(folder, option):
        for left in left_beside(folder, _above(folder)):  # by commands that were killed
            replaced = left / "replaced"
            if replaced.exists() and not folder.exists():
                os.replace(replaced, folder)
            shutil.rmtree(left)
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


@contextmanager
def writing(folder: Path, option: str = "--out") -> Iterator[None]:
    """Where the system refuses, say it of the option."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{option} {folder}: cannot be written ({error.strerror or error})") from error


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

    def writing(self) -> AbstractContextManager[None]:
        """Where the system refuses, say it of the option ``--out``."""
        return writing(self.folder)

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


def unfinished_of(out: Path) -> Path:
    """Return the folder beside an output folder in which unfinished work on it is kept."""
    return out.absolute().parent / f".{out.absolute().name}.unfinished"


def _above(folder: Path) -> Path:
    return next((parent for parent in folder.absolute().parents if parent.exists()), folder)  # itself: the root


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


# --- files, written whole ---------------------------------------------------------------------------------------------


def write_whole(path: Path, content: bytes, mode: int | None = None) -> None:
    """Write beside ``path`` and rename; ``mode`` of the file, None for what the umask leaves. Raises OSError."""
    for left in left_beside(path, path.parent):
        left.unlink()
    handle, name = tempfile.mkstemp(PARTIAL, f"{_prefix(path)}{os.getpid()}.", path.parent)
    partial = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.chmod(0o666 & ~umask() if mode is None else mode)
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def umask() -> int:
    """Permissions that the user takes from what is written."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def partial_folder(path: Path, above: Path) -> Path:
    """Make a folder in ``above`` for what is to stand at ``path``. Raises OSError."""
    return Path(tempfile.mkdtemp(PARTIAL, f"{_prefix(path)}{os.getpid()}.", above))


def left_beside(path: Path, above: Path) -> Iterator[Path]:
    """Yield what processes of this machine that were killed have left in ``above`` of what was to stand at ``path``."""
    for left in above.glob(f"{glob.escape(_prefix(path))}*{PARTIAL}"):
        process = left.name.removeprefix(_prefix(path)).partition(".")[0]
        if process.isdecimal() and not _lives(int(process)):
            yield left


def make_durable(path: Path) -> None:
    """Bring a file, or the names in a folder, to disk, so that a power cut does not take them. Raises OSError."""
    if os.name == "nt":  # what is only read cannot be synchronised there
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _prefix(path: Path) -> str:
    return f".{path.name}.{platform.node()}-"


def _lives(process: int) -> bool:
    if os.name == "nt":  # where the question would end the process
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


# --- manifests --------------------------------------------------------------------------------------------------------


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


def digest_of_file(path: Path) -> bytes:
    """SHA-256 of a file of any size."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        for piece in iter(lambda: file.read(2**20), b""):
            digest.update(piece)
    return digest.digest()


def this_machine() -> dict[str, str]:
    """``cpu``: model of the processor; ``blas``: for which architecture the loaded BLAS has chosen its code.

    The last bits of results depend on both.
    """
    return dict(_found())


def in_words(machines: Iterable[Mapping[str, str]]) -> str:
    """Machines as :func:`this_machine` has them, for a sentence."""
    return " and ".join(f"{machine.get('cpu')} (BLAS: {machine.get('blas')})" for machine in machines)


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    """Python and the packages that results depend on; reading them takes milliseconds, so once a process."""
    versions = [("python", platform.python_version())]
    for package in PACKAGES:
        try:
            versions.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            versions.append((package, "not installed"))
    return tuple(versions)


@cache
def _git_commit() -> str | None:
    """Commit of the checkout that the package runs from, with ``-dirty`` where it was changed; None elsewhere.

    Asked once a process, as its modules are read once.
    """
    root = Path(__file__).parents[2]
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


@cache
def _found() -> tuple[tuple[str, str], ...]:
    cores = set()
    with suppress(ImportError):  # nothing is simulated then
        from threadpoolctl import threadpool_info

        for library in threadpool_info():
            if library["user_api"] == "blas" and NOT_OURS not in library["filepath"]:
                cores.add(str(library.get("architecture")))
    return ("cpu", _cpu()), ("blas", ", ".join(sorted(cores)) or "unknown")


def _cpu() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine() or "unknown"


# --- data of the package ----------------------------------------------------------------------------------------------


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


# --- signals and processes --------------------------------------------------------------------------------------------


def remove_at_stop(folder: Path) -> Callable[[], None]:
    """Have a half-written folder removed where a signal ends this process; return what ``AT_STOP`` has for it."""

    def remove() -> None:
        for _ in range(WRITERS):
            shutil.rmtree(folder, ignore_errors=True)

    AT_STOP.append(remove)
    return remove


def away_from_signals(call: Callable[..., T], *args: Any) -> T:
    """Return ``call(*args)``, which a thread does while the main one waits; KeyboardInterrupt comes after its end.

    Python runs handlers of signals in the main thread. One that raises where Numba or pyarrow turn their values into
    Python's meets code that expects no exception, and Python crashes.
    """
    if threading.current_thread() is not threading.main_thread():
        return call(*args)
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        pool.submit(int).result()  # a pool waits at its end for the threads that it knows to have begun
        return pool.submit(call, *args).result()


def link_to_parent(context: Any) -> tuple[int, Any]:
    """Return what a worker gives to :func:`end_with_parent`, which ``context`` of multiprocessing starts.

    These are the number of this process and the end of a pipe into which nobody writes. This process alone has its
    other end, so that the pipe is closed when this process ends.
    """
    return os.getpid(), _pipe(context)[0]


def end_with_parent(parent: int, alive: Any) -> None:
    """Have the system kill this worker when its parent ends; ``alive`` is its end of the pipe.

    On Linux the signal comes when the *thread* ends that started the worker, so start workers in one that lives as
    long as they are to.
    """
    if not IS_LINUX:
        threading.Thread(target=_wait_for_the_end, args=(alive,), daemon=True).start()
        return
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it had ended before
        os._exit(1)


@cache
def _pipe(context: Any) -> tuple[Any, Any]:
    ends: tuple[Any, Any] = context.Pipe(duplex=False)
    return ends


def _wait_for_the_end(alive: Any) -> None:
    with suppress(OSError, EOFError):
        alive.recv_bytes()
    os._exit(1)


# --- progress ---------------------------------------------------------------------------------------------------------


def say(text: str) -> None:
    """One line on standard error, unless it is to be quiet, or nobody can read it."""
    if not _quiet.get():
        print(text, file=_Forgiving(), flush=True)


def announce(text: str) -> None:
    """One line on standard error before what takes long, said even where it is to be quiet."""
    print(text, file=_Forgiving(), flush=True)


@contextmanager
def quiet() -> Iterator[None]:
    """Inside, only what is announced is said: many short works report for themselves."""
    token = _quiet.set(True)
    try:
        yield
    finally:
        _quiet.reset(token)


def each(items: Iterable[T], total: int, label: str, unit: str) -> Iterator[T]:
    """The items, ``total`` in number, with progress over them in place of that of the work on each."""
    with progress(label, total, unit) as advance:
        for item in items:
            with quiet():
                yield item
            advance(1)


def with_progress(items: Sequence[T], label: str, unit: str) -> Iterator[T]:
    """The items, with progress over them if there are several and they take more than some seconds."""
    if len(items) < 2:
        yield from items
        return
    with progress(label, len(items), unit, brief=True) as advance:
        for item in items:
            yield item
            advance(1)


@contextmanager
def progress(label: str, total: int, unit: str = "runs", brief: bool = False) -> Iterator[Advance]:
    """Yields a function to call with the number of units just done; writes to standard error.

    ``brief``: nothing remains on a terminal, and where there is none nothing is said of what is over in a few seconds.
    """
    if _quiet.get():
        yield lambda _: None
    elif sys.stderr is not None and sys.stderr.isatty():
        with _bar(label, total, unit, brief) as advance:
            yield advance
    else:
        yield _lines(label, total, unit, brief)


@contextmanager
def _bar(label: str, total: int, unit: str, brief: bool) -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    stream: Any = _Forgiving()
    with Progress(*columns, console=Console(file=stream), transient=brief) as bar:
        task = bar.add_task(label, total=total, rate="")

        def advance(count: int) -> None:
            bar.advance(task, count)
            speed = bar.tasks[0].finished_speed or bar.tasks[0].speed
            if speed:
                bar.update(task, rate=_speed(speed, unit))

        yield advance


def _lines(label: str, total: int, unit: str, brief: bool) -> Advance:
    started = last = time.monotonic()
    done = 0

    def advance(count: int) -> None:
        nonlocal done, last
        done += count
        now = time.monotonic()
        if (done == total and not (brief and now - started < EVERY)) or now - last >= EVERY:
            last = now
            rate = done / max(now - started, 1e-9)
            if done == total:
                speed = f", {_speed(rate, unit)}"
            elif done == count:  # the first: it may have waited for kernels to be compiled
                speed = f", {now - started:.0f} s with the start"
            else:
                speed = f", {_speed(rate, unit)}, {(total - done) / rate:.0f} s left"
            print(f"{label}: {done} of {total} {unit}{speed}", file=_Forgiving(), flush=True)

    return advance


def _speed(rate: float, unit: str) -> str:
    if rate >= 1.0:
        return f"{rate:.1f} {unit}/s"
    return f"{1.0 / rate:.1f} s for one"


class _Forgiving:
    """Standard error, where what cannot be written is dropped: the terminal or a pipe's reader may be gone."""

    def __init__(self) -> None:
        self._stream: Any = sys.stderr

    def write(self, text: str) -> int:
        with suppress(OSError, ValueError, AttributeError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError, AttributeError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        if name == "rich_proxied_file":  # by which a console would write past this one
            raise AttributeError(name)
        return getattr(self._stream, name)
