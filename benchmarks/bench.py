"""How fast is it? Ours against filterpy, Stone Soup, bare BLAS and its own targets, side by side in one run.

``bench.py [--out FILE] [--full] [--only GROUP ...]`` prints a table and writes it as JSON. The ratios are the result:
seconds are those of one machine, medians of interleaved repetitions on one BLAS thread. benchmarks/README.md
says how to read it.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import bench_vision as front_end
import bench_whole as whole
import numpy as np
from bench_models import WARM, Peer
from bench_peers import FilterpyEkf, FilterpyUkf, stone_soup
from bench_trials import LANDMARKS, SEEN, Case, Work, growing, grown, interleaved, require_equal, steady
from scipy.linalg import blas, lapack
from script_options import options_of

import consistency as cs
from consistency.bench.filters.run_filter import run_filter
from consistency.bench.types import Estimates
from consistency.referee.errors import InputError

NAMES = {"ekf": "ekf-uvd", "ukf": "ukf-uvd"}
AGAINST_FILTERPY = {"ekf": 25.0, "ukf": 120.0}


@dataclass(frozen=True)
class Row:
    """One line of the table; no target: for information. No value: the note says why."""

    group: str
    what: str
    value: float | None
    unit: str
    target: float | None = None
    at_most: bool = False
    note: str = ""

    @property
    def verdict(self) -> str:
        if self.target is None:
            return ""
        if self.value is None or not np.isfinite(self.value):
            return "missed"
        return "met" if (self.value <= self.target if self.at_most else self.value >= self.target) else "missed"


@dataclass(frozen=True)
class Effort:
    """How much is measured; the tests take less."""

    repeats: int = 7
    steps: int = 300  # of the trial that times a step of ours
    peer_steps: tuple[int, int] = (40, 5)  # of a peer's EKF and UKF
    landmarks: tuple[int, ...] = (50, 100, 200, 400, 1000)
    stride: int = 1
    growth_repeats: int = 3
    known_steps: int = 200
    size: tuple[int, int] = (LANDMARKS, SEEN)
    cloud: tuple[int, int] = (300, 1000)  # points and samples
    runs: int = 50
    run_steps: int = 500
    memory_runs: tuple[int, ...] = (1000, 3000)
    full_runs: int = 10_000


# --- steps --------------------------------------------------------------------------------------------


def peers(effort: Effort) -> Iterator[Row]:
    """Whole steps against other people's filters, asserted equal."""
    case = steady(effort.steps, *effort.size)
    for kind, steps in zip(NAMES, effort.peer_steps, strict=True):
        for who, peer in (
            ("filterpy", (FilterpyEkf if kind == "ekf" else FilterpyUkf)(case, steps)),
            ("Stone Soup", stone_soup(kind, case, steps)),
        ):
            target = AGAINST_FILTERPY[kind] if who == "filterpy" else None
            what = f"{kind.upper()} step, {effort.size[0]} landmarks, {effort.size[1]} seen: {who} / ours"
            if isinstance(peer, str):
                yield Row("peers", what, None, "x", target, note=peer)
            else:
                yield _against(what, peer, case, target, effort.repeats)
        yield _against_adapter(kind, case, WARM + steps, effort.repeats)


def _against(what: str, peer: Peer, case: Case, target: float | None, repeats: int) -> Row:
    gap = require_equal(what, *peer(), case.run(peer.filter), WARM)
    seconds = interleaved({"peer": peer, "ours": lambda: case.run(peer.filter)}, repeats)
    theirs, ours = seconds["peer"] / peer.steps, seconds["ours"] / case.trial.steps
    return Row("peers", what, theirs / ours, "x", target, note=f"{_us(theirs)} / {_us(ours)}, equal to {gap:.0e}")


