"""The result of a fit as rows of a table, as data for programs, and as files to go on with."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from consistency.bench.store.folder_tables import write_folder
from consistency.bench.store.log import Log
from consistency.bench.tuning.noise_groups import sigma_by_channel
from consistency.bench.tuning.result import Setting, Tuning, files
from consistency.referee.diagnostics import Verdict
from consistency.referee.diagnostics.verdict.as_dictionary import plain
from consistency.referee.system.provenance import manifest_of

KIND = "tuning"


def verdicts(tuning: Tuning) -> dict[str, Verdict]:
    """Rows of the table of verdicts, by name."""
    rows = {f"{tuning.filter}, as believed": tuning.before, f"{tuning.filter}, tuned": tuning.verdict}
    return rows | ({} if tuning.other is None else {f"{tuning.filter}, scaled to its errors": tuning.other.verdict})


def write(tuning: Tuning, out: Path, overwrite: bool) -> None:
    """Write the files of a fit, with its outcome, as a folder that appears whole."""
    outcome = json.dumps(as_data(tuning, out), indent=2, allow_nan=False) + "\n"
    texts = files(tuning) | {"tuning.json": outcome}

    def contents(at: Path) -> None:
        for name, text in texts.items():
            (at / name).write_text(text, encoding="utf-8")

    world = tuning.parts.world
    origin = {"log": world.name, "log_sha256": world.sha256} if isinstance(world, Log) else {"scenario": world.name}
    manifest = manifest_of(KIND, wall=tuning.seconds, filters=[tuning.filter], **origin)
    write_folder(out, {}, manifest, contents, overwrite)


def as_data(tuning: Tuning, out: Path | None = None) -> dict[str, Any]:
    """The outcome for programs; numbers that are not finite become null. An open interval has low 0 or high null."""
    data = {
        "filter": tuning.filter,
        "world": tuning.parts.world.name,
        "fitted_on": tuning.parts.about[0],
        "judged_on": tuning.parts.about[1],
        "before": _verdict(tuning.before),
        "chosen": _setting(tuning.chosen),
        "nearest": None if tuning.other is None else _setting(tuning.other),
        "tried": tuning.tried,
        "consistent": tuning.consistent,
        "no_setting": tuning.no_setting,
        "why": list(tuning.why),
        "seconds": tuning.seconds,
        "out": None if out is None else str(out),
    }
    return dict(plain(data))


def _setting(setting: Setting) -> Mapping[str, Any]:
    factors = [
        {
            "group": factor.group.name, "channels": list(factor.group.channels), "factor": factor.value,
            "low": factor.interval.low, "high": factor.interval.high, "edge": factor.edge,
        }
        for factor in setting.factors
    ]  # fmt: skip
    return {
        "by": setting.by, "factors": factors, "sigma": sigma_by_channel(setting.belief), "settings": setting.settings,
        "verdict": _verdict(setting.verdict),
    }  # fmt: skip


def _verdict(verdict: Verdict) -> Mapping[str, Any]:
    return {
        "status": verdict.status, "reasons": list(verdict.reasons), "runs": verdict.runs,
        "statistics": plain(verdict.statistics),
        "detectable": None if verdict.scale is None else verdict.scale.detectable,
    }  # fmt: skip
