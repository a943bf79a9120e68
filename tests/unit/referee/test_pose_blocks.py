"""Rotations and blocks of covariances as files hold them, and lines that are read one by one."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.readers.formats.pose_rows import BLOCKS, are_rotations, covariances_in, not_unit, quaternions
from consistency.referee.readers.formats.text_blocks import Lines, read_rows


def test_a_reflection_and_what_is_not_finite_are_no_rotations():
    R = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    rounded = np.round(R, 6)
    matrices = np.array([R, R @ np.diag([1.0, 1.0, -1.0]), 1.01 * R, np.full((3, 3), np.nan), np.eye(3), rounded])
    assert are_rotations(matrices).tolist() == [True, False, False, False, True, True]
    assert bool(are_rotations(R))


def test_quaternions_of_finite_matrices():
    turn = Rotation.from_rotvec([0.3, -0.2, 0.9])
    both = quaternions(np.array([[turn.as_matrix(), np.full((3, 3), np.nan)]]))
    assert both.shape == (1, 2, 4)
    assert_allclose(Rotation.from_quat(both[0, 0]).as_rotvec(), turn.as_rotvec())
    assert np.isnan(both[0, 1]).all()
    assert quaternions(np.empty((0, 3, 3))).shape == (0, 4)


def test_quaternions_of_another_length():
    pose = np.array([[0.0, 0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 0, 0, 1.1], [np.nan, 0, 0, 0, 0, 0, 2]])
    bad, length = not_unit(pose)
    assert bad.tolist() == [False, True, False]
    assert_allclose(length, [1.0, 1.1, 2.0])


@pytest.mark.parametrize("form", ["matrix", "triangle", "deviations"])
@pytest.mark.parametrize("order", ["translation-rotation", "rotation-translation", "v,R,p,ba,bg", "bg,ba,p,R,v"])
def test_covariances_of_blocks_in_any_order(form, order):
    """Each entry stands where the names of its two components say."""
    written = {"translation-rotation": "p,R,v,bg,ba", "rotation-translation": "R,p,v,bg,ba"}.get(order, order)
    blocks = written.split(",")
    names = [f"{block}{i}" for block in blocks for i in range(3)]
    wanted = [f"{block}{i}" for block in BLOCKS for i in range(3)]
    value = {name: 1.0 + k for k, name in enumerate(wanted)}
    P = np.array([[value[a] * value[b] for b in names] for a in names])
    expected = np.array([[value[a] * value[b] for b in wanted] for a in wanted])
    numbers = {"matrix": P.ravel(), "triangle": P[np.triu_indices(15)], "deviations": np.sqrt(np.diag(P))}[form]
    if form == "deviations":
        expected = np.diag(np.diag(expected))
    values = np.concatenate([[0.0], np.zeros(7), numbers])[None]
    found = covariances_in(Lines(Path("a"), values, np.array([1])), order)
    assert_allclose(found[0], expected)


def test_two_triangles_are_of_rotation_and_position():
    values = np.arange(20.0)[None]
    P = covariances_in(Lines(Path("a"), values, np.array([1])), "translation-rotation")[0]
    assert_array_equal(P[3:, 3:], [[8, 9, 10], [9, 11, 12], [10, 12, 13]])
    assert_array_equal(P[:3, :3], [[14, 15, 16], [15, 17, 18], [16, 18, 19]])
    assert not P[:3, 3:].any()
    assert not P[3:, :3].any()


@pytest.mark.parametrize(
    "text, rows, cut",
    [
        ("1 2\n2 3\n3 4", 3, False), ("1 2\n2 3\n3", 2, True), ("1 2\n2 3\n3 4x", 2, True), ("1 2\n2 3\n# 3", 2, False),
    ],
)  # fmt: skip
def test_a_last_line_without_an_end_is_left_out_if_it_is_unlike_the_others(text, rows, cut, tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(text)
    lines = read_rows(path, (2,), "two numbers")
    assert len(lines.t) == rows
    assert bool(lines.cut) == cut
    assert bool(lines.open_end()) == (rows == 3)


def test_a_first_line_of_words_is_named(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("t,x\n1,2\n")
    with pytest.raises(InputError, match=r"a\.txt, line 1: not a number in 't,x'; should be two numbers"):
        read_rows(path, (2,), "two numbers")