def _against_adapter(kind: str, case: Case, steps: int, repeats: int) -> Row:
    """filterpy as the package ships it: a new filter object in each operation, and readable models."""
    head, start, adapter = case.head(steps), case.head(WARM), cs.get_filter(f"filterpy-{NAMES[kind]}")
    said = run_filter(adapter, head.trial, head.belief)
    gap = require_equal(adapter.name, said.pose[WARM:], said.covariance[WARM:], case.run(NAMES[kind]), WARM)
    seconds = interleaved(
        {
            "start": lambda: run_filter(adapter, start.trial, start.belief),
            "peer": lambda: run_filter(adapter, head.trial, head.belief),
            "ours": lambda: case.run(NAMES[kind]),
        },
        max(repeats // 2, 1),
        warm=False,
    )
    theirs, ours = (seconds["peer"] - seconds["start"]) / (steps - WARM), seconds["ours"] / case.trial.steps
    note = f"{_us(theirs)} / {_us(ours)}, equal to {gap:.0e}"
    return Row("peers", f"{kind.upper()} step, the same: filter '{adapter.name}' / ours", theirs / ours, "x", note=note)


def bare_update(n: int, m: int) -> Callable[[], None]:
    """dpotrf of S (m, m), dtrsm of A (m, n), dsyrk of P (n, n), in place; S = I leaves A as it is."""
    S, P = np.eye(m, order="F"), np.eye(n, order="F")
    A = np.asfortranarray(1e-3 * np.random.default_rng(0).standard_normal((m, n)))

    def update() -> None:
        lapack.dpotrf(S, lower=1, clean=0, overwrite_a=1)
        blas.dtrsm(1.0, S, A, lower=1, overwrite_b=1)
        blas.dsyrk(-1.0, A, beta=1.0, c=P, trans=1, lower=1, overwrite_c=1)

    return update


def kernels(effort: Effort) -> Iterator[Row]:
    """Ours against the bare linear algebra and against each other."""
    (landmarks, seen), count = effort.size, effort.steps
    case, blind = steady(count, landmarks, seen), steady(count, landmarks, seen=0)
    update = bare_update(3 + 3 * landmarks, 3 * seen)
    s = interleaved(
        {
            "ekf": lambda: case.run("ekf-uvd"),
            "ekf blind": lambda: blind.run("ekf-uvd"),
            "ukf": lambda: case.run("ukf-uvd"),
            "bare": lambda: [update() for _ in range(count)],
        },
        2 * effort.repeats,
    )
    t = {name: seconds / count for name, seconds in s.items()}
    ours = t["ekf"] - t["ekf blind"]
    note = f"{_us(ours)} ({seen} seen minus 0 seen: with Jacobians and H P) / {_us(t['bare'])}"
    yield Row("kernels", "EKF update / bare dpotrf + dtrsm + dsyrk", ours / t["bare"], "x", 1.4, True, note)
    note = f"{_us(t['ukf'])} / {_us(t['ekf'])}"
    yield Row("kernels", "UKF step / EKF step", t["ukf"] / t["ekf"], "x", 2.5, True, note)


def growth(effort: Effort) -> Iterator[Row]:
    """How the time of a step grows with the map, on a path that keeps moving."""
    cases = {str(n): growing(n, effort.stride) for n in effort.landmarks}
    low, high = effort.landmarks[0], effort.landmarks[-1]
    longest = cases[str(high)]
    gap = _equal_to_dense(longest)
    works: dict[str, Work] = {n: partial(c.run, "ekf-xyz") for n, c in cases.items()}
    s = interleaved(works | {"dense": partial(_dense, longest)}, effort.growth_repeats, warm=False)
    step = [s[n] / case.trial.steps for n, case in cases.items()]
    exponent = float(np.polyfit(np.log(effort.landmarks), np.log(step), 1)[0])
    note = "step averaged over the path: " + ", ".join(
        f"{n}: {_us(t)}" for n, t in zip(effort.landmarks, step, strict=True)
    )
    what = f"exponent of the EKF step's time, {low} to {high} landmarks, {SEEN} in view"
    yield Row("growth", what, exponent, "", 1.2, True, note)
    dense, ours = s["dense"] / longest.trial.steps, step[-1]
    note = f"averaged over the path: {_us(dense)} / {_us(ours)}, equal to {gap:.0e}"
    yield Row("growth", f"path to {high} landmarks: dense kernel / local", dense / ours, "x", 8.0, note=note)

    short, long, longer = (grown(high, 5 + steps) for steps in (0, 20, effort.known_steps))
    gap = _equal_to_dense(long)
    s = interleaved(
        {
            "short": partial(short.run, "ekf-xyz"),
            "longer": partial(longer.run, "ekf-xyz"),
            "dense short": partial(_dense, short),
            "dense long": partial(_dense, long),
        },
        effort.growth_repeats,
    )
    dense, ours = (s["dense long"] - s["dense short"]) / 20, (s["longer"] - s["short"]) / effort.known_steps
    note = f"{_us(dense)} / {_us(ours)}, equal to {gap:.0e}; a landmark long unseen comes back in each step"
    yield Row("growth", f"among {high} known landmarks: dense kernel / local", dense / ours, "x", note=note)


def _equal_to_dense(case: Case) -> float:
    dense, local = _dense(case), case.run("ekf-xyz")
    return require_equal("local updating", dense.pose[WARM:], dense.covariance[WARM:], local, WARM)


def _dense(case: Case) -> Estimates:
    """``ekf-xyz`` without local updating."""
    filter_ = cs.get_filter("ekf-xyz")
    try:
        filter_.local_from = sys.maxsize
        return case.run("ekf-xyz")
    finally:
        del filter_.local_from


# --- the whole program ---------------------------------------------------------------------------------


def program(effort: Effort) -> Iterator[Row]:
    """Workers, and time outside simulation and filters."""
    s = whole.workers(effort.runs, effort.repeats // 2 + 2, effort.run_steps)
    free = s["one thread"] / s["two threads"]
    note = f"{s['1']:.2f} s / {s['2']:.2f} s; meanwhile 2 threads of bare dgemm were {free:.2f} x faster than 1"
    yield Row("program", "1 worker / 2 workers", s["1"] / s["2"], "x", 1.85, note=note)
    for filters, target in ((["ekf-uvd"], 5.0), (whole.FILTERS, None)):
        share = 100 * whole.share_outside(effort.runs, effort.run_steps, filters, effort.growth_repeats)
        what = f"time outside simulation and filter, {effort.runs} x {effort.run_steps}, {' + '.join(filters)}"
        yield Row("program", what, share, "%", target, True)


def memory(effort: Effort, full: bool = False) -> Iterator[Row]:
    """Peak of a process that runs, writes and judges; extrapolated unless ``full``."""
    points = whole.memory((effort.full_runs,) if full else effort.memory_runs)
    mib = whole.extrapolated(points, effort.full_runs)
    peak = None if mib is None else mib / 1024
    how = "measured" if full else "extrapolated from"
    note = f"{how} " + ", ".join(f"{p['runs']:.0f} runs: {p['peak_mib']:.0f} MiB" for p in points)
    what = f"peak memory, {effort.full_runs} runs x 500 steps x 2 filters"
    yield Row("memory", what, peak, "GiB", 1.5, True, note)
    last = points[-1]
    note = f"estimates.parquet, {last['rows']:.0f} rows"
    yield Row("memory", "a row of estimates on disk", last["bytes"] / last["rows"], "bytes", 110.0, True, note)


def start(effort: Effort) -> Iterator[Row]:
    """What a user waits for."""
    yield Row("start", "consistency --help", whole.help_seconds(), "s", 0.4, True, "median of 5 processes")
    first, second = whole.first_and_second_run(effort.runs)
    note = f"1 filter, {effort.runs} runs x 500 steps, nothing compiled before"
    yield Row("start", "first consistency run", first, "s", 60.0, True, note)
    yield Row("start", "second consistency run", second, "s", 3.0, True, "the same command; median of 3")


def vision(effort: Effort) -> Iterator[Row]:
    points, samples = effort.cloud
    s = front_end.covariance_and_simulation(points, samples, effort.growth_repeats)
    note = f"{_us(s['simulate'])}, sample by sample / {_us(s['propagate'])}"
    what = f"covariance of a motion, {points} points: Monte Carlo of {samples} samples / ours"
    yield Row("vision", what, s["simulate"] / s["propagate"], "x", 200.0, note=note)
    note = f"{_us(s['at once'])}; all samples triangulated and registered in one call"
    yield Row("vision", "the same, vectorised over the samples", s["at once"] / s["propagate"], "x", note=note)
    what = f"covariance of a motion from {points} stereo matches in both frames"
    yield Row("vision", what, 1e3 * s["propagate"], "ms", 2.0, True)
    what = "motions between stereo pairs, from files to covariances"
    try:
        rate, note = front_end.motions_per_second(effort.growth_repeats)
    except InputError as error:
        yield Row("vision", what, None, "1/s", note=str(error))
    else:
        yield Row("vision", what, rate, "1/s", 3.0, note=note)


# --- the table -----------------------------------------------------------------------------------------

GROUPS: dict[str, Callable[[Effort], Iterator[Row]]] = {
    "peers": peers, "kernels": kernels, "growth": growth, "vision": vision, "program": program, "memory": memory,
    "start": start,
}  # fmt: skip


def document(rows: list[Row], wall: float) -> dict[str, Any]:
    versions = {name: metadata.version(name) for name in ("numpy", "scipy", "numba", "filterpy")}
    machine = {"cores": os.cpu_count(), "architecture": platform.machine(), "load": os.getloadavg()[0]}
    return {
        "rows": [asdict(row) | {"verdict": row.verdict} for row in rows],
        "machine": machine,
        "versions": {"python": platform.python_version()} | versions,
        "openblas_threads": os.environ.get("OPENBLAS_NUM_THREADS"),
        "wall_time_s": round(wall, 1),
    }


def line(row: Row) -> str:
    value = "-" if row.value is None else f"{row.value:.3g} {row.unit}".strip()
    target = "" if row.target is None else f"{'<=' if row.at_most else '>='} {row.target:g}"
    return f"{row.what:<72} {value:>10}  {target:<8} {row.verdict:<7} {row.note}".rstrip()


def _us(seconds: float) -> str:
    return f"{1e6 * seconds:.0f} us" if seconds < 0.01 else f"{1e3 * seconds:.0f} ms"


def main(arguments: list[str] | None = None) -> list[Row]:
    chosen = options_of(
        (__doc__ or "").splitlines()[0],
        arguments,
        out=(Path("reports/bench.json"), "JSON file to write"),
        full=(False, "measure the memory of 10,000 runs instead of extrapolating"),
        only=(str, "groups of rows", {"nargs": "+", "choices": GROUPS, "default": list(GROUPS)}),
    )
    started, effort, rows = time.monotonic(), Effort(), []
    for group in chosen.only:
        for row in memory(effort, chosen.full) if group == "memory" else GROUPS[group](effort):
            print(line(row), flush=True)
            rows.append(row)
    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    written = document(rows, time.monotonic() - started)
    chosen.out.write_text(json.dumps(written, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    aims = [row.verdict for row in rows if row.target is not None]
    print(f"{aims.count('missed')} of {len(aims)} targets missed; {written['wall_time_s']} s; {chosen.out}")
    return rows


if __name__ == "__main__":
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":  # read once, when the library is loaded: start again
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        os.execv(sys.executable, [sys.executable, *sys.argv])
    main()
