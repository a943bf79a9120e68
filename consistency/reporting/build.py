"""From an output folder to the report model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from consistency.diagnostics import Verdict
from consistency.errors import InputError
from consistency.models.motion import dead_reckoning
from consistency.reporting.calibration import calibration
from consistency.reporting.distributions import distributions
from consistency.reporting.model import Report, Study, Track
from consistency.reporting.stereo import front_end
from consistency.reporting.wording import answer, number
from consistency.runs.findings import read_findings
from consistency.scenario import Scenario
from consistency.simulation import simulate
from consistency.store.results import read_results
from consistency.store.storage import read_manifest
from consistency.types import Array
from consistency.verdicts.judge import Curves, analyse, curves, design_of

DECADE = 10.0  # values that span more are drawn on a log axis
DEGREES = np.array([1.0, 1.0, 180.0 / np.pi])


def build_report(folder: Path) -> Report:
    """Read a folder of ``consistency run`` or ``consistency reproduce`` and work out what a report says.

    Raises
    ------
    InputError
        The folder holds no results, or a file in it is damaged.
    """
    manifest = read_manifest(folder)
    if "studies" in manifest:
        parts = [folder / str(name) for name in manifest["studies"]]
    elif "filters" in manifest:
        parts = [folder]
    else:
        raise InputError(f"{folder}: holds no filter results; write some with 'consistency run', then report those")
    styles: dict[str, int] = {}
    provenance = _provenance(manifest)
    studies = tuple(_study(part, styles, () if part == folder else provenance) for part in parts)
    findings = tuple(read_findings(folder))
    name = "reproduction" if "studies" in manifest else studies[0].name
    return Report(
        f"Filter consistency: {name}", answer(studies, findings), studies, findings,
        distributions(folder / "fig12.parquet"), front_end(folder), calibration(), provenance,
    )  # fmt: skip


def _study(folder: Path, styles: dict[str, int], said: tuple[tuple[str, str], ...]) -> Study:
    """One folder of results; ``said`` are lines of provenance that the report gives already."""
    results = read_results(folder)
    scenario = results.scenario
    verdicts = analyse(results)
    all_curves = {name: curves(results, name) for name in results.filters}
    runs = np.unique(np.concatenate([c.runs for c in all_curves.values()]))
    shown = int(runs[0]) if len(runs) else 0
    steps = max((len(c.t) for c in all_curves.values()), default=0)
    for name in results.filters:
        styles.setdefault(name, len(styles))
    common = _common(verdicts)
    paths = {name: _path(results.estimates, name, shown, steps) for name in results.filters}
    tracks = tuple(_track(all_curves[n], verdicts[n], shown, styles[n], common, paths[n]) for n in results.filters)
    resolved = results.manifest.get("scenario") or results.manifest.get("belief") or {}
    return Study(
        name=scenario.name if scenario else Path(str(results.manifest.get("log", folder.name))).name,
        summary=scenario.summary if scenario else "Recorded log",
        runs=len(runs),
        shown_run=shown,
        steps=np.arange(1, steps + 1),
        tracks=tracks,
        true_path=_true_path(results.truth, shown),
        odometry=_odometry(scenario, results.manifest, shown),
        landmarks=None if results.landmarks is None else results.landmarks[["x", "y"]].to_numpy(float),
        anees_log=_wide([v for t in tracks for v in (t.anees, t.simultaneous) if v is not None]),
        nis_log=_wide([t.nis_ratio for t in tracks]),
        is_log=scenario is None,
        until_decided=design_of(results) is not None,
        provenance=tuple(row for row in _provenance(results.manifest) if row not in said),
        resolved=json.dumps(_rounded(resolved), indent=2, ensure_ascii=False),
    )


def _track(c: Curves, verdict: Verdict, shown: int, style: int, common: Verdict | None, path: Array) -> Track:
    steps = len(c.t)
    row = int(np.searchsorted(c.runs, shown))
    has_run = row < len(c.runs) and c.runs[row] == shown
    scale, location = verdict.scale, verdict.location
    variance = np.diagonal(c.covariance, axis1=-2, axis2=-1)
    ratio = _nis_ratio(c, verdict.runs)
    empty = np.full((steps, 3), np.nan)
    return Track(
        name=c.filter,
        style=style,
        verdict=verdict,
        path=path,
        error=None if c.error is None else DEGREES * (c.error[row] if has_run else empty),
        sigma=DEGREES * np.sqrt(np.maximum(variance[row], 0.0)) if has_run else empty,
        anees=None if scale is None else scale.anees,
        band=None if scale is None else scale.band,
        simultaneous=None if location is None else location.simultaneous,
        own_band=_fewer(verdict, common),
        nis_ratio=ratio,
        nis_log=_wide([ratio]),
        failures=c.failures,
    )


def _nis_ratio(c: Curves, runs: int) -> Array:
    """NIS of the first ``runs`` runs over their degrees of freedom in each step, (steps,)."""
    nis, nis_dof = c.nis[:runs], c.nis_dof[:runs]
    known = np.isfinite(nis) & (nis_dof > 0)
    dof = np.where(known, nis_dof, 0).sum(axis=0)
    total = np.where(known, nis, 0.0).sum(axis=0)
    return np.asarray(np.where(dof > 0, total / np.maximum(dof, 1), np.nan))


def _common(verdicts: dict[str, Verdict]) -> Verdict | None:
    """The verdict of most runs whose band is drawn for all filters: those of the others are wider."""
    judged = [(v, v.scale) for v in verdicts.values() if v.scale is not None and v.scale.judged_steps]
    best = min(judged, key=lambda p: (-p[0].runs, len(p[0].failures), -int(p[1].alive.sum())), default=None)
    return None if best is None else best[0]


def _fewer(verdict: Verdict, common: Verdict | None) -> bool:
    """Whether failed runs, or an earlier decision, have made the band another one than the common band."""
    if verdict.scale is None or common is None or common.scale is None:
        return False
    same = np.array_equal(verdict.scale.band, common.scale.band, equal_nan=True)
    return not same and (bool(verdict.failures) or verdict.runs < common.runs)


def _wide(values: list[Array]) -> bool:
    flat = np.concatenate([v.ravel() for v in values]) if values else np.empty(0)
    flat = flat[np.isfinite(flat) & (flat > 0)]
    return bool(flat.size) and bool(flat.max() > DECADE * flat.min())


def _rounded(value: Any) -> Any:
    """Six digits of every number, to read; the manifest has them all."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _path(estimates: pd.DataFrame, filter_name: str, run: int, steps: int) -> Array:
    """Estimated x and y of one run, (steps, 2); NaN where there is no estimate."""
    path = np.full((steps, 2), np.nan)
    rows = estimates[(estimates["filter"] == filter_name) & (estimates["run"] == run)]
    path[rows["step"].to_numpy() - 1] = rows[["x", "y"]].to_numpy(float)
    return path


