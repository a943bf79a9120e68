"""Finished runs on disk as they come, so that they are there after whatever ends the process."""

from __future__ import annotations

import json
import os
import shutil
import struct
import threading
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from consistency.bench.store.parquet import Columns
from consistency.referee.errors import InputError
from consistency.referee.system.atomic import make_durable
from consistency.referee.system.folders import require_free, writing
from consistency.referee.types import Array

MARK = b"run:"
HEAD = struct.Struct("<4sIQ")  # mark, CRC-32 and length of what follows
COUNT = struct.Struct("<I")  # length of the JSON that a record begins with
SYNC_EVERY = 5.0  # s: a power cut costs at most the runs of so long, a killed process none


class Journal:
    """Finished runs in one file that only grows.

    A record is a head, JSON with the number of the run and what its parts are, and the parts: columns of tables, their
    numbers as they are in memory, for encoding would take longer than writing. It is written at once when its run is
    finished, and synchronised to disk within ``SYNC_EVERY`` seconds. Records come in any order of their runs and are
    read in that of the numbers. What is not whole, or does not agree with its checksum, is dropped when the file is
    opened; ``dropped`` says how many bytes.

    Attributes
    ----------
    study : what the runs are of, as it was last written by :meth:`begin`
    notes : what was noted of each run that left a note

    Raises
    ------
    OSError
        The file cannot be read or written; what was in it before stays whole.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.study: dict[str, Any] = {}
        self.notes: dict[int, dict[str, Any]] = {}
        self._offsets: dict[int, int] = {}
        self._end = 0  # of the last record
        self._buffer = bytearray()  # one for all records: a new one each time costs more than filling it
        path.touch()
        self._file = path.open("r+b", buffering=0)
        self.dropped = self._read_all()
        self._unsynced = True
        self._fault: OSError | None = None
        self._closed = threading.Event()
        self._syncing: threading.Thread | None = None

    @property
    def runs(self) -> set[int]:
        return set(self._offsets)

    def begin(self, study: Mapping[str, Any]) -> None:
        """Write down what the runs are of."""
        self._write({"study": dict(study)}, ())
        self.study = dict(study)

    def clear(self) -> None:
        self._file.truncate(0)
        self._end, self.study, self._unsynced = 0, {}, True
        self.notes.clear()
        self._offsets.clear()

    def append(self, run: int, parts: Mapping[str, Columns], notes: Mapping[str, Any] | None = None) -> None:
        """Keep a finished run: its columns by the names of the parts, and ``notes``, which JSON can hold."""
        if self._fault is not None:
            raise self._fault
        about: dict[str, Any] = {"run": run, "parts": []} | ({"notes": dict(notes)} if notes else {})
        for name, columns in parts.items():
            kinds = " ".join([f"{column} {values.dtype.str}" for column, values in columns.items()])
            size = sum(values.nbytes for values in columns.values())
            about["parts"].append((name, len(next(iter(columns.values()))), kinds, size))
        offset = self._write(about, [values for columns in parts.values() for values in columns.values()])
        if notes:
            self.notes[run] = dict(notes)
        self._offsets[run] = offset
        if self._syncing is None:
            self._syncing = threading.Thread(target=self._keep_synced, daemon=True)
            self._syncing.start()

    def pieces(self, name: str) -> Iterator[tuple[int, Columns]]:
        """Runs and their columns of one part, in order of the runs; those without the part are left out."""
        for run in sorted(self._offsets):
            at = self._offsets[run] + HEAD.size
            (length,) = COUNT.unpack(self._read(COUNT.size, at))
            about, at = json.loads(self._read(length, at + COUNT.size)), at + COUNT.size + length
            for part, rows, kinds, size in about["parts"]:
                if part == name:
                    yield run, _decoded(self._read(size, at), kinds, rows)
                at += size

    def close(self) -> None:
        self._closed.set()
        if self._syncing is not None:
            self._syncing.join()
        self._sync()
        self._file.close()

    def _write(self, about: dict[str, Any], numbers: Sequence[Array]) -> int:
        """Write a record and give its offset; one that cannot be written whole leaves nothing."""
        text = json.dumps(about).encode()
        start = HEAD.size + COUNT.size + len(text)
        size, offset = start + sum(values.nbytes for values in numbers), self._end
        if size > len(self._buffer):
            self._buffer = bytearray(size)
        record, at = memoryview(self._buffer)[:size], start
        for values in numbers:
            np.frombuffer(record, values.dtype, len(values), at)[:] = values
            at += values.nbytes
        COUNT.pack_into(record, HEAD.size, len(text))
        record[start - len(text) : start] = text
        HEAD.pack_into(record, 0, MARK, zlib.crc32(record[HEAD.size :]), size - HEAD.size)
        try:
            self._file.seek(offset)
            while record:
                record = record[self._file.write(record) :]
        except BaseException:
            with suppress(OSError):
                self._file.truncate(offset)
            raise
        self._end, self._unsynced = offset + size, True
        return offset

    def _read(self, size: int, at: int) -> bytes:
        self._file.seek(at)
        content = self._file.read(size)
        if len(content) < size:
            raise InputError(f"{self.path}: cut short by another program; the same command with --resume does the rest")
        return content

    def _read_all(self) -> int:
        """Find the records; bytes that are none are counted, and cut off where they are the last."""
        size, at, lost = os.fstat(self._file.fileno()).st_size, 0, 0
        while at + HEAD.size <= size:
            mark, checksum, length = HEAD.unpack(self._read(HEAD.size, at))
            if mark != MARK or at + HEAD.size + length > size:
                break
            body = self._read(length, at + HEAD.size)
            if zlib.crc32(body) == checksum:
                self._enter(body, at)
            else:
                lost += HEAD.size + length
            at += HEAD.size + length
        self._end = at
        self._file.truncate(at)
        return lost + size - at

    def _enter(self, body: bytes, offset: int) -> None:
        (length,) = COUNT.unpack_from(body)
        about = json.loads(body[COUNT.size : COUNT.size + length])
        self.study = about.get("study", self.study)
        if "run" in about:
            self._offsets[about["run"]] = offset
            if "notes" in about:
                self.notes[about["run"]] = about["notes"]

    def _keep_synced(self) -> None:
        while not self._closed.wait(SYNC_EVERY):
            self._sync()

    def _sync(self) -> None:
        """Bring to disk what is written; where that fails, the next run that is finished says so."""
        if self._unsynced:
            self._unsynced = False
            try:
                os.fsync(self._file.fileno())
            except OSError as error:
                self._fault = error


def _decoded(piece: bytes, kinds: str, rows: int) -> Columns:
    columns, at, words = {}, 0, kinds.split(" ")
    for name, kind in zip(words[::2], words[1::2], strict=True):
        columns[name] = np.frombuffer(piece, kind, rows, at)
        at += columns[name].nbytes
    return columns


# --- beside an output folder -----------------------------------------------------------------------


class Busy(InputError):
    """Another process is at work there."""


class Unfinished:
    """The journal of unfinished work on an output folder ``OUT``, in a folder ``.OUT.unfinished`` beside it.

    One process at a time has it. As a context it is gone at the end if :attr:`is_over` was set, or if no run is
    finished; else it stays for a resume.

    Parameters
    ----------
    resume : go on with what is there
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
                    (self.path / "journal").unlink(missing_ok=True)
                self.journal = Journal(self.path / "journal")
                make_durable(self.path)
                make_durable(self.path.parent)
            except BaseException:
                self._lock.release()
                raise
        if self.journal.runs and not (resume or overwrite):
            self._leave()
            raise InputError(
                f"--out {out}: unfinished work is there, with {len(self.journal.runs)} finished runs; add --resume to "
                "the same command to go on, or --overwrite to drop it"
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


def unfinished_of(out: Path) -> Path:
    return out.absolute().parent / f".{out.absolute().name}.unfinished"
