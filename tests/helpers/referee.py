"""The referee with all that it takes as keywords: arrays to Record, the rest to Settings."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from consistency.diagnostics import Record, Settings, Verdict
from consistency.diagnostics import judge as judge_evidence

OF_SETTINGS = {field.name for field in fields(Settings)}


def judge(name: str, error: Any = None, covariance: Any = None, **options: Any) -> Verdict:
    """``judge(Record(name, ...), Settings(...))``."""
    settings = {key: options.pop(key) for key in OF_SETTINGS & set(options)}
    return judge_evidence(Record(name, error, covariance, **options), Settings(**settings))
