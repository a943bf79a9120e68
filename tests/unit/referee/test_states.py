"""Poses with a velocity and biases as tables: errors of SE2(3) x R6 by the exponential of 5 x 5 matrices."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from command import consistency
from test_extended import STEPS, states
from test_layouts import ASL, lines, nanoseconds

import consistency as cs
from consistency.referee.types import Array

T = 1403715273.25 + 0.25 * np.arange(STEPS)
POSE = ["x", "y", "z", "qw", "qx", "qy", "qz"]
MOVING = ["vx", "vy", "vz", "bgx", "bgy", "bgz", "bax", "bay", "baz"]
LABELS = ["x", "y", "z", "roll", "pitch", "yaw", *MOVING]
PLACES = [3, 4, 5, 0, 1, 2, *range(6, 15)]  # position first, of the rotation first


def w_first(R: Array) -> Array:
    """Unit quaternions (N, 4) of rotations, by the largest of the four (Shepperd 1978)."""
    out = []
    for M in R:
        squares = np.array([np.trace(M), *np.diag(M)])
        k = int(np.argmax(squares))
        q = np.zeros(4)
        if k == 0:
            q = np.array([1.0 + squares[0], M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])
        else:
            i, j, m = k - 1, k % 3, (k + 1) % 3
            q[0], q[k] = M[m, j] - M[j, m], 1.0 + M[i, i] - M[j, j] - M[m, m]
            q[j + 1], q[m + 1] = M[j, i] + M[i, j], M[m, i] + M[i, m]
        out.append(q / np.sqrt(q @ q))
    return np.array(out)


def columns(arrays: dict[str, Array], true: bool = False) -> list[Array]:
    """Position, quaternion w first, velocity and biases of the first run."""
    side = "true_" if true else ""
    parts = [arrays[f"{side}{key}"][0] for key in ("v", "bg", "ba") if f"{side}{key}" in arrays]
    return [*np.column_stack([arrays[f"{side}p"][0], w_first(arrays[f"{side}R"][0]), *parts]).T]


def euroc(arrays: dict[str, Array]) -> str:
    return lines("data.csv", ASL, [nanoseconds(T), *columns(arrays, true=True)])


def euroc_bare(arrays: dict[str, Array]) -> str:
    return lines("truth.csv", "", [nanoseconds(T), *columns(arrays, true=True)])


def named(arrays: dict[str, Array]) -> str:
    true = columns(arrays, true=True)
    return lines("truth.csv", ",".join(["t", *POSE, *MOVING][: 1 + len(true)]), [T, *true])


def stated(n: int, form: str) -> list[str]:
    """Names of the columns of a covariance."""
    i, j = np.triu_indices(n)
    return {
        "named": [f"P_{LABELS[a]}_{LABELS[b]}" for a, b in zip(i, j, strict=True)],
        "upper": [f"cov{k}" for k in range(len(i))],
        "full": [f"covariance_{k}" for k in range(n * n)],
        "deviations": [f"sigma_{LABELS[a]}" for a in range(n)],
    }[form]


def table(arrays: dict[str, Array], P: Array, form: str) -> str:
    """The first run with covariances (N, n, n) in some form."""
    n, own = P.shape[-1], columns(arrays)
    i, j = np.triu_indices(n)
    numbers = {"full": P.reshape(STEPS, -1), "deviations": np.sqrt(np.diagonal(P, axis1=1, axis2=2))}
    values = numbers.get(form, P[:, i, j])
    return lines("est.csv", ",".join(["t", *POSE, *MOVING[: n - 6], *stated(n, form)]), [T, *own, *values.T])


def nees(e: Array, P: Array) -> Array:
    return np.array([x @ np.linalg.solve(C, x) for x, C in zip(e, P, strict=True)])


@pytest.mark.parametrize(
    ("kind", "form", "n"),
    [
        *((kind, "named", n) for kind in ("left", "right", "additive", "so3-body") for n in (9, 15)),
        *(("right", form, n) for form in ("upper", "full") for n in (9, 15)),
    ],
)
def test_states_in_a_table(kind: str, form: str, n: int, inside: Path) -> None:
    arrays, e, P = states(kind, n)
    e, P = e[0][:, PLACES[:n]], P[0][:, PLACES[:n]][:, :, PLACES[:n]]
    record = cs.read(table(arrays, P, form), truth=named(arrays), error=kind)
    np.testing.assert_allclose(record.error[0], e, atol=1e-9)
    np.testing.assert_allclose(record.nees[0], nees(e, P), rtol=1e-9)
    assert record.axes == tuple(LABELS[:n])
    assert record.convention == kind


@pytest.mark.parametrize("write", [euroc, euroc_bare])
def test_the_truth_of_euroc_has_velocity_and_biases(
    write: object, inside: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the rotation first in the covariance; one command."""
    assert callable(write)
    arrays, e, P = states("left")
    first = table(arrays, P[0], "full")  # the columns have no labels, so that the order is declared
    record = cs.read(first, truth=write(arrays), error="left", covariance_order="rotation-translation")
    np.testing.assert_allclose(record.nees[0], nees(e[0], P[0]), rtol=1e-9)
    _, err = consistency(capsys, "analyse", first, "--truth", write(arrays), "--error", "left")
    assert "error convention left: Log(estimate^-1 truth)" in err