def _true_path(truth: pd.DataFrame | None, run: int) -> Array | None:
    if truth is None:
        return None
    path = truth.loc[truth["run"] == run].sort_values("step")[["x", "y"]].to_numpy(float)
    return path if len(path) else None


def _odometry(scenario: Scenario | None, manifest: dict[str, Any], run: int) -> Array | None:
    """The path by the controls alone; results keep no controls, but a simulated trial can be drawn again."""
    seed = manifest.get("seed")
    if scenario is None or seed is None:
        return None
    trial = simulate(scenario, run, int(seed))
    return dead_reckoning(trial.start, trial.controls)[:, :2]


def _provenance(manifest: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    versions = manifest.get("versions") or {}
    wall = manifest.get("wall_time_s")
    rows = {
        "Seed": manifest.get("seed"),
        "Runs": manifest.get("runs"),
        "Scenario hash": manifest.get("scenario_hash"),
        "Command": manifest.get("command"),
        "Git commit": manifest.get("git_commit"),
        "Wall time": None if wall is None else f"{number(float(wall), '.1f')} s",
        "Versions": ", ".join(f"{name} {version}" for name, version in versions.items()) or None,
    }
    if manifest.get("complete") is False:
        rows["Complete"] = "no: the run was interrupted; the numbers are of the finished runs"
    return tuple((name, str(value)) for name, value in rows.items() if value is not None)
