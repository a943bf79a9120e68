"""Matching on descriptors made by hand: mutual, ratio, epipolar gate, and the circle."""

import sys

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import consistency as cs
from consistency.referee.geometry import rotation
from consistency.stereo.visual_odometry.features import (
    Features,
    StereoFeatures,
    circular_matches,
    epipolar_gate,
    grey,
    is_rectified,
    mutual_matches,
    opencv,
    stereo_matches,
)
from consistency.vision import StereoRig

K = np.array([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
RECTIFIED = StereoRig(K, K, np.eye(3), np.array([0.5, 0.0, 0.0]), (1200, 360))
TURNED = StereoRig(
    K, 1.1 * K + np.diag([0, 0, -0.1]), rotation(0.04, 0.016, 0.014), np.array([0.4, 0.01, 0.02]), (1200, 360)
)


def unit(rng, count):
    values = rng.normal(size=(count, 128)).astype(np.float32)
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def features(uv, descriptors):
    return Features(uv, np.ones(len(uv)), descriptors)


def points(rng, count):
    return np.column_stack([rng.uniform(-3, 3, count), rng.uniform(-1, 1, count), rng.uniform(6, 40, count)])


def test_matches_are_each_others_nearest_and_unambiguous(rng):
    first = unit(rng, 6)
    order = rng.permutation(6)
    second = first[order]
    assert_array_equal(mutual_matches(first, second), np.column_stack([np.arange(6), np.argsort(order)]))
    twice = np.concatenate([second, second[:1]])  # the nearest has an equal rival: ratio test
    assert order[0] not in mutual_matches(first, twice)[:, 0]
    both = np.concatenate([first, first[:1]])  # two of the first would take the same one
    assert not {0, 6} & set(mutual_matches(both, second)[:, 0])
    assert mutual_matches(first, second[:0]).shape == (0, 2)


def test_what_is_not_allowed_is_no_match_and_no_rival(rng):
    first = unit(rng, 3)
    second = np.concatenate([first, first])
    allowed = np.tile(np.eye(3, dtype=bool), 2)
    assert len(mutual_matches(first, second)) == 0
    assert len(mutual_matches(first, second, allowed)) == 0  # the copies are allowed too
    allowed[:, 3:] = False
    assert_array_equal(mutual_matches(first, second, allowed), [[0, 0], [1, 1], [2, 2]])
    assert len(mutual_matches(first, second, np.zeros_like(allowed))) == 0


@pytest.mark.parametrize("rig", [RECTIFIED, TURNED])
def test_a_point_lies_on_its_epipolar_line_and_another_one_does_not(rig, rng):
    uv = rig.project(points(rng, 50))
    assert np.diag(epipolar_gate(rig, uv[:, :2], uv[:, 2:], 1e-2)).all()
    below = uv[:, 2:] + [0.0, 5.0]
    assert not np.diag(epipolar_gate(rig, uv[:, :2], below, 2.0)).any()


def test_in_rectified_images_the_right_column_is_not_greater():
    left = np.array([[100.0, 50.0]])
    right = np.array([[90.0, 50.0], [101.0, 50.0], [103.0, 50.0]])
    assert_array_equal(epipolar_gate(RECTIFIED, left, right, 2.0), [[True, True, False]])


def test_what_counts_as_rectified():
    assert is_rectified(RECTIFIED)
    assert not is_rectified(TURNED)
    tilted = StereoRig(K, K, np.eye(3), np.array([0.5, 0.01, 0.0]), (1200, 360))
    assert not is_rectified(tilted)
    assert is_rectified(
        StereoRig(K, K, np.eye(3), np.array([0.54, 0.003, 0.001]), (1200, 360))
    )  # KITTI's colour cameras


def test_bands_of_rows_change_nothing(rng):
    uv = RECTIFIED.project(points(rng, 800)) + rng.normal(0, 0.4, (800, 4))
    one = unit(rng, 800)
    other = one + rng.normal(0, 0.1, one.shape).astype(np.float32)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    left, right = features(uv[:, :2], one), features(uv[:, 2:], other)
    whole = mutual_matches(one, other, epipolar_gate(RECTIFIED, left.uv, right.uv))
    assert len(whole) > 500
    assert_array_equal(stereo_matches(RECTIFIED, left, right).pairs, whole)


def test_a_rival_on_the_other_side_of_a_band_is_seen(rng):
    """Row 31.5 has the better match of the right feature; row 32.5, of the next band, must not take it."""
    one = unit(rng, 1)
    worse = one + 0.03 * unit(rng, 1)
    left = features(np.array([[600.0, 31.5], [600.0, 32.5]]), np.concatenate([one, worse / np.linalg.norm(worse)]))
    right = features(np.array([[590.0, 32.2]]), one)
    assert_array_equal(stereo_matches(RECTIFIED, left, right).pairs, [[0, 0]])


def test_a_circle_must_close(rng):
    descriptors = unit(rng, 20)
    uv = np.zeros((20, 2))
    same = features(uv, descriptors)
    pairs = np.column_stack([np.arange(20)] * 2)
    before = StereoFeatures(RECTIFIED, same, same, pairs)
    order = rng.permutation(20)
    after = StereoFeatures(RECTIFIED, features(uv, descriptors[order]), features(uv, descriptors[order]), pairs)
    closed = circular_matches(before, after)
    assert_array_equal(closed, np.column_stack([np.arange(20), np.argsort(order)]))
    crossed = StereoFeatures(
        RECTIFIED, after.left, after.right, np.column_stack([np.arange(20), np.roll(np.arange(20), 1)])
    )
    assert len(circular_matches(before, crossed)) == 0
    none = StereoFeatures(RECTIFIED, same, same, pairs[:0])
    assert circular_matches(before, none).shape == circular_matches(none, before).shape == (0, 2)


def test_images_of_any_kind_become_grey():
    colour = np.zeros((4, 5, 3), np.uint8)
    colour[..., 1] = 200
    assert grey(colour).dtype == np.uint8
    assert grey(colour)[0, 0] == round(0.587 * 200)
    assert grey(np.full((4, 5), 65535, np.uint16))[0, 0] == 255
    assert grey(np.full((4, 5), 300.0))[0, 0] == 255
    for wrong, said in (
        (np.zeros((2, 2, 2)), "shape"),
        (np.zeros((0, 3)), "not an image"),
        (np.array([["a"]]), "not an image"),
        (np.full((2, 2), np.nan), "finite"),
    ):
        with pytest.raises(cs.InputError, match=said):
            grey(wrong, "my image")


def test_without_opencv_one_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(cs.InputError, match="an image needs opencv-python-headless: pip install "):
        opencv()
