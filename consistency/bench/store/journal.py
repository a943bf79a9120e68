"""Finished runs on disk as they come, so that they are there whatever ends the process."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sqlite3
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from consistency.bench.store.parquet import Columns
from consistency.referee.errors import InputError
from consistency.referee.system import make_durable, require_free, unfinished_of, writing
from consistency.referee.types import Array

CHECKPOINT_EVERY = 5.0  # s: a power cut costs at most the runs of so long, a killed process none
DATABASE, EARLIER = "runs.sqlite", "journal"  # the second is of versions before SQLite
IN_MEMORY = Path(":memory:")
SCHEMA = """
CREATE TABLE IF NOT EXISTS study (content TEXT);
CREATE TABLE IF NOT EXISTS finished (run INTEGER PRIMARY KEY, notes TEXT);
CREATE TABLE IF NOT EXISTS part (
    run INTEGER, name TEXT, columns TEXT, numbers BLOB, checksum INTEGER, PRIMARY KEY (run, name)
);
"""


class Journal:
    """Finished runs in an SQLite database, in a file or ``IN_MEMORY``.

    A finished run is a row of ``finished`` and, for each of its tables, a row of ``part``: the names and types of the
    columns, and their numbers as they are in memory. Both are written in one transaction, so that a run is there
    whole or not at all.

    Attributes
    ----------
    study : what the runs are of, as it was last written by :meth:`begin`
    notes : what was noted of each run that left a note

    Raises
    ------
    InputError
        The database is damaged, or another process has it open.
    OSError
        The database cannot be written; what was in it before stays whole.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._checkpoint = time.monotonic()
        with self._faults():
            self._database = sqlite3.connect(path, timeout=0, isolation_level=None, check_same_thread=False)
            try:
                # exclusive before WAL: then SQLite needs no shared memory, which network disks lack
                self._database.execute("PRAGMA locking_mode = EXCLUSIVE")
                self._database.execute("PRAGMA journal_mode = WAL")
                self._database.execute("PRAGMA synchronous = NORMAL")
                self._database.execute("PRAGMA wal_autocheckpoint = 0")  # each waits for the disk; see CHECKPOINT_EVERY
                self._database.executescript(SCHEMA)
                rows = self._database.execute("SELECT content FROM study").fetchall()
                finished = self._database.execute("SELECT run, notes FROM finished").fetchall()
                self.study: dict[str, Any] = json.loads(rows[0][0]) if rows else {}
            except BaseException:
                self._database.close()
                raise
        self._runs = {run for run, _ in finished}
        self.notes: dict[int, dict[str, Any]] = {run: json.loads(notes) for run, notes in finished if notes}

    @property
    def is_on_disk(self) -> bool:
        return self.path != IN_MEMORY

    @property
    def runs(self) -> set[int]:
        return set(self._runs)

    def begin(self, study: Mapping[str, Any]) -> None:
        """Write down what the runs are of."""
        with self._transaction() as database:
            database.execute("DELETE FROM study")
            database.execute("INSERT INTO study VALUES (?)", (json.dumps(dict(study)),))
        self.study = dict(study)

    def clear(self) -> None:
        """Drop all runs and the study."""
        with self._transaction() as database:
            for table in ("study", "finished", "part"):
                database.execute(f"DELETE FROM {table}")
        self.study = {}
        self.notes.clear()
        self._runs.clear()

    def append(self, run: int, parts: Mapping[str, Columns], notes: Mapping[str, Any] | None = None) -> None:
        """Keep a finished run: its columns by the names of the parts, and ``notes``, which JSON can hold."""
        with self._transaction() as database:
            for name, columns in parts.items():
                column_types = json.dumps({column: values.dtype.str for column, values in columns.items()})
                numbers = b"".join([values.tobytes() for values in columns.values()])
                part_row = (run, name, column_types, numbers, _checksum(run, name, column_types, numbers))
                database.execute("INSERT OR REPLACE INTO part VALUES (?, ?, ?, ?, ?)", part_row)
            noted_json = json.dumps(dict(notes)) if notes else None
            database.execute("INSERT OR REPLACE INTO finished VALUES (?, ?)", (run, noted_json))
        self._runs.add(run)
        if notes:
            self.notes[run] = dict(notes)
        if time.monotonic() - self._checkpoint > CHECKPOINT_EVERY:
            self._checkpoint = time.monotonic()
            with self._faults():
                self._database.execute("PRAGMA wal_checkpoint")

    def pieces(self, name: str) -> Iterator[tuple[int, Columns]]:
        """Runs and their columns of one part, in order of the runs; those without the part are left out."""
        for run in sorted(self._runs):
            with self._faults():
                query = "SELECT columns, numbers, checksum FROM part WHERE run = ? AND name = ?"
                row = self._database.execute(query, (run, name)).fetchone()
            if row is None:
                continue
            column_types, numbers, checksum = row
            if _checksum(run, name, column_types, numbers) != checksum:
                raise self._damaged(f"run {run}")
            kinds, columns, offset = json.loads(column_types), dict[str, Array](), 0
            rows = len(numbers) // sum(np.dtype(kind).itemsize for kind in kinds.values())
            for column, kind in kinds.items():
                columns[column] = np.frombuffer(numbers, kind, rows, offset)
                offset += columns[column].nbytes
            yield run, columns

    def close(self) -> None:
        with self._faults():
            self._database.close()

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._faults():
            self._database.execute("BEGIN")
            try:
                yield self._database
                self._database.execute("COMMIT")
            except BaseException:
                with suppress(sqlite3.Error):
                    self._database.execute("ROLLBACK")
                raise

    @contextmanager
    def _faults(self) -> Iterator[None]:
        """Raise what SQLite says as the errors of this class."""
        try:
            yield
        except sqlite3.OperationalError as error:
            if "locked" in str(error):
                raise InputError(f"{self.path}: another process is at work on it; wait for it") from None
            if "full" in str(error):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path)) from error
            raise OSError(errno.EIO, str(error), str(self.path)) from error
        except (sqlite3.Error, ValueError) as error:
            raise self._damaged(str(error)) from None

    def _damaged(self, what: str) -> InputError:
        return InputError(f"{self.path}: damaged ({what}); the same command with --overwrite drops it")


