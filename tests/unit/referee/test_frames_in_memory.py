"""Tables in memory: what is read of them is what is read of the same tables as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import consistency as cs

pd = pytest.importorskip("pandas", reason="needs pandas, which the core does not")

STEPS = 8
OWN = ["run", "t", "a", "b", "P_a_a", "P_a_b", "P_b_b"]


def tables() -> tuple[pd.DataFrame, pd.DataFrame]:
    rng = np.random.default_rng()
    run, t = np.repeat([0, 1], STEPS), np.tile(0.1 * np.arange(STEPS), 2)
    truth = pd.DataFrame({"run": run, "t": t, "a": rng.normal(size=2 * STEPS), "b": rng.normal(size=2 * STEPS)})
    values = np.column_stack([run, t, truth[["a", "b"]] + rng.normal(size=(2 * STEPS, 2))])
    P = np.tile([2.0, 0.5, 1.0], (2 * STEPS, 1))
    return pd.DataFrame(np.column_stack([values, P]), columns=OWN), truth


class Columns:
    """The least that a table has to be."""

    def __init__(self, frame: pd.DataFrame) -> None:
        self.columns, self._frame = tuple(frame.columns), frame

    def __getitem__(self, name: str) -> list[object]:
        return list(self._frame[name])


@pytest.mark.parametrize(
    "wrap", [lambda frame: frame, Columns, lambda frame: frame.sample(frac=1).sort_values(["run", "t"])]
)
def test_a_table_is_read_as_its_file(wrap: type, tmp_path: Path) -> None:
    own, truth = tables()
    own.to_csv(tmp_path / "own.csv", index=False)
    truth.to_csv(tmp_path / "truth.csv", index=False)
    files = cs.read(tmp_path / "own.csv", truth=tmp_path / "truth.csv", state=["a", "b"])
    record = cs.read(wrap(own), truth=wrap(truth), state=["a", "b"])
    np.testing.assert_allclose(record.nees, files.nees, rtol=1e-9)
    e = truth[["a", "b"]].to_numpy() - own[["a", "b"]].to_numpy()
    np.testing.assert_allclose(
        record.nees.ravel(), np.einsum("ni,ni->n", e, np.linalg.solve([[2.0, 0.5], [0.5, 1.0]], e.T).T)
    )
    mixed = cs.read(wrap(own), truth=tmp_path / "truth.csv", state=["a", "b"])
    np.testing.assert_allclose(mixed.nees, files.nees, rtol=1e-9)
    assert record.name == "estimates"


def test_missing_values_and_filters(tmp_path: Path) -> None:
    own, truth = tables()
    own.loc[5, "a"] = np.nan
    assert [(f.run, f.step) for f in cs.read(own, truth=truth, state=["a", "b"]).failures] == [(0, 6)]
    nullable = own.astype({"a": "Float64"})
    assert [(f.run, f.step) for f in cs.read(nullable, truth=truth, state=["a", "b"]).failures] == [(0, 6)]
    mixed = own.astype({"a": object})
    mixed.loc[5, "a"] = pd.NA
    assert [(f.run, f.step) for f in cs.read(mixed, truth=truth, state=["a", "b"]).failures] == [(0, 6)]
    both = pd.concat([own.assign(filter="ekf"), own.assign(filter="ukf")])
    assert cs.read(both, truth=truth, state=["a", "b"], filter="ukf").name == "ukf"
    with pytest.raises(cs.InputError, match=r"^estimates: holds several estimators \(ekf, ukf\)"):
        cs.read(both, truth=truth, state=["a", "b"])
    with pytest.raises(cs.InputError, match=r"^filter 'pf' is not in estimates"):
        cs.read(both, truth=truth, state=["a", "b"], filter="pf")


def test_what_is_wrong_is_named_by_table_and_row(tmp_path: Path) -> None:
    own, truth = tables()
    with pytest.raises(cs.InputError, match=r"^truth: column 'b' is missing"):
        cs.read(own, truth=truth.drop(columns="b"), state=["a", "b"])
    with pytest.raises(cs.InputError, match=r"^estimates, row 3: column 'a': not a number \(east\)"):
        cs.read(own.astype({"a": object}).replace({"a": {own["a"][2]: "east"}}), truth=truth, state=["a", "b"])
    with pytest.raises(cs.InputError, match=r"^estimates: holds no row"):
        cs.read(own[:0], truth=truth, state=["a", "b"])
    with pytest.raises(cs.InputError, match=r"^estimates: column 'a' is there twice"):
        cs.read(own.rename(columns={"b": "a"}), truth=truth, state=["a", "b"])
    with pytest.raises(cs.InputError, match=r"^estimates: needs --truth FILE"):
        cs.read(own, state=["a", "b"])
    with pytest.raises(cs.InputError, match=r"^--covariance: does not go with tables in memory"):
        cs.read(own, truth=truth, covariance="P.txt", state=["a", "b"])


def test_runs_and_steps_the_wrong_way_round_are_named() -> None:
    errors, P = np.random.default_rng().normal(size=(4, 9, 2)), np.broadcast_to(np.eye(2), (9, 4, 2, 2))
    with pytest.raises(cs.InputError, match=r"\(9, 4, 2, 2\), needs \(4, 9, 2, 2\); runs and steps are swapped in one"):
        cs.judge(errors, P)
    with pytest.raises(cs.InputError, match=r"\(3, 9, 2, 2\), needs \(4, 9, 2, 2\)$"):
        cs.judge(errors, np.broadcast_to(np.eye(2), (3, 9, 2, 2)))


def test_a_truth_the_wrong_way_round_is_named(tmp_path: Path) -> None:
    own = np.random.default_rng().normal(size=(4, 9, 2))
    np.savez(
        tmp_path / "a.npz",
        estimates=own,
        truth=np.swapaxes(own, 0, 1),
        covariances=np.broadcast_to(np.eye(2), (4, 9, 2, 2)),
    )
    with pytest.raises(cs.InputError, match=r"'estimates' \(4, 9, 2\); runs and steps are swapped in one"):
        cs.read(tmp_path / "a.npz")
