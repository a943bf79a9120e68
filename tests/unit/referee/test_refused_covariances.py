"""What is said of covariances that cannot be used: no advice that makes things worse."""

import numpy as np
import pytest
from command import consistency, refused
from draws import independent
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.referee.errors import InputError

RUNS, STEPS = 20, 10


def stated(P):
    return np.tile(np.asarray(P, float), (RUNS, STEPS, 1, 1))


@pytest.mark.parametrize(
    "entry, mirror, advice",
    [
        (0.3, 0.300003, "write P = (P + P') / 2"),
        (0.3, 0.299, "write P = (P + P') / 2"),
        (0.3, -0.3, "row 1, column 2 holds 0.3, but row 2, column 1 -0.3"),
        (0.5, 0.0, "row 1, column 2 holds 0.5, but row 2, column 1 0"),
        (0.1, 0.3, "row 1, column 2 holds 0.1, but row 2, column 1 0.3"),
    ],
)
def test_halves_are_averaged_only_where_they_differ_by_rounding(entry, mirror, advice, rng):
    P = stated([[1.0, entry, 0.0], [mirror, 2.0, 0.0], [0.0, 0.0, 3.0]])
    P[..., 0, 2] = P[..., 2, 0] = 0.2  # of both triangles
    with pytest.raises(InputError) as refused:
        cs.judge(independent(rng, RUNS, STEPS, 3), P)
    assert advice in str(refused.value)
    assert ("(P + P')" in str(refused.value)) == ("(P + P')" in advice)


@pytest.mark.parametrize("without", [("x",), ("x", "y"), ("heading",)])
def test_a_variance_of_zero_beside_errors_is_too_small(without, rng):
    names = ("x", "y", "heading")
    missing = [names.index(name) for name in without]
    error = 0.1 * independent(rng, RUNS, STEPS, 3)
    P = stated(np.diag([0.0 if i in missing else 0.01 for i in range(3)]))
    rest = ",".join(name for name in names if name not in without)
    with pytest.raises(InputError) as refused:
        cs.judge(error, P, axes=names)
    size = np.sqrt(np.square(error[..., missing]).mean())
    assert f"errors of {', '.join(without)} are not zero ({size:.2f} RMS)" in str(refused.value)
    assert f"state={rest} for a table, judges the rest alone" in str(refused.value)
    error[..., missing] = 0.0
    with pytest.raises(InputError, match=f"judge only what the filter estimates: axes={rest} "):
        cs.judge(error, P, axes=names)


@pytest.mark.parametrize("members, n", [(10, 40), (5, 9), (20, 20)])
def test_the_rank_of_an_ensemble_is_named(members, n, rng):
    draws = rng.normal(size=(RUNS, STEPS, members, n))
    spread = draws - draws.mean(axis=2, keepdims=True)
    P = np.einsum("rsmi,rsmj->rsij", spread, spread) / (members - 1)
    with pytest.raises(InputError) as refused:
        cs.judge(independent(rng, RUNS, STEPS, n), P)
    assert f"its rank is {members - 1} of {n}. Of an ensemble of {members} members, judge far fewer" in str(
        refused.value
    )


@pytest.mark.parametrize("deviation", [-1.0, -1e-3, -40.0])
def test_a_negative_deviation_is_called_one(deviation, rng):
    sigma = np.ones((RUNS, STEPS, 2))
    sigma[3, 4, 1] = deviation
    verdict = cs.judge(independent(rng, RUNS, STEPS, 2), deviations=sigma)
    assert verdict.failures[0].reason.startswith("a standard deviation is not above 0")


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_diagonal_with_a_negative_number_does_not_hold_deviations(sign, rng, tmp_path, capsys):
    sigma = rng.uniform(0.02, 0.5, (RUNS, STEPS))
    errors = sigma * rng.standard_normal((RUNS, STEPS))
    sigma[3, 4] *= sign
    est, true = ["run,t,x,P_x_x"], ["run,t,x"]
    for run in range(RUNS):
        est += [f"{run},{k},{k + errors[run, k]:.9f},{sigma[run, k]:.9f}" for k in range(STEPS)]
        true += [f"{run},{k},{k}" for k in range(STEPS)]
    (tmp_path / "est.csv").write_text("\n".join(est), encoding="utf-8")
    (tmp_path / "true.csv").write_text("\n".join(true), encoding="utf-8")
    out, _ = consistency(capsys, "analyse", tmp_path / "est.csv", "--truth", tmp_path / "true.csv", "--state", "x")
    assert ("its diagonal holds standard deviations" in out) == (sign > 0)


def write_poses(path, rng, jitter, wander, drives=6, rows=200):
    """Estimates and truth of a camera; errors of each row by itself, and a wander that ends nowhere."""
    for name in ("est", "true"):
        (path / name).mkdir()
    for drive in range(drives):
        est, true = [], []
        off = np.zeros(3)
        for k in range(rows):
            turn = Rotation.from_euler("zyx", [0.02 * k + drive, 0.2 * np.sin(0.05 * k), 0.1])
            place = np.array([0.5 * np.sin(0.03 * k), 0.3 * np.cos(0.02 * k), 1.0 + 0.004 * k])
            off = 0.7 * off + wander * rng.normal(size=3)
            turned = turn * Rotation.from_rotvec(off + jitter * rng.normal(size=3))
            est.append([0.1 * k, *(place - 0.02 * rng.normal(size=3)), *turned.as_quat()])
            true.append([0.1 * k, *place, *turn.as_quat()])
        np.savetxt(path / "est" / f"{drive}.txt", est)
        np.savetxt(path / "true" / f"{drive}.txt", true)


@pytest.mark.parametrize(
    "jitter, wander, said", [(0.01, 0.0, "independent from row to row"), (0.05, 0.0, "independent from row to row"),
                             (0.0, 0.01, "loops are closed"), (0.001, 0.01, "loops are closed")]
)  # fmt: skip
def test_detections_have_no_loops(jitter, wander, said, rng, tmp_path, capsys):
    write_poses(tmp_path, rng, jitter, wander)
    span = "1" if jitter > wander else "10"
    words = (tmp_path / "est", "--truth", tmp_path / "true", "--span", span, "--out", tmp_path / "out")
    err = refused(capsys, "fit-covariance", *words)
    assert said in err
    assert ("loops are closed, or a map is used" in err) == ("loops" in said)
    assert ("consistency correct" in err) == ("independent" in said)