def _checksum(run: int, name: str, column_types: str, numbers: bytes) -> int:
    """CRC-32 of a part with its key, because a damaged index may lead to the row of another run."""
    return zlib.crc32(numbers, zlib.crc32(f"{run} {name} {column_types}".encode()))


# --- beside an output folder -----------------------------------------------------------------------


class Busy(InputError):
    """Another process is at work there."""


class Unfinished:
    """The journal of unfinished work on an output folder ``OUT``, in a folder ``.OUT.unfinished`` beside it.

    One process at a time has it. As a context it is gone at the end if :attr:`is_over` was set, or if no run is
    finished; else it stays for a resume.

    Parameters
    ----------
    resume : continue with what is there
    overwrite : drop what is there
    kind : of the output folder

    Raises
    ------
    Busy
        Another process works on ``out``.
    InputError
        Unfinished work is there, and neither ``resume`` nor ``overwrite`` is asked
        for; the place cannot be written.
    """

    def __init__(self, out: Path, resume: bool = False, overwrite: bool = False, kind: str = "results") -> None:
        self.out, self.path, self.is_over = out, unfinished_of(out), False
        self._made = [folder for folder in out.absolute().parents if not folder.exists()]
        with writing(out):
            if not self.path.exists():
                require_free(out, overwrite or resume, kind)
            self._lock = self._locked()
            try:
                replaced = self.path / "replaced"
                if replaced.exists() and not out.exists():  # the process ended while the results were being replaced
                    os.replace(replaced, out)
                if overwrite and not resume:
                    for name in (EARLIER, DATABASE, f"{DATABASE}-wal", f"{DATABASE}-shm"):
                        (self.path / name).unlink(missing_ok=True)
                if (self.path / EARLIER).exists():
                    raise InputError(
                        f"--out {out}: unfinished work of an earlier version is there; finish it with that version, or "
                        "add --overwrite to drop it"
                    )
                self.is_new = not (self.path / DATABASE).exists()
                self.journal = Journal(self.path / DATABASE)
                make_durable(self.path)
                make_durable(self.path.parent)
            except BaseException:
                self._lock.release()
                raise
        if self.journal.runs and not (resume or overwrite):
            self._leave()
            raise InputError(
                f"--out {out}: unfinished work is there, with {len(self.journal.runs)} finished runs; add --resume to "
                "the same command to continue, or --overwrite to drop it"
            )

    def __enter__(self) -> Unfinished:
        return self

    def __exit__(self, *_: object) -> None:
        if self.journal.runs and not self.is_over:
            self._leave()
            return
        self.journal.close()
        shutil.rmtree(self.path, ignore_errors=True)
        self._lock.release()
        for folder in self._made:
            with suppress(OSError):  # the results are there, or somebody else's files
                folder.rmdir()

    def _leave(self) -> None:
        self.journal.close()
        self._lock.release()

    def _locked(self) -> FileLock:
        while True:
            self.path.mkdir(parents=True, exist_ok=True)
            lock = FileLock(self.path / "lock", timeout=0)
            try:
                lock.acquire()
            except FileNotFoundError:  # the other process has just ended
                continue
            except Timeout:
                raise Busy(
                    f"--out {self.out}: another process is at work on it; wait for it, or choose another folder"
                ) from None
            if self.path.exists():
                return lock
            lock.release()