def test_deviations_of_states_are_judged_component_by_component(inside: Path) -> None:
    arrays, e, P = states("so3")
    e, P = e[0][:, PLACES], P[0][:, PLACES][:, :, PLACES]
    record = cs.read(table(arrays, P, "deviations"), truth=named(arrays), error="so3")
    np.testing.assert_allclose(record.nees[0], (e**2 / np.diagonal(P, axis1=1, axis2=2)).sum(axis=1), rtol=1e-9)
    assert record.parts == tuple((i,) for i in range(15))
    assert record.axes == tuple(LABELS)


def test_the_true_velocity_between_two_samples(inside: Path) -> None:
    arrays, _, P = states("so3", 9)
    truth = columns(arrays, true=True)
    late = lines("truth.csv", ",".join(["t", *POSE, *MOVING[:3]]), [100.0 + 0.1 * np.arange(STEPS), *truth])
    P = P[0][:, PLACES[:9]][:, :, PLACES[:9]]
    own = [np.repeat(column[:1], STEPS) for column in columns(arrays)]
    est = lines(
        "est.csv", ",".join(["t", *POSE, *MOVING[:3], *stated(9, "full")]),
        [100.0 + 0.1 * np.arange(STEPS) * (STEPS - 1) / STEPS, *own, *P.reshape(STEPS, -1).T],
    )  # fmt: skip
    record = cs.read(est, truth=late, error="so3")
    share = np.arange(STEPS) * (STEPS - 1) / STEPS
    for i, axis in enumerate("xyz"):
        true = np.interp(share, np.arange(STEPS), truth[7 + i])
        np.testing.assert_allclose(record.error[0, :, record.axes.index(f"v{axis}")], true - own[7 + i], atol=1e-9)


def test_without_a_true_velocity_the_pose_is_judged(inside: Path) -> None:
    arrays, e, P = states("so3")
    e, P = e[0][:, PLACES], P[0][:, PLACES][:, :, PLACES]
    est = table(arrays, P, "named")
    for keep, what in ((0, "velocities"), (3, "biases")):
        less = {key: value for key, value in arrays.items() if keep or key not in ("true_v", "true_bg", "true_ba")}
        less = {key: value for key, value in less.items() if not key.startswith("true_b")}
        record = cs.read(est, truth=named(less), error="so3")
        np.testing.assert_allclose(record.nees[0], nees(e[:, : 6 + keep], P[:, : 6 + keep, : 6 + keep]), rtol=1e-9)
        assert f"truth.csv: holds no {what}, so that those of est.csv are not judged" in record.notes
    aligned = cs.read(est, truth=named(arrays), error="so3", align="posyaw-all")
    assert aligned.axes == tuple(LABELS[:6])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, r"est\.csv: holds a covariance of poses with their velocity, whose error is not known; add --error so3"),
        ({"error": "left", "axes": ["bgx"]}, r"--axes bgx: 'bgx' is not one of x, y, z, roll, pitch, yaw, vx, vy, vz$"),
    ],
)
def test_what_has_to_be_declared(options: dict[str, object], said: str, inside: Path) -> None:
    arrays, _, P = states("left", 9)
    with pytest.raises(cs.InputError, match=said):
        cs.read(table(arrays, P[0], "full"), truth=named(arrays), **options)  # type: ignore[arg-type]


def test_the_additive_error_is_of_states(inside: Path) -> None:
    arrays, _, P = states("left", 9)
    alone: Sequence[Array] = columns(arrays)[:7]
    est = lines(
        "est.csv", ",".join(["t", *POSE, *stated(6, "full")]), [T, *alone, *P[0, :, :6, :6].reshape(STEPS, -1).T]
    )
    with pytest.raises(cs.InputError, match="--error additive: for a trajectory in space it is one of so3, so3-body"):
        cs.read(est, truth=named(arrays), error="additive")
    assert cs.read(est, truth=named(arrays)).axes == tuple(LABELS[:6])
