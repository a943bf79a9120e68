"""``compare``, ``baseline`` and ``report`` on files of another estimator."""

import json

import numpy as np
import pandas as pd
import pytest
from own_process import consistency
from recorded import read_recordings

from consistency.referee.errors import InputError
from consistency.referee.verdicts.compare_sources import baseline

OPTIONS = ("--truth", "truth.csv", "--state", "a,b")
RUNS, STEPS = 24, 15


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Estimates that state their covariance, and the same ones that state a fifth of it; chance of a mix-up < 1e-9."""
    at, rng = tmp_path_factory.mktemp("files"), np.random.default_rng(40321)
    P = np.array([[0.3, 0.1], [0.1, 0.2]])
    truth = rng.normal(0.0, 5.0, (RUNS, STEPS, 2))
    estimates = truth + rng.multivariate_normal(np.zeros(2), P, (RUNS, STEPS))
    frames = {
        "truth": frame(truth), "honest": frame(estimates, P), "proud": frame(estimates, P / 5.0),
        "moved": frame(truth + 1e-9),
    }  # fmt: skip
    for name, table in frames.items():
        table.to_csv(at / f"{name}.csv", index=False)
    return at


def frame(values, P=None):
    run, step = np.mgrid[0:RUNS, 0:STEPS].reshape(2, -1)
    columns = {"run": run, "step": step, **dict(zip("ab", values.reshape(-1, 2).T, strict=True))}
    if P is not None:
        columns |= {"P_a_a": P[0, 0], "P_a_b": P[0, 1], "P_b_b": P[1, 1]}
    return pd.DataFrame(columns)


def test_files_against_each_other(folder):
    done = consistency("compare", "proud.csv", "honest.csv", *OPTIONS, "--fail-on", "worse", cwd=folder, status=1)
    assert f"proud is less consistent than honest: {RUNS} runs, run by run on the same trials" in done.stdout
    assert "RMSE a" in done.stdout
    done = consistency("compare", "honest.csv", "proud.csv", *OPTIONS, "--json", "--fail-on", "worse", cwd=folder)
    (compared,) = json.loads(done.stdout)
    ratios = {each["name"]: each["difference"] for each in compared["differences"]}
    assert ratios["ANEES"] == pytest.approx(0.2)
    assert ratios["RMSE a"] == pytest.approx(1.0)


def test_a_baseline_of_files(folder):
    for name in ("kept.json", "kept"):
        done = consistency("baseline", "honest.csv", *OPTIONS, "--out", name, cwd=folder)
        assert "next: consistency compare NEW" in done.stdout
    done = consistency("compare", "proud.csv", "kept", *OPTIONS, "--fail-on", "worse", cwd=folder, status=1)
    assert "run by run on the same trials" in done.stdout
    done = consistency("compare", "kept.json", "kept", cwd=folder)
    assert "every run is the same in both" in done.stdout
    moved = ("--truth", "moved.csv", "--state", "a,b")
    done = consistency("compare", "proud.csv", "kept.json", *moved, cwd=folder)
    assert "as independent samples" in done.stdout
    assert "Log or truth differ: the trials are not the same" in done.stdout


def test_a_report_of_files(folder):
    done = consistency("report", "proud.csv", *OPTIONS, cwd=folder)
    assert done.stdout.split() == ["proud-report.html", "proud-report.pdf"]
    assert "proud is overconfident" in (folder / "proud-report.html").read_text("utf-8")
    assert (folder / "proud-report.pdf").read_bytes().startswith(b"%PDF")
    consistency("report", "proud.csv", *OPTIONS, "--html", "one.html", cwd=folder)
    assert not (folder / "one.pdf").exists()


@pytest.mark.parametrize(
    "command, said",
    [
        (("compare", "proud.csv", "honest.csv"), "proud.csv: needs --truth FILE"),
        (("baseline", "proud.csv", "--out", "no.json"), "proud.csv: needs --truth FILE"),
        (("compare", "kept.json", *OPTIONS), "--truth: is for files of another estimator, and none is named"),
        (("compare", "proud.csv", "missing.json", *OPTIONS), "missing.json"),
        (("compare", "proud.csv", "honest.csv", *OPTIONS, "--covariance", "P.txt"), "would be read with proud.csv and"),
        (("report", "truth.csv", *OPTIONS, "--html", "x.html", "--pdf", "x.html"), "named for both HTML and PDF"),
        (("report", "missing.csv"), "missing.csv: no such file"),
        (("report", "empty"), "empty: holds no results of 'consistency run', and no trajectories"),
        (("compare", "empty", "empty"), "empty: holds no results of 'consistency run', and no trajectories"),
        (("analyse", "empty"), "empty: holds no results of 'consistency run', and no trajectories"),
    ],
)
def test_what_cannot_be_compared(folder, refused, command, said):
    (folder / "empty").mkdir(exist_ok=True)
    (folder / "kept.json").write_text("{}")
    assert said in refused(folder, *command)


def test_files_without_truth(folder):
    """The NIS alone can be judged, but not compared."""
    table = pd.read_csv(folder / "honest.csv")
    table.assign(nis=1.0, nis_dof=2).to_csv(folder / "nis.csv", index=False)
    with pytest.raises(InputError, match="has no truth of nis; give it with --truth"):
        baseline(read_recordings(folder / "nis.csv", state=["a", "b"]), "nis.csv")


def test_errors_of_different_components(folder):
    consistency("baseline", "honest.csv", *OPTIONS, "--out", "ab.json", "--overwrite", cwd=folder)
    kept = json.loads((folder / "ab.json").read_text())
    kept["filters"]["honest"]["axes"] = ["c", "d"]
    (folder / "cd.json").write_text(json.dumps(kept))
    done = consistency("compare", "ab.json", "cd.json", cwd=folder, status=2)
    assert "honest against honest: their errors have different components, a, b and c, d" in done.stderr
