"""Tables of a sensor from errors of known noise and bias, and images against observations made from their tables."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

import consistency as cs
from consistency.stereo.rendered_images.chain import (
    MISMATCH,
    POINT,
    Biases,
    Chain,
    Growth,
    Stops,
    Tracks,
    bias_map,
    disparity_growth,
    stand,
    track_means,
)
from consistency.stereo.rendered_images.scene import StereoCamera
from consistency.stereo.rendered_images.stages import Spread

NODES = np.array([2.25, 6.0, 10.0, 13.5])
U, V = np.array([-90.0, 0.0, 90.0]), np.array([-90.0, 0.0, 90.0])
FINE = np.array([-100.0, -45.0, 10.0, 65.0, 120.0]), np.array([-90.0, -45.0, 0.0, 45.0, 90.0])
CAMERA = StereoCamera.distorted(0.005)


def tracks_of(truth, z, track):
    zero = np.zeros(len(track), int)
    return Tracks(zero, zero, track, z, truth, truth, zero.astype(float), zero + POINT, zero)


def places(rng, count):
    return np.column_stack([
        rng.uniform(-100, 140, count), rng.uniform(-110, 110, count), rng.uniform(2.25, 13.5, count),
    ])  # fmt: skip


def simulated(rng, growth, biases, sigma, at, n=30):
    """Observations from tables as a scenario holds them: truth, bias at its place, and noise that grows."""
    truth, track = np.repeat(at, n, axis=0), np.repeat(np.arange(len(at)), n)
    noise = rng.standard_normal(truth.shape) * 0.02
    noise[:, 2] *= sigma * growth.table(sigma).ratio_at(truth[:, 2]) / 0.02
    bias = biases.table().at(truth[:, 0], truth[:, 1])
    own = np.repeat(rng.standard_normal((len(at), 3)) * biases.rest, n, axis=0)  # what the place does not tell
    return tracks_of(truth, truth + bias + own + noise, track)


def observed(growth, biases, sigma, at, n=30, seed=0):
    """Observations of landmarks at these places (u, v, d) by a scenario whose truth holds the tables.

    The robot hardly moves. What a table over the place does not tell stays the same along a track.
    """
    x = 13.5 / at[:, 2]
    points = np.column_stack([x, -at[:, 0] * x / 150.0, -at[:, 1] * x / 150.0])
    effects = (
        {"kind": "local-bias", **biases.table().model_dump()},
        {"kind": "track-error", "sigma": biases.rest.tolist(), "correlation": 1.0 - 1e-9},
    )
    world = cs.load_scenario("herath2007-stereo").variant(
        "calibrated",
        summary="a wall before a robot that stands, seen by the sensor of the tables",
        truth__steps=n,
        truth__path={"shape": "circle", "radius": 1.0, "start": (0.0, 0.0), "heading": 0.0, "speed": 1e-9},
        truth__landmarks={"layout": "listed", "points": points.tolist()},
        truth__sensor__sigma=(0.02, 0.02, sigma),
        truth__sensor__range=(0.1, 20.0),
        truth__sensor__disparity_growth=growth.table(sigma).model_dump(),
        truth__sensor__effects=effects,
    )
    trial = cs.simulate(world, seed=seed)
    return tracks_of(at[trial.landmark], trial.z, trial.landmark)


def off(a, b, covariance):
    """p value of a chi-square test that two estimates are of one thing."""
    e = np.ravel(a - b)
    return float(stats.chi2.sf(e @ np.linalg.solve(covariance, e), len(e)))


def known():
    sd, bias = np.array([0.05, 0.08, 0.2, 0.15]), np.random.default_rng(1).normal(size=(3, 3, 3))
    growth = Growth(NODES, sd, np.zeros((4, 4)), 1.0)
    return growth, Biases(U, V, bias, np.zeros((3, 3, 3)), np.zeros((9, 9)), np.full(3, 0.03))


def test_a_known_growth_and_map_are_recovered(rng):
    """400 tracks; each table by a chi-square test (false alarm 1e-6)."""
    growth, biases = known()
    means = track_means(simulated(rng, growth, biases, 0.65, places(rng, 400)))
    found, placed = disparity_growth(means, NODES), bias_map(means, U, V)
    assert off(found.sd, growth.sd, found.covariance) > 1e-6
    assert (found.standard_error < 0.1 * growth.sd).all()
    for k in range(3):
        assert off(placed.bias[..., k], biases.bias[..., k], placed.rest[k] ** 2 * placed.covariance) > 1e-6
    assert_allclose(placed.standard_error[1, 1], placed.rest * np.sqrt(placed.covariance[4, 4]))
    assert placed.standard_error.max() < 0.05
    assert found.spread < 1.6
    assert_allclose(placed.rest[:2], 0.03, rtol=0.3)


def test_standard_errors_are_those_of_repetition(rng):
    """60 repetitions of 150 tracks: mean squared standardised error 1 +- 6 sqrt(2 / 60) for each (below 1e-8)."""
    growth, biases = known()
    scores = []
    for _ in range(60):
        means = track_means(simulated(rng, growth, biases, 0.65, places(rng, 150)))
        found, placed = disparity_growth(means, NODES), bias_map(means, U, V)
        scores.append(
            [
                ((found.sd - growth.sd) / found.standard_error)[2],
                ((placed.bias - biases.bias) / placed.standard_error)[1, 2, 2],
            ]
        )
    assert_allclose(np.square(scores).mean(axis=0), 1.0, atol=6 * np.sqrt(2 / 60))


def test_heavy_tails_widen_the_interval(rng):
    at = places(rng, 300)
    truth, track = np.repeat(at, 30, axis=0), np.repeat(np.arange(300), 30)
    errors = {"gauss": rng.standard_normal(truth.shape), "tails": rng.standard_t(3, truth.shape) / np.sqrt(3)}
    gauss, tails = (disparity_growth(track_means(tracks_of(truth, truth + e, track)), NODES) for e in errors.values())
    assert tails.spread > 2.0 > gauss.spread
    assert (tails.standard_error > 1.3 * gauss.standard_error).all()


def test_means_of_tracks_by_hand():
    truth = np.zeros((5, 3))
    z = np.array([[1.0, 0, 0], [3.0, 0, 0], [5.0, 0, 6], [1.0, 1, 1], [1.0, 1, 1]])
    means = track_means(tracks_of(truth, z, np.array([7, 7, 7, 9, 9])))
    assert means.count.tolist() == [3]
    assert_allclose(means.mean, [[3.0, 0.0, 2.0]])
    assert_allclose(means.variance, [[4.0, 0.0, 12.0]])


def test_both_levels_agree():
    """Tables from images in a scenario make observations whose tables are those of other images.

    Chi-square tests (false alarm 1e-7 each, were all errors Gaussian). One node of the growth moved by two fifths of
    its largest value, or of the map by a half, is told apart.
    """
    pytest.importorskip("cv2")
    stops, nodes = Stops(farthest=3.0, nearest=1.0, step=0.2, images=3), np.array([4.5, 8.0, 13.5])
    first, second = (image_means(seed, stops) for seed in (11, 12))
    growth, biases = disparity_growth(first, nodes), bias_map(first, *FINE)
    other, placed = disparity_growth(second, nodes), bias_map(second, *FINE)
    made = track_means(observed(growth, biases, 0.65, second.truth, 4))
    assert len(made.count) == len(second.count)
    sd, bias = disparity_growth(made, nodes), bias_map(made, *FINE)
    both = other.covariance + growth.covariance
    assert off(other.sd, sd.sd, both + sd.covariance) > 1e-7
    assert off(other.sd + np.array([0.0, 0.0, 0.4 * other.sd.max()]), sd.sd, both + sd.covariance) < 1e-3
    for k in range(3):
        # tables of two sets of images and one of observations, each with its own scatter of tracks
        scatter = (
            biases.rest[k] ** 2 * biases.covariance + (placed.rest[k] ** 2 + bias.rest[k] ** 2) * placed.covariance
        )
        assert off(placed.bias[..., k], bias.bias[..., k], scatter) > 1e-7
        wrong = placed.bias[..., k].copy()
        wrong[2, 1] += 0.5 * np.abs(wrong).max()
        assert off(wrong, bias.bias[..., k], scatter) < 1e-3


def image_means(seed, stops):
    tracks = stand(Chain(Spread(60, 8, 6)), CAMERA, stops, np.random.default_rng(seed), 2).kept
    return track_means(tracks.take(tracks.label != MISMATCH))


def test_the_map_is_that_of_the_cameras():
    """Bias of d at the corners against the exact projections, of tracks and by the map, to 0.15 px."""
    pytest.importorskip("cv2")
    means = image_means(14, Stops(farthest=2.0, nearest=1.0, step=0.1, images=3))
    u, v, d = means.truth.T
    x = 13.5 / d
    points = np.column_stack([x, -u * x / 150, -v * x / 150])
    exact = CAMERA.real(points) - means.truth
    assert np.abs(exact[:, 2]).max() > 0.8
    assert np.sqrt(np.mean(np.square(means.mean - exact), axis=0)).max() < 0.15
    placed = bias_map(means, *FINE)
    assert np.sqrt(np.mean(np.square(placed.table().at(u, v) - exact), axis=0)).max() < 0.15


def test_what_cannot_be_calibrated_is_said(rng):
    growth, biases = known()
    tracks = simulated(rng, growth, biases, 0.65, places(rng, 30))
    means = track_means(tracks)
    with pytest.raises(cs.InputError, match="no track near disparity 40 px; give fewer nodes"):
        disparity_growth(means, np.array([2.0, 20.0, 40.0]))
    with pytest.raises(cs.InputError, match="no track near u = -400, v = 0 px"):
        bias_map(means, np.array([-400.0, -300.0, 0.0]), np.array([0.0]))
    with pytest.raises(cs.InputError, match="do not increase"):
        bias_map(means, np.array([0.0, 0.0]), V)
    with pytest.raises(cs.InputError, match="none has 31 observations"):
        track_means(tracks, 31)
