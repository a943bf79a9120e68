"""The whole reproduction, derived again and compared with the summaries in reports/reference."""

import json
from pathlib import Path

import numpy as np
import pytest

import consistency as cs
from consistency.bench.runs.reproduce_findings import reproduce
from consistency.bench.runs.results_to_records import record_of

REFERENCE = Path(__file__).parents[2] / "reports" / "reference"


def summary(folder):
    """Status and median run's mean NEES by study and filter; the median, because one diverging run decides a mean."""
    out = {}
    for path in sorted(folder.glob("*/estimates.parquet")):
        results = cs.read_results(path.parent)
        out[path.parent.name] = {
            name: [verdict.status, float(np.median(np.nanmean(record_of(results, name).errors.nees, axis=1)))]
            for name, verdict in cs.analyse(results).items()
        }
    return out


@pytest.mark.slow
def test_findings_and_verdicts_are_those_of_the_reference(tmp_path):
    """Deterministic: same seed, so no chance of a false alarm; 1 % is left to other processors' last digits."""
    findings = reproduce(None, runs=50, seed=0, jobs=-1, out=tmp_path / "out")
    reference = json.loads((REFERENCE / "findings.json").read_text(encoding="utf-8"))
    assert [(f.id, f.verdict) for f in findings] == [(f["id"], f["verdict"]) for f in reference]
    now, then = summary(tmp_path / "out"), json.loads((REFERENCE / "verdicts.json").read_text(encoding="utf-8"))
    assert now.keys() == then.keys()
    for study, filters in then.items():
        assert now[study].keys() == filters.keys()
        for name, (status, median) in filters.items():
            assert now[study][name][0] == status, (study, name)
            assert now[study][name][1] == pytest.approx(median, rel=1e-2), (study, name)
