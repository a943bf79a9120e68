"""Is what ``run`` says of the memory of a run within a quarter of what the run takes?

    python benchmarks/memory.py               # eight pairs of filter and world: ten minutes
    python benchmarks/memory.py --pairs 1 3   # some of them, by number

Each run is done in a process of its own, after a run of the same filter in a small world, so that code, libraries and
what they keep do not count. The peak is that of the resident memory. Exit status 1 where an estimate is further off.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from typing import Any, NamedTuple

import numpy as np
from script_options import options_of

import consistency as cs
from consistency.bench.runs.memory_needed import trial_bytes
from consistency.bench.store.trial_rows import outcome_of

MIB = 2**20
OFF = 0.25
RIGHT = (1.0 - OFF, 1.0 + OFF)
UNIT = 1024 if sys.platform == "linux" else 1  # bytes of ``ru_maxrss``


class Pair(NamedTuple):
    """A filter, and a world of so many landmarks and steps; ``range`` in m, None for that of the world."""

    world: str
    filter: str
    landmarks: int
    steps: int
    range: float | None = None


PAIRS = (
    Pair("linear-gaussian", "kf", 5000, 2, 50.0),
    Pair("herath2007-stereo", "ekf-uvd", 5000, 5, 30.0),
    Pair("herath2007-stereo", "ekf-uvd", 3000, 300),
    Pair("herath2007-stereo", "ukf-uvd", 2500, 3, 30.0),
    Pair("herath2007-stereo", "ekf-uvd+joint", 2500, 3, 30.0),
    Pair("herath2007-stereo", "parked-ekf-uvd", 4000, 5, 30.0),
    Pair("herath2007-stereo", "robocentric-ekf-uvd", 4000, 5, 30.0),
    Pair("esde-xy", "ekf-xy", 1500, 5, 30.0),
)


def measured(pair: Pair) -> dict[str, float | str]:
    """Estimate and peak, bytes; in this process."""
    world = cs.load_scenario(pair.world)
    changes: dict[str, Any] = {"truth__steps": pair.steps}
    nearest = world.truth.sensor.range[0]
    if pair.range is not None:
        changes["truth__sensor__range"] = (nearest, pair.range)
    world = world.variant("large", truth__landmarks__count=pair.landmarks, **changes)
    changes = {"truth__landmarks__count": 15, "truth__steps": 3, "truth__sensor__range": (nearest, 100.0)}
    small, filter_ = world.variant("small", **changes), cs.get_filter(pair.filter)
    trial = cs.simulate(small)
    outcome_of(trial, [filter_.run(trial, small.belief)])
    trial = cs.simulate(world)
    filter_.compile(trial, world.belief)
    before = resident()
    estimates = filter_.run(trial, world.belief)
    outcome_of(trial, [estimates])
    peak = UNIT * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "seen": len(np.unique(trial.landmark)), "estimate": trial_bytes([filter_], trial, world.belief),
        "peak": peak - before, "failure": str(estimates.failure or ""),
    }  # fmt: skip


def resident() -> int:
    with open("/proc/self/statm", encoding="ascii") as numbers:
        return int(numbers.read().split()[1]) * resource.getpagesize()


def main() -> int:
    arguments = options_of(
        __doc__.split("\n")[0],
        pairs=(int, "numbers from 1", {"nargs": "+", "default": range(1, len(PAIRS) + 1)}),
        one=(int, argparse.SUPPRESS),
    )
    if arguments.one is not None:
        print(json.dumps(measured(PAIRS[arguments.one - 1])))
        return 0
    print("| world | filter | landmarks seen | steps | estimate, MiB | measured, MiB | ratio |")
    print("|---|---|---|---|---|---|---|")
    ratios = []
    for number in arguments.pairs:
        words = [sys.executable, __file__, "--one", str(number)]
        said = json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)
        pair, estimate, peak = PAIRS[number - 1], said["estimate"] / MIB, said["peak"] / MIB
        ratios.append(estimate / peak)
        figures = f"{said['seen']} | {pair.steps} | {estimate:.0f} | {peak:.0f} | {ratios[-1]:.2f}"
        print(f"| {pair.world} | {pair.filter} | {figures} | {said['failure']}", flush=True)
    return int(not all(RIGHT[0] <= ratio <= RIGHT[1] for ratio in ratios))


if __name__ == "__main__":
    sys.exit(main())
