"""The referee with all that it takes as keywords: arrays to Record, the rest to Settings."""

from dataclasses import fields

from consistency.diagnostics import Settings, make_record
from consistency.diagnostics import judge as judge_evidence

OF_SETTINGS = {field.name for field in fields(Settings)}


def judge(name, error=None, covariance=None, **options):
    """``judge(make_record(name, ...), Settings(...))``."""
    settings = {key: options.pop(key) for key in OF_SETTINGS & set(options)}
    return judge_evidence(make_record(name, error, covariance, **options), Settings(**settings))
