"""Is a command gone within a second of a signal, with no process left, and does --resume give the same tables?

    python benchmarks/signals.py                  # 60 SIGKILL, 60 of the others: half an hour on two idle cores
    python benchmarks/signals.py --signals 12     # of each kind

Signals come to ``run --jobs 1`` and ``2`` at moments uniform between the start and the length of the command. Half of
the other commands begin with an empty cache of kernels, and one in three has a filter of one's own, in processes, from
a script without a guard. Exit status 1 where a status is wrong, a process is left, tables differ, or a command was
there after a second.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
from script_options import options_of

LIMIT = 1.0  # s
STOPS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
KEYS = ["filter", "run", "step"]
WORLD = "linear-gaussian"
SCRIPT = """
import sys
import numpy as np
import consistency.commands as cli
import consistency.bench.filters as filters
from consistency.__main__ import main
from consistency.bench.types import Gaussian

class Still:
    name = "kf"
    def init(self, problem):
        return problem.start
    def predict(self, state, control):
        return state
    def update(self, state, observation):
        return state, None
    def pose(self, state):
        return Gaussian(state, np.eye(3))

from consistency.bench.runs import montecarlo
montecarlo.get_filter = lambda _: Still()
main()
"""


def as_in_a_terminal() -> None:
    for number in STOPS:
        signal.signal(number, signal.SIG_DFL)


def processes_of(session: int) -> list[str]:
    """Command lines of a session that still live (Linux)."""
    left = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, leader, *_ = stat.read_text(errors="replace").rpartition(")")[2].split()
            words = (stat.parent / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if int(leader) == session and state not in "ZX":
            left.append(words[:120])
    return left


def words_of(is_own: bool, jobs: int, runs: int) -> list[str]:
    options = ["run", WORLD, "--filter", "kf", "--runs", str(runs), "--jobs", str(jobs), "--out", "out"]
    return [sys.executable, *(["script.py"] if is_own else ["-m", "consistency"]), *options]


def stopped(words: list[str], at: Path, number: int, moment: float, is_cold: bool) -> tuple[float, bool, list[str]]:
    """Begin the command and send the signal; seconds until all is gone, whether it was done before, faults."""
    environment = dict(os.environ)
    if is_cold:
        environment["NUMBA_CACHE_DIR"] = str(at / "cache")
    with (at / "said").open("w+") as said:
        process = subprocess.Popen(
            words,
            cwd=at,
            env=environment,
            stdout=said,
            stderr=said,
            start_new_session=True,
            preexec_fn=as_in_a_terminal,
        )
        time.sleep(moment)
        was_done = process.poll() is not None
        begun = time.monotonic()
        process.send_signal(number)
        process.wait()
        while (left := processes_of(process.pid)) and time.monotonic() - begun < 10.0:
            time.sleep(0.01)
        seconds = time.monotonic() - begun
        said.seek(0)
        text = said.read()
    is_script = words[1] == "script.py"  # which Ctrl-C may end before the command line takes it
    expected = {-number}
    if number == signal.SIGINT:
        expected = {130, -number} if is_script else {130}
    faults = [f"left: {line}" for line in left]
    if not was_done and process.returncode not in expected:
        faults.append(f"status {process.returncode}")
    if "Fatal" in text or "leaked" in text or ("Traceback" in text and not is_script):
        faults.append("said: " + text[-300:])
    return seconds, was_done, faults


def resumed(words: list[str], at: Path, whole: Path) -> list[str]:
    """Continue as a user does; what differs from one go."""
    is_begun = (at / "out").exists() or (at / ".out.unfinished" / "runs.sqlite").exists()
    resume = ["--resume"] if is_begun else []
    done = subprocess.run([*words, *resume], cwd=at, capture_output=True, text=True, check=False)
    if done.returncode:
        return [f"does not resume: {done.stderr[-400:]}"]
    faults = [f"left: {path.name}" for path in at.glob(".out*")]
    for path in sorted(whole.glob("*.parquet")):
        own, other = pd.read_parquet(at / "out" / path.name), pd.read_parquet(path)
        if not own.equals(other):
            faults.append(f"{path.name} differs")
    return faults


def prepared(at: Path) -> Path:
    at.mkdir()
    (at / "script.py").write_text(SCRIPT)
    return at


def one_go(words: list[str], at: Path) -> tuple[Path, float]:
    """The results of a command that nobody stops, and the seconds that it takes."""
    begun = time.monotonic()
    subprocess.run(words, cwd=prepared(at), check=True, capture_output=True)
    return at / "out", time.monotonic() - begun


def main() -> int:
    arguments = options_of(
        __doc__.split("\n")[0], signals=(60, "of each kind"), runs=(100, "of a command"), seed=(int, None)
    )
    rng = np.random.default_rng(arguments.seed)
    counts, seconds = Counter[str](), list[float]()
    with tempfile.TemporaryDirectory() as name:
        top = Path(name)
        wholes = {own: one_go(words_of(own, 2, arguments.runs), top / f"whole-{own}") for own in (False, True)}
        for count in range(2 * arguments.signals):
            which, is_own, is_cold = case(count)
            number = signal.SIGKILL if which == 0 else STOPS[count // 2 % len(STOPS)]
            whole, length = wholes[is_own]
            words = words_of(is_own, 1 + count // 4 % 2, arguments.runs)
            at, moment = prepared(top / str(count)), rng.uniform(0.0, length)
            took, was_done, faults = stopped(words, at, number, moment, is_cold)
            if not was_done:
                seconds.append(took)
                counts[signal.Signals(number).name] += 1
                counts["cold"] += is_cold
                counts["own filter"] += is_own
                counts["later than 1 s"] += took > LIMIT
                faults += resumed(words, at, whole)
            counts["was done before"] += was_done
            counts["faults"] += len(faults)
            print(f"{count + 1}: {' '.join(words[-4:-2])}, {signal.Signals(number).name} at {moment:.1f} s: "
                  f"gone after {took:.2f} s {'; '.join(faults)}", flush=True)  # fmt: skip
            shutil.rmtree(at)
    quantiles = np.quantile(seconds, [0.5, 0.9, 1.0]).round(2)
    print(f"{dict(counts)}; gone after {quantiles} s (50, 90, 100 %)")
    return int(counts["faults"] > 0 or counts["later than 1 s"] > 0)


def case(count: int) -> tuple[int, bool, bool]:
    """Which kind of signal, whether the filter is one's own, and whether the cache is empty."""
    is_own = count % 6 >= 4
    return count % 2, is_own, not is_own and count // 2 % 2 == 0


if __name__ == "__main__":
    sys.exit(main())
