"""Errors that all estimates share: fitted to other drives, or to one half, and taken off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import consistency
from recorded import read_recordings
from scipy.linalg import block_diag

import consistency as cs
from consistency.referee.diagnostics import Record, Settings, judge
from consistency.referee.diagnostics.imperfect_truth.shared_errors import (
    KINDS,
    VAGUE,
    fit_record,
    growth,
    halves,
    without_shared,
)
from consistency.referee.diagnostics.verdict.answers import BIAS
from consistency.referee.errors import InputError
from consistency.referee.readers.shared_calibration import ONE_LOG, less_shared
from consistency.referee.types import Array

RUNS, STEPS, N = 40, 12, 3
P = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, -0.01], [0.0, -0.01, 0.02]])
FLOOR = np.array([0.1, 0.2, 0.05])
THETA = np.array([0.5, -0.3, 0.2])


def drives(kind: str, rng: np.random.Generator, runs: int = RUNS, ratio: float = 1.0) -> Record:
    """Errors with a shared part, of the covariance P and a floor, on straight paths of different speeds."""
    t = np.arange(STEPS) * 0.5
    speed = rng.uniform(1.0, 2.0, (runs, 1))
    true = np.stack([speed * t, np.zeros((runs, STEPS))], axis=-1)
    path = np.stack([true, 2.0 * true + 1.0], axis=2)
    g = {"by-vector": np.ones((runs, STEPS)), "by-time": np.tile(t, (runs, 1)), "by-distance": speed * t}[kind]
    noise = rng.normal(size=(runs, STEPS, N)) @ np.linalg.cholesky(ratio * (P + np.diag(FLOOR**2))).T
    covariances = np.broadcast_to(P, (runs, STEPS, N, N))
    return Record("est", g[..., None] * THETA + noise, covariances, path=path, t=7.0 + t, axes=("x", "y", "z"))


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_shared_is_found_and_taken_off(kind: str) -> None:
    """6 standard deviations of theta (3 numbers: chance 1e-8); a floor of 480 errors to 6 x 3 %."""
    rng = np.random.default_rng()
    fit = fit_record(drives(kind, rng), kind)
    off = fit.mean - THETA
    assert off @ np.linalg.solve(fit.covariance / STEPS, off) < 45.0
    np.testing.assert_allclose(np.diag(P) + fit.floor**2, np.diag(P) + FLOOR**2, rtol=0.4)
    other = drives(kind, rng)
    rest = without_shared(other, fit, kind)
    g = growth(other, kind)
    np.testing.assert_allclose(rest.error, other.error - g[..., None] * fit.mean)
    step = np.asarray(rest.covariance)[3, 4]
    np.testing.assert_allclose(step, P + g[3, 4] ** 2 * fit.covariance + np.diag(fit.floor**2))
    assert set(BIAS) <= set(rest.unavailable)


def test_the_fit_is_that_of_the_whole_gaussian() -> None:
    """Theta given all errors by the joint covariance of everything, with the fitted floor; steps count as one."""
    record = drives("by-time", np.random.default_rng(), runs=3)
    fit = fit_record(record, "by-time")
    g = growth(record, "by-time")
    there = g.ravel() > 0
    e, J = record.error.reshape(-1, N)[there], np.kron(g.ravel()[there][:, None], np.eye(N))
    prior = VAGUE * np.sqrt((e**2).mean(axis=0)) / np.sqrt((g.ravel()[there] ** 2).mean())
    root = np.linalg.inv(np.linalg.cholesky(block_diag(*[P + np.diag(fit.floor**2)] * len(e))))
    Q, R = np.linalg.qr(np.vstack([root @ J, np.diag(1.0 / prior)]))
    np.testing.assert_allclose(fit.mean, np.linalg.solve(R, Q[: e.size].T @ root @ e.ravel()), rtol=1e-7, atol=1e-9)
    inverse = np.linalg.inv(R)
    np.testing.assert_allclose(fit.covariance, (STEPS - 1) * inverse @ inverse.T, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("ratio", [1.0, 4.0])
def test_other_drives_decide(ratio: float) -> None:
    """A right covariance at 1e-6 (false alarm), and one four times too small, of 40 runs found with certainty."""
    rng = np.random.default_rng()
    record = without_shared(
        drives("by-vector", rng, ratio=ratio), fit_record(drives("by-vector", rng, runs=400), "by-vector"), "by-vector"
    )
    verdict = judge(record, Settings(false_alarm=1e-6))
    assert ("scale" in verdict.faults) == (ratio > 1.0)
    assert not set(verdict.faults) & set(BIAS)


def test_an_estimator_is_matched_by_its_name(rng: np.random.Generator) -> None:
    a, b = (replace(drives("by-vector", rng), name=name) for name in "ab")
    found = less_shared([b, a], [a, b], "by-vector")
    for record, own in zip(found, (b, a), strict=True):
        np.testing.assert_array_equal(
            record.error, without_shared(own, fit_record(own, "by-vector"), "by-vector").error
        )
    with pytest.raises(InputError, match="--shared-from: holds no estimator 'b'; it has a, c"):
        less_shared([a, b], [a, replace(b, name="c")], "by-vector")


def table(path: Path, errors: Array, t: Array, stated: bool) -> str:
    rows, names = [], "run,t,a,b,c"
    upper = P[np.triu_indices(N)]
    names += ",P_a_a,P_a_b,P_a_c,P_b_b,P_b_c,P_c_c" * stated
    for run, each in enumerate(errors):
        for at, e in zip(t, each, strict=True):
            rows.append(",".join(map(repr, [run, float(at), *map(float, e), *(map(float, upper) if stated else ())])))
    path.write_text("\n".join([names, *rows]) + "\n", encoding="utf-8")
    return str(path)


def written(folder: Path, name: str, kind: str, runs: int, seed: int) -> tuple[str, str]:
    record = drives(kind, np.random.default_rng(seed), runs)
    truth = table(folder / f"{name}-truth.csv", 0.0 * record.error, record.t, False)
    return table(folder / f"{name}.csv", -record.error, record.t, True), truth


def test_one_command_with_other_drives(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    est, truth = written(tmp_path, "new", "by-time", 40, 1)
    old, old_truth = written(tmp_path, "old", "by-time", 200, 2)
    options = ["--truth", truth, "--state", "a,b,c", "--shared", "by-time"]
    out, err = consistency(capsys, "analyse", est, *options, "--shared-from", old, "--shared-truth", old_truth)
    assert "errors that all share, fitted to other drives: a 0.5" in " ".join(err.split())
    assert "with the errors that all share taken off, and a floor, as fitted to other drives; a bias is not asked" in (
        " ".join(out.split())
    )
    record = cs.read(est, truth=truth, state=["a", "b", "c"], shared="by-time", shared_from=old, shared_truth=old_truth)
    plain = cs.read(est, truth=truth, state=["a", "b", "c"])
    fit = fit_record(cs.read(old, truth=old_truth, state=["a", "b", "c"]), "by-time")
    np.testing.assert_allclose(record.error, without_shared(plain, fit, "by-time").error)


def test_halves_of_one_log_decide_nothing(tmp_path: Path) -> None:
    """The first half is fitted and the second judged; of several runs the last ones are judged as any others."""
    for runs, kept in ((1, (1, STEPS // 2)), (10, (5, STEPS))):
        est, truth = written(tmp_path, "log", "by-vector", runs, 3)
        [record] = read_recordings(Path(est), Path(truth), state=["a", "b", "c"], shared="by-vector")
        assert record.error.shape[:2] == kept
        assert (record.unshown == ONE_LOG) == (runs == 1)
        plain = cs.read(est, truth=truth, state=["a", "b", "c"])
        first, rest = halves(plain)
        fit = fit_record(first, "by-vector")
        np.testing.assert_allclose(record.error, without_shared(rest, fit, "by-vector").error)
        assert rest.error is not None
        assert first.error is not None
        np.testing.assert_array_equal(np.concatenate([first.error, rest.error], axis=int(runs == 1)), plain.error)
        verdict = cs.judge(record)
        assert runs > 1 or (verdict.status == "undecided" and ONE_LOG in verdict.reasons[0])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"shared": "by-colour"}, "--shared by-colour: must be by-vector, by-time or by-distance"),
        ({"shared_from": Path("x.csv")}, r"--shared-from: needs --shared by-vector\|by-time\|by-distance"),
        ({"shared": "by-vector", "split": "auto"}, "--shared: does not go with --split: pieces of one log all have"),
        ({"shared": "by-vector", "error": "guess"}, "--error guess: does not go with --shared"),
        ({"shared": "by-distance"}, "--shared by-distance: log has no positions"),
        ({"shared": "by-vector", "shared_from": Path("none.csv")}, r"none\.csv: no such file"),
    ],
)
def test_what_does_not_go_together_is_said(options: dict[str, object], said: str, tmp_path: Path) -> None:
    est, truth = written(tmp_path, "log", "by-vector", 4, 4)
    with pytest.raises(cs.InputError, match=said):
        read_recordings(Path(est), Path(truth), state=["a", "b", "c"], **options)  # type: ignore[arg-type]


def test_windows_and_records_that_have_nothing_to_fit() -> None:
    record = drives("by-time", np.random.default_rng())
    windows = Record("est", record.error, record.covariance, window="10 s", t=record.t)
    with pytest.raises(cs.InputError, match="--shared by-time: windows of 10 s are alike; take by-vector"):
        growth(windows, "by-time")
    with pytest.raises(cs.InputError, match="--shared by-time: est has no times"):
        growth(Record("est", record.error, record.covariance, t=np.full(STEPS, np.nan)), "by-time")
    with pytest.raises(cs.InputError, match="needs errors with covariances of all components; est has none"):
        growth(Record("est", nees=np.ones((3, 4)), dof=2), "by-vector")
    two = Record("est", np.ones((1, 4, 2)), np.broadcast_to(np.eye(2), (1, 4, 2, 2)))
    with pytest.raises(cs.InputError, match="est has 2 components, what is shared has 3"):
        without_shared(two, fit_record(record, "by-vector"), "by-vector")
