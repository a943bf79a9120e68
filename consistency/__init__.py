"""The filter-consistency test bench: does an estimator tell the truth about its own uncertainty?"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from consistency.diagnostics import Alarm, Monitor, anees, anees_interval, nees
    from consistency.diagnostics.records import Verdict
    from consistency.errors import InputError
    from consistency.filters import filter_names, get_filter
    from consistency.runs.findings import Study
    from consistency.runs.montecarlo import run_trials
    from consistency.scenario import Scenario, load_scenario, scenario_names
    from consistency.simulation import simulate
    from consistency.store.results import Results, read_results
    from consistency.types import Control, Finding, Gaussian, Info, Observation, Trial
    from consistency.verdicts.judge import analyse

_HOME = {
    "InputError": "errors",
    "Scenario": "scenario",
    "load_scenario": "scenario",
    "scenario_names": "scenario",
    "simulate": "simulation",
    "filter_names": "filters",
    "get_filter": "filters",
    "run_trials": "runs.montecarlo",
    "Results": "store.results",
    "read_results": "store.results",
    "nees": "diagnostics",
    "anees": "diagnostics",
    "anees_interval": "diagnostics",
    "Alarm": "diagnostics",
    "Monitor": "diagnostics",
    "analyse": "verdicts.judge",
    "Finding": "types",
    "Study": "runs.findings",
    "Control": "types",
    "Gaussian": "types",
    "Info": "types",
    "Observation": "types",
    "Trial": "types",
    "Verdict": "diagnostics.records",
}

__all__ = [
    "Alarm", "Control", "Finding", "Gaussian", "Info", "InputError", "Monitor", "Observation", "Results", "Scenario",
    "Study", "Trial", "Verdict", "analyse", "anees", "anees_interval", "filter_names", "get_filter", "load_scenario",
    "nees", "read_results", "run_trials", "scenario_names", "simulate",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    # imported on first use, so that `import consistency` and `--help` stay fast
    if name not in _HOME:
        raise AttributeError(f"module 'consistency' has no attribute '{name}'")
    return getattr(importlib.import_module(f"consistency.{_HOME[name]}"), name)
