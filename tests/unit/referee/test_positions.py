"""A truth of positions alone: the position of a point of the body, with its covariance, in every convention."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command import consistency, refused
from test_layouts import POSE, SPACE, STEPS, Drive, drive, lines, matrix, nanoseconds, product, skew, tum

import consistency as cs
from consistency.referee.readers.formats.position_truth import _jacobian
from consistency.referee.types import Array

ARM = np.array([0.3, -0.2, 0.5])
SMALL = 1e-6


def exponential(v: Array) -> Array:
    """Quaternion x, y, z, w of a rotation vector."""
    angle = np.sqrt(v @ v)
    return np.append(v * (np.sin(angle / 2) / angle if angle > 0 else 0.5), np.cos(angle / 2))


def group(xi: Array) -> tuple[Array, Array]:
    """Rotation and translation of the exponential of SE(3): Sola et al. (2018), eq. 172."""
    v, angle = xi[3:], np.sqrt(xi[3:] @ xi[3:])
    W = skew(v)
    if angle < 1e-12:
        return np.eye(3) + W, xi[:3]
    V = np.eye(3) + (1 - np.cos(angle)) / angle**2 * W + (angle - np.sin(angle)) / angle**3 * W @ W
    return matrix(exponential(v)), V @ xi[:3]


def moved(convention: str, pose: Array, e: Array) -> Array:
    """Position of the point of the true pose, whose error is ``e`` in a convention."""
    R, p = matrix(pose[3:]), pose[:3]
    if convention == "so3":
        return p + e[:3] + matrix(exponential(e[3:])) @ R @ ARM
    if convention == "so3-body":
        return p + e[:3] + R @ matrix(exponential(e[3:])) @ ARM
    turn, shift = group(e)
    if convention == "left":
        return R @ (turn @ ARM + shift) + p
    return turn @ (R @ ARM + p) + shift


@pytest.mark.parametrize("convention", ["so3", "so3-body", "left", "right"])
def test_derivatives_are_those_of_differences(convention: str) -> None:
    d = drive()
    R = np.array([matrix(q) for q in d.own[:, 3:]])
    J = _jacobian(convention, R, ARM, d.own[:, :3] + R @ ARM)
    for pose, rows in zip(d.own, J, strict=True):
        for i, side in enumerate(SMALL * np.eye(6)):
            slope = (moved(convention, pose, side) - moved(convention, pose, -side)) / (2 * SMALL)
            np.testing.assert_allclose(rows[:, i], slope, atol=1e-8)


def bare(d: Drive, point: Array) -> str:
    return lines("prism.txt", "", [d.t, *point.T], " ")


@pytest.mark.parametrize(
    "write",
    [
        lambda d, point: lines("data.csv", "#timestamp [ns]," + ",".join(POSE[:3]), [nanoseconds(d.t), *point.T]),
        bare,
        lambda d, point: lines("fixes.csv", "t,x,y,z,fix", [d.t, *point.T, ["RTK"] * STEPS]),
    ],
    ids=["Leica", "bare", "GNSS"],
)
def test_the_point_of_a_prism(
    write: Callable[[Drive, Array], str],
    inside: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    d = drive()
    R, true = (np.array([matrix(q) for q in pose[:, 3:]]) for pose in (d.own, d.true))
    truth = write(d, d.true[:, :3] + true @ ARM)
    record = cs.read(tum(d), truth=truth, lever_arm=ARM.tolist())
    e = d.true[:, :3] + true @ ARM - d.own[:, :3] - R @ ARM
    J = np.concatenate([np.tile(np.eye(3), (STEPS, 1, 1)), [-skew(each @ ARM) for each in R]], axis=2)
    P = J @ d.P @ np.swapaxes(J, 1, 2)
    nees = [each @ np.linalg.solve(C, each) for each, C in zip(e, P, strict=True)]
    np.testing.assert_allclose(record.nees[0], nees, rtol=1e-9)
    assert record.axes == ("x", "y", "z")
    _, err = consistency(capsys, "analyse", "est.tum", "--truth", truth, "--lever-arm", "0.3,-0.2,0.5")
    assert "the truth has no orientation, so that the position alone is judged, of the point (0.3, -0.2, 0.5) m" in err
    assert "no orientation" in err or "without orientations" in err


def test_the_origin_needs_no_rotation(inside: Path) -> None:
    """Deviations alone do for it, and so do two blocks; a lever arm would need their cross terms."""
    d = drive()
    truth = bare(d, d.true[:, :3])
    sigma = np.sqrt(np.diagonal(d.P, axis1=1, axis2=2))
    own = lines("est.txt", "", [d.t, *d.own.T, *sigma.T], " ")
    record = cs.read(own, truth=truth)
    assert record.parts == ((0,), (1,), (2,))
    np.testing.assert_allclose(
        record.nees[0], ((d.true - d.own)[:, :3] ** 2 / sigma[:, :3] ** 2).sum(axis=1), rtol=1e-9
    )
    with pytest.raises(cs.InputError, match=r"est\.txt, line 1: --lever-arm moves errors of the rotation.*not stated"):
        cs.read(own, truth=truth, lever_arm=[0.0, 0.0, 0.1])
    upper = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    split = [d.P[:, 3 + i, 3 + j] for i, j in upper] + [d.P[:, i, j] for i, j in upper]
    blocks = lines("blocks.txt", "", [d.t, *d.own.T, *split], " ")
    e, C = (d.true - d.own)[:, :3], d.P[:, :3, :3]
    nees = [each @ np.linalg.solve(P, each) for each, P in zip(e, C, strict=True)]
    np.testing.assert_allclose(cs.read(blocks, truth=truth).nees[0], nees, rtol=1e-9)
    with pytest.raises(cs.InputError, match="--error right moves errors"):
        cs.read(blocks, truth=truth, error="right")


def test_a_broken_estimate_fails_there(inside: Path) -> None:
    d = drive()
    truth = bare(d, d.true[:, :3])
    d.own[5] = np.nan
    record = cs.read(tum(d), truth=truth, lever_arm=ARM.tolist())
    assert [failure.step for failure in record.failures] == [6]


def test_a_frame_is_fitted_to_positions(inside: Path) -> None:
    """Estimates in a world that is turned about z and shifted: the same errors, to what the fit takes of them."""
    d = drive()
    P = 1e-10 * d.P  # as good as no errors, so that the frame is the one put in
    own = np.column_stack([d.true[:, :3] - 1e-5 * (d.true - d.own)[:, :3], d.true[:, 3:]])
    turn, shift = exponential(np.array([0.0, 0.0, 0.8])), np.array([3.0, -4.0, 5.0])
    away = np.array([[*(matrix(turn) @ pose[:3] + shift), *product(turn, pose[3:])] for pose in own])
    C = np.kron(np.eye(2), matrix(turn))
    truth = bare(d, d.true[:, :3])
    record = cs.read(tum(Drive(d.t, away, d.true, C @ P @ C.T)), truth=truth, align="posyaw-all")
    straight = cs.read(tum(Drive(d.t, own, d.true, P)), truth=truth)
    assert record.align == "posyaw-all"
    assert record.nees.sum() < straight.nees.sum() * (1 + 1e-6)
    np.testing.assert_allclose(record.error[0], straight.error[0], atol=5e-5)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"align": "se3-all"}, r"--align se3-all: needs a truth with orientations; prism\.txt"),
        ({"align": "origin"}, r"--align origin: needs a truth with orientations; prism\.txt holds positions alone"),
        ({"relative": 2, "motions": True}, r"--relative: needs a truth with orientations; prism\.txt"),
        ({"axes": ["x", "yaw"]}, "--axes x,yaw: 'yaw' has no truth"),
        ({"lever_arm": [1.0, 2.0]}, "--lever-arm: must be three numbers x,y,z, in m"),
        ({"lever_arm": [1.0, 2.0, float("nan")]}, "--lever-arm: must be three numbers x,y,z, in m"),
    ],
)
def test_what_needs_an_orientation_is_refused(options: dict[str, object], said: str, inside: Path) -> None:
    d = drive()
    bare(d, d.true[:, :3])
    with pytest.raises(cs.InputError, match=said):
        cs.read(tum(d), truth="prism.txt", **options)  # type: ignore[arg-type]


def test_positions_are_no_estimates_and_poses_need_no_arm(inside: Path, capsys: pytest.CaptureFixture[str]) -> None:
    d = drive()
    lines("truth.txt", "", [d.t, *d.true.T], " ")
    with pytest.raises(cs.InputError, match=r"prism\.txt, line 1: has 4 columns"):
        cs.read(bare(d, d.true[:, :3]), truth="truth.txt")
    with pytest.raises(
        cs.InputError, match=r"fixes\.txt: holds no quaternion; a table of a state is read with --state"
    ):
        cs.read(lines("fixes.txt", "# t x y z", [d.t, *d.true[:, :3].T], " "), truth="truth.txt")
    with pytest.raises(cs.InputError, match="--lever-arm: goes with a truth of positions alone"):
        cs.read(tum(d), truth="truth.txt", lever_arm=[0.0, 0.0, 1.0])
    for text in ("1,2", "a,b,c", "1,2,inf"):
        err = refused(capsys, "analyse", "est.tum", "--truth", "truth.txt", "--lever-arm", text)
        assert "--lever-arm: must be three numbers x,y,z, in m" in err


def test_axes_of_a_product() -> None:
    """The helpers above agree with each other: a half turn about z."""
    assert np.allclose(
        matrix(product(np.array([0.0, 0.0, 1.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))) @ ARM, [-0.3, 0.2, 0.5]
    )
    assert SPACE == ["x", "y", "z"]
