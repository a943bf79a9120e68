"""--independent: rows of files of every kind are runs of one step, which fail, group and are doubted one by one."""

import numpy as np
import pytest
from command import consistency, refused

import consistency as cs
from consistency.referee.readers.options import make_reading
from consistency.referee.readers.pipeline.read_files import read_recordings

N = 120
SIGMA = np.array([0.1, 0.3])


def write_table(folder, errors, sigma=SIGMA, extra=None):
    """Estimates of two states with their variances, and the truth, by time."""
    t = 0.5 * np.arange(len(errors))
    true = np.column_stack([np.sin(t), 0.1 * t])
    own = ["t,a,b,P_a_a,P_a_b,P_b_b" + ("" if extra is None else ",kind")]
    for k, row in enumerate(true - errors):
        cells = [t[k], *row, sigma[0] ** 2, 0.0, sigma[1] ** 2, *([] if extra is None else [extra[k]])]
        own.append(",".join(map(str, cells)))
    (folder / "est.csv").write_text("\n".join(own) + "\n")
    np.savetxt(
        folder / "truth.csv", np.column_stack([t, true]), delimiter=",", header="t,a,b", comments="", fmt="%.17g"
    )
    return folder / "est.csv", ["--truth", folder / "truth.csv", "--state", "a,b"]


def read(folder, **options):
    return cs.read(folder / "est.csv", truth=folder / "truth.csv", state=["a", "b"], independent=True, **options)


def errors_of(seed, rows=N):
    return SIGMA * np.random.default_rng(seed).normal(size=(rows, 2))


def test_rows_of_a_table_are_the_runs_of_arrays(tmp_path, capsys):
    errors = errors_of(1)
    path, options = write_table(tmp_path, errors)
    of_file = cs.judge(read(tmp_path))
    of_arrays = cs.judge(errors, np.broadcast_to(np.diag(SIGMA**2), (N, 2, 2)), independent=True)
    assert (of_file.runs, of_file.steps, of_file.unit) == (N, 1, "row")
    assert of_file.status == of_arrays.status
    assert of_file.scale.inflation == pytest.approx(of_arrays.scale.inflation, rel=1e-6)
    assert of_arrays.unit == "row"
    out, err = consistency(capsys, "analyse", path, *options, "--independent")
    assert f"in {N} rows" in out or f"{N} rows do not show" in out
    assert "errors of different rows are declared to be independent" in err


def test_steps_of_runs_are_rows_of_arrays_too():
    errors = errors_of(2).reshape(4, 30, 2)
    P = np.broadcast_to(np.diag(SIGMA**2), (4, 30, 2, 2))
    whole = cs.judge(errors, P, independent=True)
    flat = cs.judge(errors.reshape(-1, 2), P.reshape(-1, 2, 2), independent=True)
    assert (whole.runs, whole.reasons) == (N, flat.reasons)
    of_deviations = cs.judge(errors, deviations=np.broadcast_to(SIGMA, errors.shape), independent=True)
    assert (of_deviations.runs, sorted(of_deviations.parts)) == (N, ["axis 0", "axis 1"])


def test_a_broken_row_fails_alone(tmp_path, capsys):
    errors = errors_of(3)
    errors[[7, 70]] = np.nan
    path, options = write_table(tmp_path, errors)
    record = read(tmp_path)
    assert [(f.run, f.step) for f in record.failures] == [(8, 1), (71, 1)]
    assert "line 9" in record.failures[0].reason
    assert np.isfinite(record.errors.nees).sum() == N - 2
    assert len(record.run_numbers) == N
    out, _ = consistency(capsys, "analyse", path, *options, "--independent")
    assert f"2 of {N} rows failed, first row 8: estimate is not finite" in out
    alone = cs.read(path, truth=tmp_path / "truth.csv", state=["a", "b"])
    assert np.isfinite(alone.errors.nees).sum() == 7  # a run ends there


def test_a_covariance_that_is_none_fails_its_row_and_singular_ones_are_refused(tmp_path, capsys):
    path, options = write_table(tmp_path, errors_of(4))
    lines = path.read_text().splitlines()
    cells = lines[1].split(",")
    lines[1] = ",".join([*cells[:5], "-1.0"])  # the first row, which is no start known exactly
    path.write_text("\n".join(lines) + "\n")
    (failure,) = read(tmp_path).failures
    assert (failure.run, failure.reason) == (1, f"covariance is not positive definite ({path}, line 2)")
    path.write_text("\n".join([lines[0], *(line.rsplit(",", 1)[0] + ",0.0" for line in lines[1:])]) + "\n")
    assert "singular in every step" in refused(capsys, "analyse", path, *options, "--independent")


def test_archives_have_rows(tmp_path):
    errors = errors_of(5)
    covariances = np.broadcast_to(np.diag(SIGMA**2), (N, 2, 2))
    np.savez(tmp_path / "rows.npz", errors=errors, covariances=covariances)
    assert cs.judge(tmp_path / "rows.npz", independent=True).runs == N
    assert cs.judge(tmp_path / "rows.npz").runs == 1
    nees = np.square(errors / SIGMA).sum(axis=1)
    nees[[0, 5]] = np.nan  # the first row is no start known exactly, either
    np.savez(tmp_path / "nees.npz", nees=nees[None], dof=2)
    verdict = cs.judge(tmp_path / "nees.npz", independent=True)
    assert (verdict.runs, [f.run for f in verdict.failures]) == (N, [1, 6])
    assert "2 of 120 rows failed, first row 1: NEES is not finite" in " ".join(verdict.reasons)


