"""Every filter in one table; is the map of a filter whose pose is consistent consistent too?"""

from __future__ import annotations

import time
from importlib.util import find_spec

import numpy as np
import pandas as pd

import consistency as cs
from consistency.bench.filters import filter_names, get_filter
from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.filters.run_filter import run_filter
from consistency.bench.protocols import is_realisable
from consistency.bench.runs.reproduce_findings import OURS, script

FINDINGS = ("consistent-map", "cost-of-consistency")
LONG = True

WORLD = "herath2007-stereo"
REFERENCE = "ekf-uvd"  # whose step the cost is relative to
ROUNDS, FEW = 25, 3  # in which every filter is timed once on the same trial; of those that take longer than SLOW
SLOW = 1.0  # s, a trial
# --- rules ------------------------------------------------------------------------------------
FALSE_ALARM = 0.01  # of each verdict
COST = 2.0  # times a step of the reference


def main(study: cs.Study) -> list[cs.Finding]:
    """Verdicts on pose and map, errors, failures and cost of a step of every filter of (u, v, d)."""
    left_out = (
        "gtsam-",
        *(() if find_spec("filterpy") else ("filterpy-",)),
    )  # a smoother takes a minute a trial
    names = [name for name in filter_names() if name.endswith("-uvd") and not name.startswith(left_out)]
    results = study.results(WORLD, names)
    verdicts = cs.analyse(results, names, confidence=1.0 - FALSE_ALARM)
    cost = costs(names, study.seed)
    table = pd.DataFrame([row(verdicts[name], cost[name]) for name in names])
    study.tables["filters"] = table.assign(runs=study.runs, false_alarm=FALSE_ALARM, scenario=WORLD)
    return [map_finding(study, table), cost_finding(study, table)]


def costs(names: list[str], seed: int) -> dict[str, float]:
    """Time of a trial over that of the reference: the median over rounds of all filters."""
    scenario = cs.load_scenario(WORLD)
    trial, filters = cs.simulate(scenario, run=0, seed=seed), {name: get_filter(name) for name in names}
    for filter_ in filters.values():  # compile
        run_filter(filter_, trial, scenario.belief)
    seconds: dict[str, list[float]] = {name: [] for name in names}
    with one_blas_thread():
        for number in range(ROUNDS):
            for name, filter_ in filters.items():
                if number < FEW or max(seconds[name]) < SLOW:
                    started = time.perf_counter()
                    run_filter(filter_, trial, scenario.belief)
                    seconds[name].append(time.perf_counter() - started)
    of_reference = seconds[REFERENCE]
    return {name: float(np.median(np.divide(s, of_reference[: len(s)]))) for name, s in seconds.items()}


def row(verdict: cs.Verdict, cost: float) -> dict[str, object]:
    """What the table says of one filter; NaN or a dash where there is nothing."""
    accuracy, score = verdict.in_world.accuracy, verdict.map
    of_map = None if score is None else score.verdict
    joint = None if of_map is None else of_map.joint
    return {
        "filter": verdict.filter,
        "realisable": "yes" if is_realisable(get_filter(verdict.filter)) else "no",
        "error": verdict.convention or "so2",
        "status": verdict.status,
        "diagnosis": verdict.reasons[0],
        "anees": verdict.statistic,
        "rmse": np.nan if accuracy is None else accuracy.rmse_position,
        "rmse_heading_deg": np.nan if accuracy is None else np.rad2deg(accuracy.rmse_heading),
        "map_status": "-" if of_map is None else of_map.status,
        "map_diagnosis": "-" if of_map is None else of_map.reasons[0],
        "map_nees": np.nan if score is None else score.ratio.value,
        "joint_nees": np.nan if joint is None else joint.both.value,
        "joint_low": np.nan if joint is None else joint.both.low,
        "joint_high": np.nan if joint is None else joint.both.high,
        "cost": cost,
        "failures": len({failure.run for failure in verdict.failures}),
    }


def map_finding(study: cs.Study, table: pd.DataFrame) -> cs.Finding:
    """Are the maps consistent of all realisable filters whose pose is?"""
    right = table[(table["status"] == "consistent") & (table["realisable"] == "yes")]
    parts = [
        f"{r['filter']}: pose {r['anees'] / 3.0:.2f}, map {r['map_status']}, landmarks {r['map_nees']:.2f}, together "
        f"{r['joint_nees']:.3f} [{r['joint_low']:.3f}, {r['joint_high']:.3f}]"
        for r in right.to_dict("records")
    ]
    return study.finding(
        len(right) > 0 and bool((right["map_status"] == "consistent").all()),
        scenario=WORLD,
        id="consistent-map",
        source=OURS,
        claim="a map from a filter whose pose is consistent is consistent too",
        statistic="verdict on the map after the last step; NEES over degrees of freedom of the pose over the run, of "
        "each landmark by itself, and of pose and map together",
        published="not asked",
        measured="; ".join(parts) or "no realisable filter has a consistent pose",
        accept="the map of every realisable filter whose pose is called consistent is called consistent, and there is "
        f"such a filter (false alarm {FALSE_ALARM:.0%} in each verdict)",
    )


def cost_finding(study: cs.Study, table: pd.DataFrame) -> cs.Finding:
    right = table[(table["status"] == "consistent") & (table["realisable"] == "yes")].sort_values("cost")
    parts = [
        f"{r['filter']} {r['cost']:.2f} times {REFERENCE}, RMSE {r['rmse']:.3f} m" for r in right.to_dict("records")
    ]
    return study.finding(
        len(right) > 0 and bool(right["cost"].iloc[0] <= COST),
        scenario=WORLD,
        id="cost-of-consistency",
        source=OURS,
        claim=f"a consistent pose costs at most {COST:g} times a step of {REFERENCE}",
        statistic=f"median over {ROUNDS} rounds ({FEW} of slow filters) of the time of a trial over that of "
        f"{REFERENCE} in the same round, one process, one thread; of realisable filters whose pose is called "
        "consistent",
        published="not asked",
        measured="; ".join(parts) or "no realisable filter has a consistent pose",
        accept=f"the cheapest takes at most {COST:g} times as long; a robot that has room for the EKF usually has room "
        "for twice its cost",
    )


if __name__ == "__main__":
    script(main)
