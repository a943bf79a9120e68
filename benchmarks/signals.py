"""Is a command gone within two seconds of a signal, with nothing left behind, and can it go on to the same bytes?

    python benchmarks/signals.py                  # 300 signals: one and a half hours
    python benchmarks/signals.py --signals 24     # quicker

Signals (SIGINT, SIGTERM, SIGHUP) come at moments uniform between 0.1 s and the length of the command; half of the
commands begin with an empty cache of kernels. Prints counts as they come. Exit status 1 where a process crashed, left
another process, a lock or a file, where tables differ from those of one go, or fewer than 99 % were gone in 2 s.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from script_options import options_of

from consistency.referee.system.stopping import LEAVE, STOPS

LIMIT = 2.0  # s
LONGEST = 20.0  # s after which a signal comes at the latest
SHARE = 0.99
CLI = (sys.executable, "-m", "consistency")
WORLD = ("run", "linear-gaussian", "--filter", "kf", "--runs", "{runs}", "--out", "out")
PROGRAM = """
import sys
import consistency as cs
cs.run_trials(cs.load_scenario("linear-gaussian"), ["kf"], {runs}, jobs=1, out="out", resume="--resume" in sys.argv)
"""
SWEEP = """
summary = "Densities of a linear world"
base = "linear-gaussian"
filters = ["kf"]
[rule]
false_alarm = 1e-6
detect = 1.02
max_runs = {cell_runs}
[grid]
density = [0.5, 1.0, 1.5]
"""


@dataclass(frozen=True)
class Command:
    """What is sent a signal; ``resume`` are the words with which it goes on, None where it cannot."""

    words: tuple[str, ...]
    resume: tuple[str, ...] | None = None
    tables: str = "*.parquet"


COMMANDS = {
    "run --jobs 1": Command((*CLI, *WORLD, "--jobs", "1"), ("--resume",)),
    "run --jobs 2": Command((*CLI, *WORLD, "--jobs", "2"), ("--resume",)),
    "run_trials": Command((sys.executable, "program.py"), ("--resume",)),
    "tune": Command((*CLI, "tune", "linear-gaussian", "--filter", "kf", "--runs", "{runs}", "--out", "out")),
    "sweep": Command((*CLI, "sweep", "grid.toml", "--out", "out"), (), "**/runs.csv"),
    "analyse": Command((*CLI, "analyse", "large.csv", "--innovations", "optimal")),
}


@dataclass
class Ended:
    seconds: float = 0.0
    faults: list[str] = field(default_factory=list)
    was_done: bool = False


def as_in_a_terminal() -> None:
    for number in STOPS:
        signal.signal(number, signal.SIG_DFL)


def session(leader: int) -> list[str]:
    left = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            rest = stat.read_text(errors="replace").rpartition(")")[2].split()
        except OSError:
            continue
        if int(rest[3]) == leader and rest[0] != "Z":
            left.append(stat.parent.name)
    return left


def sent(command: Command, at: Path, number: int, moment: float, cold: bool, runs: int) -> Ended:
    """Begin the command, send the signal, and see what is left."""
    environment, cache = dict(os.environ), at / "cache"
    if cold:
        environment["NUMBA_CACHE_DIR"] = str(cache)
    words = [word.format(runs=runs) for word in command.words]
    with (at / "said").open("w+") as said:
        process = subprocess.Popen(
            words, cwd=at, env=environment, stdout=said, stderr=subprocess.STDOUT, start_new_session=True,
            preexec_fn=as_in_a_terminal,
        )  # fmt: skip
        time.sleep(moment)
        ended = Ended(was_done=process.poll() is not None)
        process.send_signal(number)
        begun = time.monotonic()
        while process.poll() is None or (session(process.pid) and time.monotonic() - begun < 60.0):
            time.sleep(0.01)
        ended.seconds = time.monotonic() - begun
        said.seek(0)
        text = said.read()
    is_ours = command.words[:3] == CLI
    status = process.returncode if process.returncode >= 0 else 128 - process.returncode
    own = {128 + number} if is_ours else {128 + number, 1}  # Python's status of an exception that nobody catches
    if not ended.was_done and status not in own:
        ended.faults.append(f"status {process.returncode} after {signal.Signals(number).name}")
    if "Fatal" in text or "egmentation" in text or (is_ours and moment > LEAVE and "Traceback" in text):
        ended.faults.append("crash: " + text[-400:])
    if session(process.pid):
        ended.faults.append("processes left")
    known = {"out", ".out.unfinished", "program.py", "grid.toml", "large.csv", "said", "cache"}
    ended.faults += [f"left: {path.name}" for path in at.iterdir() if path.name not in known]
    ended.faults += [f"left: {path}" for path in (at / "out").rglob(".*") if not path.name.endswith(".unfinished")]
    return ended


def resumed(command: Command, at: Path, whole: Path, runs: int) -> list[str]:
    """Go on, as a user does; what differs from one go."""
    there = (at / "out").exists() or (at / ".out.unfinished" / "runs.sqlite").exists()
    words = [word.format(runs=runs) for word in command.words] + list(command.resume or ()) * there
    done = subprocess.run(words, cwd=at, capture_output=True, text=True, check=False)
    if done.returncode:
        return [f"does not go on: {done.stderr[-400:]}"]
    left = [f"left: {path.name}" for path in at.rglob(".*.unfinished")]
    paths = list(whole.glob(command.tables))
    pairs = [(path, at / "out" / path.relative_to(whole)) for path in paths]
    return left + [f"{path.name} differs" for path, own in pairs if own.read_bytes() != path.read_bytes()]


def prepared(at: Path, arguments: argparse.Namespace) -> None:
    at.mkdir()
    (at / "program.py").write_text(PROGRAM.format(runs=arguments.runs))
    (at / "grid.toml").write_text(SWEEP.format(cell_runs=arguments.runs // 3))


def large_file(path: Path, rows: int) -> None:
    """NIS of many runs of 500 steps, as one long CSV."""
    nis = [f"{x:.9f}" for x in np.random.default_rng(0).chisquare(3, 1000)]
    with path.open("w") as file:
        file.write("run,step,nis,nis_dof\n")
        for row in range(rows):
            file.write(f"{row // 500},{row % 500 + 1},{nis[row % 1000]},3\n")


def main() -> int:
    arguments = options_of(
        __doc__.split("\n")[0],
        signals=(300, None),
        resumes=(60, "at most; 0 begins at once"),
        runs=(300, "of a command, so that it takes 20 s"),
        rows=(3_000_000, "of the large file"),
        seed=(int, None),
    )
    rng, counts, slow, seconds = np.random.default_rng(arguments.seed), Counter[str](), Counter[str](), list[float]()
    with tempfile.TemporaryDirectory() as name:
        top, whole = Path(name), dict[str, Path]()
        large_file(top / "large.csv", arguments.rows)
        for which, command in COMMANDS.items():
            if command.resume is not None and arguments.resumes:
                prepared(top / which, arguments)
                words = [word.format(runs=arguments.runs) for word in command.words]
                subprocess.run(words, cwd=top / which, check=True, capture_output=True)
                whole[which] = top / which / "out"
        for count in range(arguments.signals):
            which = list(COMMANDS)[count % len(COMMANDS)]
            command, at = COMMANDS[which], top / "work"
            number = int(rng.choice(STOPS)) if which != "run_trials" or rng.random() < 0.2 else int(signal.SIGINT)
            moment, cold = rng.uniform(0.1, LONGEST), bool(rng.integers(2))
            prepared(at, arguments)
            os.symlink(top / "large.csv", at / "large.csv")
            ended = sent(command, at, number, moment, cold, arguments.runs)
            counts["signals"] += not ended.was_done
            counts["was done before"] += ended.was_done
            if not ended.was_done:
                seconds.append(ended.seconds)
                slow[which] += ended.seconds > LIMIT
            if command.resume is not None and not ended.was_done and counts["resumed"] < arguments.resumes:
                counts["resumed"] += 1
                ended.faults += resumed(command, at, whole[which], arguments.runs)
            counts["faults"] += len(ended.faults)
            kind = "cold" if cold else "warm"
            what = f"{count + 1}: {which} ({kind}), {signal.Signals(number).name} at {moment:.1f} s"
            said = "was done before" if ended.was_done else f"gone after {ended.seconds:.2f} s"
            print(f"{what}: {said} {'; '.join(ended.faults)}", flush=True)
            shutil.rmtree(at)
            if (count + 1) % 10 == 0:
                print(summary(counts, slow, seconds), flush=True)
    print(summary(counts, slow, seconds))
    return int(counts["faults"] > 0 or float(np.mean(np.array(seconds) <= LIMIT)) < SHARE)


def summary(counts: Counter[str], slow: Counter[str], seconds: list[float]) -> str:
    late = ", ".join(f"{which} {number}" for which, number in slow.items() if number) or "none"
    quantiles = np.quantile(seconds or [0.0], [0.5, 0.9, 0.99, 1.0])
    shown = ", ".join(f"{key} {number}" for key, number in counts.items())
    return f"== {shown}; gone after {quantiles.round(2)} s (50, 90, 99, 100 %); later than 2 s: {late}"


if __name__ == "__main__":
    sys.exit(main())