def test_rows_keep_what_stands_beside_them(tmp_path):
    errors = errors_of(6)
    kinds = np.where(np.arange(N) % 2, "dark", "light")
    errors[1::2] *= 4.0
    write_table(tmp_path, errors, extra=kinds)
    record = read(tmp_path, by="kind")
    assert record.runs.by.shape == record.errors.nees.shape == record.groups.index.shape == (N, 1)
    ratios = {each.name: each.ratio.value for each in cs.judge(record).by_group.groups}
    assert ratios["kind is dark"] == pytest.approx(16.0, rel=0.5)
    assert ratios["kind is light"] == pytest.approx(1.0, rel=0.5)


def test_innovations_of_rows_are_runs(tmp_path, capsys):
    nis = np.random.default_rng(7).chisquare(2, 60)
    rows = "\n".join(f"{k + 1},{v!r},2" for k, v in enumerate(nis.tolist()))
    (tmp_path / "nis.csv").write_text(f"step,nis,nis_dof\n{rows}\n")
    (record,) = read_recordings(tmp_path / "nis.csv", make_reading(independent=True))
    assert (record.innovations.nis.shape, record.innovations.nis_dof.shape, record.runs.unit) == (
        (60, 1),
        (60, 1),
        "row",
    )
    assert record.innovations.nis[:, 0] == pytest.approx(nis)


def test_rows_paired_by_a_name_are_runs_either_way(tmp_path):
    (tmp_path / "est.csv").write_text("image,a,sigma_a\nq.jpg,1.1,0.1\np.jpg,2.2,0.1\n")
    (tmp_path / "truth.csv").write_text("image,a\np.jpg,2.1\nq.jpg,1.0\n")
    for independent, unit in ((False, "run"), (True, "row")):
        record = cs.read(tmp_path / "est.csv", truth=tmp_path / "truth.csv", state=["a"], independent=independent)
        assert (record.runs.unit, record.errors.error.shape) == (unit, (2, 1, 1))
        assert record.errors.error.ravel() == pytest.approx([-0.1, -0.1])


def test_rows_that_seem_to_depend_on_each_other_are_doubted(tmp_path, capsys):
    """AR(0.95): by chance not doubted less than once in a million."""
    rng = np.random.default_rng(8)
    w = rng.normal(size=(400, 2))
    for k in range(1, 400):
        w[k] = 0.95 * w[k - 1] + np.sqrt(1 - 0.95**2) * w[k]
    path, options = write_table(tmp_path, SIGMA * w)
    out, err = consistency(capsys, "analyse", path, *options, "--independent")
    assert "the rows do not seem to be independent, on which this rests" in out
    assert "errors of neighbouring rows" in err
    assert "longer than a row" in err
    assert "for independent rows only" in err
    P = np.broadcast_to(np.diag(SIGMA**2), (400, 2, 2))
    assert "do not seem to be independent" in cs.judge(SIGMA * w, P, independent=True).reasons[0]


def test_windows_are_rows_by_the_other_option(tmp_path):
    """--independent with --relative is --windows independent: here of poses with cross-covariances."""
    n, sigma = 40, np.array([0.02, 0.01, 0.004])
    truth = np.column_stack([0.5 * np.arange(n), np.zeros(n), np.zeros(n)])
    P = np.broadcast_to(np.diag(sigma**2), (n, 3, 3))
    estimates = truth + sigma * np.random.default_rng(9).normal(size=(n, 3))
    np.savez(tmp_path / "m.npz", estimates=estimates, truth=truth, covariances=P, cross_covariances=0.0 * P)
    one, other, neither = (
        cs.judge(cs.read(tmp_path / "m.npz", relative=1, **how))
        for how in ({"windows": "independent"}, {"independent": True}, {})
    )
    assert one.reasons == other.reasons
    assert (other.unit, other.runs, neither.runs) == ("window", n - 1, 1)


@pytest.mark.parametrize(
    "words, message",
    [
        (["--split", "20"], "--split: does not go with --independent"),
        (["--align", "origin"], "--independent: does not go with --align origin"),
        (["--skip", "3"], "--skip 3: nothing of est is left"),
    ],
)
def test_what_does_not_go_with_rows_is_refused(words, message, tmp_path, capsys):
    path, options = write_table(tmp_path, errors_of(10, 5))
    assert message in refused(capsys, "analyse", path, *options, "--independent", *words)


def test_a_record_has_its_runs_already(tmp_path):
    write_table(tmp_path, errors_of(11))
    with pytest.raises(cs.InputError, match=r"independent: .*consistency\.read"):
        cs.judge(read(tmp_path), independent=True)


def test_a_log_without_memory_is_told_that_rows_may_be_runs(tmp_path):
    write_table(tmp_path, errors_of(12, 400))
    log = cs.judge(cs.read(tmp_path / "est.csv", truth=tmp_path / "truth.csv", state=["a", "b"]))
    assert log.status == "undecided"
    assert "--independent makes each a run" in " ".join([*log.reasons, *log.details])


def test_reports_speak_of_rows(tmp_path, capsys):
    path, options = write_table(tmp_path, errors_of(13, 40))
    consistency(capsys, "analyse", path, *options, "--independent", "--report", tmp_path / "page")
    (page,) = (tmp_path / "page").glob("*.html")
    text = page.read_text()
    assert "40 rows, each of which counts as a run" in text
    assert "Rows count as runs of one step here" in text
    assert "Windows of a log" not in text
