"""The result of a fit: in words, as rows of a table, as data for programs, and as files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from consistency.bench.scenario import Belief, scenario_text, toml_text
from consistency.bench.scenario.tables.toml_tables import SIGMA_UNITS
from consistency.bench.store.folder_tables import write_tables
from consistency.bench.store.recorded_log import Log, sensor_text
from consistency.bench.tuning.fit_and_verdict_trials import Parts, with_belief
from consistency.bench.tuning.noise_factor_fit import LIMIT
from consistency.bench.tuning.noise_groups import NoiseGroup, sigma_by_channel
from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.verdict.as_dictionary import plain
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.diagnostics.verdict.verdict import Verdict
from consistency.referee.diagnostics.words.numbers import short
from consistency.referee.system.provenance import manifest_of

KIND = "tuning"


@dataclass(frozen=True)
class Factor:
    """Factor on the variances of a group of noises, with a 95 % interval.

    The interval is open, with an end of 0 or infinity, on a side on which the data do not bound the factor.
    ``edge`` is -1 or 1 where the factor lies at the lower or upper limit of what is tried, which is then no estimate.
    """

    group: NoiseGroup
    value: float
    interval: Interval
    edge: int = 0


@dataclass(frozen=True)
class Setting:
    """A fit, the belief that it leads to, and the verdict on it."""

    factors: tuple[Factor, ...]
    belief: Belief
    verdict: Verdict
    settings: int  # that were tried


@dataclass(frozen=True)
class Tuning:
    """Result of a fit, with the verdicts before and after it."""

    filter: str
    parts: Parts
    before: Verdict  # with the belief as it was, on the runs that are judged
    chosen: Setting
    seconds: float

    @property
    def verdict(self) -> Verdict:
        """After the fit, on runs that it has not seen."""
        return self.chosen.verdict

    @property
    def consistent(self) -> bool:
        return self.verdict.consistent

    @property
    def has_fault(self) -> bool:
        """Whether a fault is found after the fit; an undecided verdict has none."""
        return self.verdict.status not in ("consistent", "undecided")

    @property
    def factors(self) -> tuple[Factor, ...]:
        return self.chosen.factors

    @property
    def belief(self) -> Belief:
        """With the noises of the chosen setting."""
        return self.chosen.belief

    def __str__(self) -> str:
        return "\n".join(tuning_lines(self))


def tuning_lines(tuning: Tuning, out: Path | None = None) -> list[str]:
    """What to print beside the table of verdicts; ``out`` is the folder that was written."""
    parts, chosen = tuning.parts, tuning.chosen
    lines = [
        f"{tuning.filter} on {parts.world.name}: fitted by the likelihood of the innovations on {parts.fitted_on}, "
        f"judged on {parts.judged_on} ({chosen.settings} settings, {tuning.seconds:.0f} s)",
        *_factor_lines(chosen, parts.belief),
        f"before: {tuning.before.reasons[0]}{_power(tuning.before)}",
        f"after: {chosen.verdict.reasons[0]}{_power(chosen.verdict)}",
    ]
    if tuning.has_fault:
        names = ", ".join(factor.group.name for factor in chosen.factors)
        chance = f"one of {1.0 / chosen.verdict.settings.false_alarm:.3g} verdicts on a right filter"
        lines.append(
            f"the size of {names} is not all that is wrong, unless the fault was found by chance, as in {chance}; "
            "docs/tuning.md says what else may be"
        )
    lines += ["", noise_table(tuning).rstrip()]
    if out is not None:
        lines += ["", f"{out} has {', '.join(files(tuning))}{_next(tuning, out)}"]
    return lines


def _factor_lines(setting: Setting, before: Belief) -> list[str]:
    sigma_before, sigma_after = sigma_by_channel(before), sigma_by_channel(setting.belief)
    rows = []
    for factor in setting.factors:
        changes = [f"{name} {sigma_before[name]:.4g} -> {sigma_after[name]:.4g}" for name in factor.group.channels]
        rows.append(f"  {factor.group.name} {factor_text(factor)} (sigma: {', '.join(changes)})")
    return rows


def factor_text(factor: Factor) -> str:
    """x1.02 [0.97, 1.07], of variances; "at most" or "at least" where the data bound it on one side alone."""
    low, high = factor.interval.low, factor.interval.high
    factor_value, confidence = f"x{short(factor.value)}", f"with {100.0 * CONFIDENCE:g} %"
    bound_of_factor = ""
    if np.isfinite(high):
        bound_of_factor = f"at most x{short(high)}"
    elif low > 0.0:
        bound_of_factor = f"at least x{short(low)}"
    if factor.edge:
        limit = np.exp(factor.edge * LIMIT)
        return f"is at the limit of what is tried, x{limit:g}; {bound_of_factor or 'not known'} {confidence}"
    if low > 0.0 and np.isfinite(high):
        return f"{factor_value} [{short(low)}, {short(high)}]"
    if bound_of_factor:
        return f"{factor_value}, {bound_of_factor} {confidence}"
    return f"{factor_value}, which these data do not bound"


def _power(verdict: Verdict) -> str:
    if verdict.scale is None or not np.isfinite(verdict.scale.detectable):
        return ""
    ratio = short(verdict.scale.detectable)
    return f" (a covariance too small by x{ratio} would be found with power {verdict.settings.power:g})"


def noise_table(tuning: Tuning) -> str:
    """The believed noises as TOML to paste: into a scenario, or into ``sensor.toml`` of a log."""
    belief = tuning.belief
    motion = {"sigma_v": belief.motion.sigma_v, "sigma_omega": belief.motion.sigma_omega}
    sigma = {f"sigma{SIGMA_UNITS[belief.sensor.model]}": list(belief.sensor.sigma)}
    if isinstance(tuning.parts.world, Log):
        return toml_text(sigma | {"motion": motion})
    return toml_text({"belief": {"motion": motion, "sensor": sigma}})


def files(tuning: Tuning) -> dict[str, str]:
    """Text of the tuned world, or sensor, by name of its file."""
    world, belief = tuning.parts.world, tuning.belief
    comment = (
        f"{tuning.filter} tuned by the likelihood of the innovations on {tuning.parts.fitted_on}: "
        f"{tuning.verdict.status}"
    )
    if isinstance(world, Log):
        return {"sensor.toml": f"# {comment}\n{sensor_text(Path(world.name), belief)}"}
    name = f"{world.name}-tuned"
    return {f"{name}.toml": scenario_text(with_belief(world, belief, name), comment)}


def _next(tuning: Tuning, out: Path) -> str:
    world, run = tuning.parts.world, "consistency run"
    if isinstance(world, Log):
        use = f"{run} --log {world.name} --filter {tuning.filter} --out results"
        return f"; put it in the place of {Path(world.name) / 'sensor.toml'}, and run: {use}"
    [name] = files(tuning)
    return f"; judged again by: {run} {out / name} --filter {tuning.filter} {tuning.parts.again} --out results"


def tuning_verdicts(tuning: Tuning) -> dict[str, Verdict]:
    """Rows of the table of verdicts, by name."""
    return {f"{tuning.filter}, as believed": tuning.before, f"{tuning.filter}, tuned": tuning.verdict}


def write(tuning: Tuning, out: Path, overwrite: bool) -> None:
    """Write the files of a fit, with its outcome, as a folder that appears whole."""
    tuning_json = json.dumps(tuning_data(tuning, out), indent=2, allow_nan=False) + "\n"
    texts_by_file = files(tuning) | {"tuning.json": tuning_json}

    def contents(at: Path) -> None:
        for name, text in texts_by_file.items():
            (at / name).write_text(text, encoding="utf-8")

    world = tuning.parts.world
    origin: dict[str, Any] = {"scenario": world.name}
    if isinstance(world, Log):
        origin = {"log": world.name, "log_sha256": world.sha256}
    manifest = manifest_of(KIND, wall=tuning.seconds, filters=[tuning.filter], **origin)
    write_tables(out, {}, manifest, contents, overwrite)


def tuning_data(tuning: Tuning, out: Path | None = None) -> dict[str, Any]:
    """The outcome for programs; numbers that are not finite become null. An open interval has low 0 or high null."""
    data = {
        "filter": tuning.filter,
        "world": tuning.parts.world.name,
        "fitted_on": tuning.parts.fitted_on,
        "judged_on": tuning.parts.judged_on,
        "before": _verdict_data(tuning.before),
        "chosen": _setting_data(tuning.chosen),
        "consistent": tuning.consistent,
        "seconds": tuning.seconds,
        "out": None if out is None else str(out),
    }
    return dict(plain(data))


def _setting_data(setting: Setting) -> Mapping[str, Any]:
    factors = []
    for factor in setting.factors:
        group, interval = factor.group, factor.interval
        row = {"group": group.name, "channels": list(group.channels), "factor": factor.value}
        factors.append(row | {"low": interval.low, "high": interval.high, "edge": factor.edge})
    return {
        "factors": factors,
        "sigma": sigma_by_channel(setting.belief),
        "settings": setting.settings,
        "verdict": _verdict_data(setting.verdict),
    }


def _verdict_data(verdict: Verdict) -> Mapping[str, Any]:
    return {
        "status": verdict.status,
        "reasons": list(verdict.reasons),
        "runs": verdict.runs,
        "statistics": plain(verdict.statistics),
        "detectable": None if verdict.scale is None else verdict.scale.detectable,
    }
