"""The words of a command: placeholders, the program that they name, the files among them, and seeds."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from consistency.referee.errors import InputError
from consistency.referee.parsing import is_file, require_name
from consistency.referee.readers.pipeline.program_runs import filled
from consistency.referee.system.progress import say

LARGEST_SEED = 2**31 - 1  # fits an int and std::stoi
HALF = 2**16
ROUNDS = 4  # of the Feistel network
SCRIPTS = (".py", ".jl", ".m", ".r", ".sh", ".js", ".rb", ".lua", ".pl")  # files that an interpreter runs
OF_A_RUN = ("{run}", "{seed}", "{out}", "{worker}", "{input}", "{name}")


def seed_of(seed: int, run: int) -> int:
    """Seed of a run, from 1 to 2^31 - 1, different for every run of a study.

    A Feistel network with a keyed hash permutes the numbers of 32 bits, and is repeated until its result is in the
    range (cycle walking, Black & Rogaway 2002).
    """
    value = run + 1
    while True:
        left, right = divmod(value, HALF)
        for number in range(ROUNDS):
            key = hashlib.blake2b(f"{seed} {number} {right}".encode(), digest_size=2).digest()
            left, right = right, left ^ int.from_bytes(key, "big")
        value = left * HALF + right
        if 1 <= value <= LARGEST_SEED:
            return value


@dataclass(frozen=True)
class Program:
    """A command with placeholders, called from ``here``; ``cwd`` None is the folder of each run."""

    words: tuple[str, ...]
    here: Path
    cwd: Path | None = None
    name: str = ""  # what a verdict calls it

    @property
    def uses_run(self) -> bool:
        """Whether a word differs from run to run in what the program computes."""
        return any(part in word for word in self.words for part in ("{seed}", "{run}", "{input}", "{name}"))

    def files(self) -> dict[str, str]:
        """Digest of every file that a word names."""
        found = {}
        for word in self.words:
            for path in self._paths(word):
                if path.is_file():
                    found[str(path)] = _digest(path)
        return found

    def warn_of_relative_paths(self) -> None:
        """Say which words name a file that the program will not see from its folder."""
        for word in self.words[1:] if self.cwd is None else ():
            name = word.rpartition("=")[2]
            if not Path(name).is_absolute() and (Path(name).suffix or os.sep in name) and _is_there(self.here / name):
                say(f"consistency: {name} is not seen from the run's folder; write {{here}}/{name}")

    def _paths(self, word: str) -> Iterator[Path]:
        """Files that a word may name, by itself or behind an equals sign."""
        for name in {word, word.rpartition("=")[2]}:
            path = Path(filled(name, {"here": str(self.here)}))
            yield (self.cwd or self.here) / path


def program_of(words: Sequence[str], here: Path, cwd: Path | None = None, hint: str = "") -> Program:
    """The command with its first word found, from where the user stands or on the PATH.

    Parameters
    ----------
    hint : advice for a command that does not exist

    Raises
    ------
    InputError
        There is no such program, or it cannot be executed.
    """
    if isinstance(words, str) or not words or not all(isinstance(word, str) for word in words):
        raise InputError("the command must be a list of words, the program first: -- ./build/ekf {seed}")
    if any("\0" in word for word in words):
        raise InputError("the command: a word holds a character NUL, which no program can be given")
    first = filled(words[0], {"here": str(here)})
    if not any(part in first for part in OF_A_RUN):
        first = _found(first, here, hint)
    if cwd is not None:
        cwd = here / cwd
        if not cwd.is_dir():
            raise InputError(f"--cwd {cwd}: no such folder")
    return Program((first, *words[1:]), here, cwd, _name(words, here, cwd))


def _name(words: Sequence[str], here: Path, cwd: Path | None) -> str:
    """What the user calls a program: its file, or the script that an interpreter on the PATH runs."""
    name = words[0]
    if os.sep not in name:
        for word in words[1:]:
            file = (cwd or here) / filled(word, {"here": str(here)})
            if file.suffix.lower() in SCRIPTS and is_file(file):
                name = word
                break
    name = name.replace("{here}/", "")
    if Path(name).is_absolute():
        name = Path(name).name
    return require_name(name, "the command")


def _found(first: str, here: Path, hint: str) -> str:
    """Absolute path of the program that the first word names."""
    if os.sep not in first:
        found = shutil.which(first)
        if found is not None:
            return os.path.abspath(found)
        beside = f"; write ./{first} for the file that is here" if _is_there(here / first) else hint
        raise InputError(f"{first}: no such command{beside}")
    path = here / first
    if not _is_there(path):
        raise InputError(f"{first}: no such program{hint}")
    if path.is_dir():
        raise InputError(f"{first}: is a folder, not a program")
    if not os.access(path, os.X_OK):
        raise InputError(
            f"{first}: cannot be executed; make it so with chmod +x, or put its interpreter before it{hint}"
        )
    return os.path.abspath(path)


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a word that no file can be called
        return False


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        for piece in iter(lambda: file.read(2**20), b""):
            digest.update(piece)
    return digest.hexdigest()


def inputs_of(pattern: str, here: Path) -> list[Path]:
    """Recorded files or folders of ``--each``, absolute, by name.

    Raises
    ------
    InputError
        There are none.
    """
    base, relative = here, pattern
    if Path(pattern).is_absolute():
        base = Path(Path(pattern).anchor)
        relative = str(Path(pattern).relative_to(base))
    try:
        found = sorted(path for path in base.glob(relative) if not path.name.startswith("."))
    except (ValueError, NotImplementedError, re.error) as error:
        raise InputError(f"--each {pattern}: is not a pattern of files ({error})") from None
    if not found:
        raise InputError(f"--each {pattern}: no file or folder is called so; quote the pattern: --each 'logs/*'")
    return [Path(os.path.abspath(path)) for path in found]
