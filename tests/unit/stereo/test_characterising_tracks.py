"""Noise about landmarks and boards that are fitted: beside dense least squares, and beside what was simulated.

Random tests have levels of 1e-7 an interval, so that one of them fails by chance in less than one of a million runs.
"""

import numpy as np
import pytest
from scipy import optimize
from scipy.spatial.transform import Rotation

from consistency.bench.scenario import Mount, PicturedSensor, models
from consistency.bench.simulation import simulate
from consistency.referee.errors import InputError
from consistency.stereo.characterising.boards import (
    BoardCalibration,
    Corners,
    calibrate,
    find_corners,
    residuals_about_boards,
)
from consistency.stereo.characterising.point_fit import (
    HIDDEN,
    Sightings,
    characterise_posed,
    correlations,
    fit_points,
    log_interval,
    without_gross,
)
from consistency.stereo.characterising.sources import seen_of as seen_of_log

F, B = 400.0, 0.1
SIGMA = np.array([0.5, 0.8, 0.3])
SENSOR = PicturedSensor(model="uvd", sigma=(1.0, 1.0, 1.0), f=F, B=B)
LEVEL = 1e-7


def seen_of(rng, tracks, length, rho=0.0):
    """A sensor that moves towards points 4 to 8 m ahead."""
    points = rng.uniform((4, -1.5, -1), (8, 1.5, 1), (tracks, 3))
    k = np.tile(np.arange(length), tracks)
    turn = Rotation.from_euler("zyx", np.column_stack([0.02 * k, 0.01 * k, 0.0 * k]))
    t = np.column_stack([0.08 * k, 0.03 * k, 0.01 * k])
    R = turn.as_matrix()
    track = np.repeat(np.arange(tracks), length)
    x, y, z = np.einsum("nji,nj->in", R, points[track] - t)
    e = rng.standard_normal((tracks, length, 3))
    for i in range(1, length):
        e[:, i] = rho * e[:, i - 1] + np.sqrt(1 - rho**2) * e[:, i]
    values = np.stack(models.project(x, y, z, F, B), axis=-1) + e.reshape(-1, 3) * SIGMA
    return Sightings(values, R, t, track, k, np.ones(len(k), bool))


def parts(seen):
    return np.tile(np.arange(3), (len(seen.z), 1))


def test_residuals_and_leverages_are_those_of_dense_least_squares(rng):
    seen = seen_of(rng, 3, 5)
    fitted = fit_points(seen, F, B, parts(seen), np.ones(3))
    own = np.flatnonzero(seen.track == 1)
    s = np.tile(fitted.sigma, 5)

    def predicted(point):
        local = np.einsum("nji,nj->in", seen.R[own], point - seen.t[own])
        return np.stack(models.project(*local, F, B), axis=-1).ravel()

    point = np.array([3.0, 0.0, 0.0])
    for _ in range(30):
        J = np.column_stack([(predicted(point + d) - predicted(point - d)) / 2e-5 for d in 1e-5 * np.eye(3)])
        A = J / s[:, None]
        point = point + np.linalg.lstsq(A, (seen.z[own].ravel() - predicted(point)) / s, rcond=None)[0]
    r = seen.z[own].ravel() - predicted(point)
    hat = A @ np.linalg.solve(A.T @ A, A.T)
    assert np.allclose(fitted.r[own].ravel(), r, atol=1e-5)
    assert np.allclose(fitted.free[own].ravel(), 1.0 - np.diag(hat), atol=1e-5)
    assert np.allclose(fitted.sigma, np.sqrt((fitted.r**2).sum(axis=0) / fitted.free.sum(axis=0)), rtol=1e-5)
    # what the fit makes neighbours share: the covariance of residuals, sigma (1 - hat) sigma
    shared = -(s[:, None] * hat * s[None, :])
    expected = [[shared[3 * i + c, 3 * i - 3 + c] for c in range(3)] for i in range(1, 5)]
    assert np.allclose(fitted.neighbours[own][1:], expected, atol=1e-5)


@pytest.mark.parametrize("length", [3, 12])
def test_the_noise_is_recovered_however_short_the_tracks(rng, length):
    """Without the degrees of freedom of the points, tracks of three would seem to have 0.8 of their noise."""
    seen = seen_of(rng, 6000 // length, length)
    fitted = fit_points(seen, F, B, parts(seen), np.ones(3))
    for k in range(3):
        own = fitted.parts == k
        estimate, _ = log_interval(fitted, own, float(fitted.sigma[k]), LEVEL)
        assert estimate.holds(SIGMA[k])
        assert estimate.high / estimate.low < 1.35


def test_tracks_of_unlike_noise_make_the_interval_wider(rng):
    """Half of the tracks have three times the noise: squares scatter by tracks, as chi-square does not know."""
    seen = seen_of(rng, 200, 12)
    ideal = fit_points(seen, F, B, parts(seen), np.ones(3)).ideal
    unlike = Sightings(
        ideal + (seen.z - ideal) * np.where(seen.track % 2, 3.0, 1.0)[:, None], *list(vars(seen).values())[1:]
    )
    width = []
    for each in (seen, unlike):
        fitted = fit_points(each, F, B, parts(seen), np.ones(3))
        estimate, variance = log_interval(fitted, fitted.parts == 0, float(fitted.sigma[0]), 0.01)
        width.append(np.log(estimate.high / estimate.low))
        assert variance >= 0.499 / fitted.free[:, 0].sum()
    assert width[1] > 1.5 * width[0]


def test_correlation_is_found_and_not_that_of_the_fit(rng):
    white = seen_of(rng, 800, 5)
    fitted = fit_points(white, F, B, parts(white), np.ones(3))
    for k in range(3):
        _, _, interval = correlations(fitted, k, LEVEL)
        assert interval.holds(0.0)
        assert interval.high - interval.low < 0.5
    coloured = seen_of(rng, 200, 30, rho=0.6)
    fitted = fit_points(coloured, F, B, parts(coloured), np.ones(3))
    _, _, interval = correlations(fitted, 0, LEVEL)
    assert 0.3 < interval.low < interval.value < 0.65


def test_a_note_says_where_correlation_makes_sigma_a_lower_limit(rng):
    """By chance it is missing only if a correlation of 0.9 looks like none, which is 30 standard errors away."""
    of = characterise_posed(seen_of(rng, 200, 30, rho=0.9), SENSOR, "here")
    assert of.coordinates[0].white is False
    assert HIDDEN in of.notes


def test_a_track_with_a_mismatch_is_left_out_as_a_whole(rng):
    seen = seen_of(rng, 100, 8)
    z = seen.z.copy()
    z[8 * 7 + 3, 2] += 9.0
    wrong = Sightings(z, *list(vars(seen).values())[1:])
    good = without_gross(fit_points(wrong, F, B, parts(seen), np.ones(3)))
    assert (~good).sum() == 8
    assert set(seen.track[~good]) == {7}


def test_growth_and_sigma_of_tracks_in_one_characterisation(rng):
    of = characterise_posed(seen_of(rng, 500, 10), SENSOR, "here")
    assert of.bias is None
    assert [c.name for c in of.coordinates] == ["u", "v", "d"]
    for c, sigma in zip(of.coordinates, SIGMA, strict=True):
        assert abs(np.log(c.sigma.value / sigma)) < 5.5 / np.sqrt(2 * 4500)
        assert c.offset is None
    assert of.rows == 5000
    assert any("cannot be told" in note for note in of.notes)


def test_what_a_step_shares_is_named(rng):
    seen = seen_of(rng, 400, 10)
    shake = rng.standard_normal((10, 3)) * [0.0, 1.0, 0.0]
    shaken = Sightings(seen.z + shake[seen.step], *list(vars(seen).values())[1:])
    still = [note for note in characterise_posed(seen, SENSOR, "here").notes if "share" in note]
    note = next(note for note in characterise_posed(shaken, SENSOR, "here").notes if "share" in note)
    v = float(note.split("v ")[1].split(",")[0])
    assert 0.3 < v < 2.5
    assert not still or float(still[0].split("v ")[1].split(",")[0]) < 0.1


def test_errors_of_poses_are_no_noise_where_poses_are_free(rng):
    seen = seen_of(rng, 400, 8)
    shake = 0.002 * rng.standard_normal((8, 6))
    R = seen.R @ Rotation.from_rotvec(shake[seen.step, :3]).as_matrix()
    wrong = Sightings(seen.z, R, seen.t + shake[seen.step, 3:], *list(vars(seen).values())[3:])
    held, free = (fit_points(wrong, F, B, parts(seen), np.ones(3), free_poses) for free_poses in (False, True))
    half = 5.5 / np.sqrt(2 * 400 * 7)
    assert (np.abs(np.log(free.sigma / SIGMA)) < half).all()
    assert np.log(held.sigma / SIGMA).max() > 2 * half  # negative control
    assert np.isclose(free.free.sum(), 400 * (24 - 3) - 6 * 7, rtol=1e-3)


def test_points_and_poses_together_are_where_least_squares_has_them(rng):
    seen = seen_of(rng, 12, 4)
    fitted = fit_points(seen, F, B, parts(seen), np.ones(3), free_poses=True)

    def misfit(x):
        poses, points = x[:24].reshape(4, 6)[seen.step], x[24:].reshape(12, 3)[seen.track]
        turn = seen.R @ Rotation.from_rotvec(poses[:, 3:]).as_matrix()
        local = np.einsum("nji,nj->in", turn, points - seen.t - poses[:, :3])
        return np.asarray(((seen.z - np.stack(models.project(*local, F, B), axis=-1)) / fitted.sigma).ravel())

    start = np.concatenate([np.zeros(24), np.tile([6.0, 0.0, 0.0], 12)])
    best = optimize.least_squares(misfit, start, x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=1e-12)
    assert np.isclose(((fitted.r / fitted.sigma) ** 2).sum(), 2.0 * best.cost, rtol=1e-6)
    assert np.allclose(fitted.r / fitted.sigma, best.fun.reshape(-1, 3), atol=1e-3)
    hat = best.jac @ np.linalg.pinv(best.jac.T @ best.jac, rcond=1e-10) @ best.jac.T
    assert np.allclose(fitted.free.ravel(), 1.0 - np.diag(hat), atol=1e-3)


def test_short_tracks_are_refused(rng):
    with pytest.raises(InputError, match="of tracks with 3 or more"):
        characterise_posed(seen_of(rng, 300, 2), SENSOR, "here")


def test_a_log_is_seen_from_the_mount_of_its_sensor(uvd, tilted):
    changes = {"truth__sensor__mount": tilted, "truth__sensor__sigma": (1e-7, 1e-7, 1e-7)}
    trial = simulate(uvd.variant("tilted", **changes))
    seen = seen_of_log([trial, trial], Mount(**tilted))
    assert len(seen.z) == 2 * len(trial.z)
    points = trial.landmarks[seen.track % trial.n_landmarks]
    local = np.einsum("nji,nj->in", seen.R, points - seen.t)
    assert np.allclose(np.stack(models.project(*local, 150.0, 0.09), axis=-1), seen.z, atol=1e-5)
    assert len(np.unique(seen.track)) == 2 * len(np.unique(trial.landmark))


# --- boards ------------------------------------------------------------------------------------------


def board():
    across, down = np.meshgrid(np.arange(9), np.arange(6))
    return 0.03 * np.column_stack([across.ravel(), down.ravel(), np.zeros(54)])


def boards(rng, n):
    """Corners (54, 3) of boards about 0.7 m ahead, in sensor axes (forward, left, up), m."""
    out = []
    for _ in range(n):
        turn = Rotation.from_euler("xyz", [rng.uniform(-0.5, 0.5), np.pi / 2 + rng.uniform(-0.5, 0.5), 0.0])
        middle = rng.uniform((0.6, -0.08, -0.05), (0.9, 0.08, 0.05))
        out.append(turn.apply(board() - board().mean(axis=0)) + middle)
    return out


def test_the_noise_of_corners_is_that_about_their_plane(rng):
    """Boards of nine corners: a pose takes 6 of 27 degrees of freedom, more than chance explains."""
    nine = np.isin(board()[:, 0], [0.0, 0.12, 0.24]) & np.isin(board()[:, 1], [0.0, 0.06, 0.15])
    ideal = np.stack([np.stack(models.project(*points[nine].T, F, B), axis=-1) for points in boards(rng, 120)])
    z = ideal + rng.standard_normal(ideal.shape) * SIGMA
    calibrated = BoardCalibration("full", z, np.zeros(z.shape[:2]), F, B, (0.0, 0.0), (0.0, 0.0, 0.0), 0)
    data = residuals_about_boards(calibrated, board()[nine])
    chi2 = float((data.r**2 / SIGMA**2).sum())
    assert abs(chi2 / 3240 - 1.0) < 5.5 * np.sqrt(2 / 3240) < 6 / 27
    assert np.allclose(data.ideal[:, 2], ideal[..., 2].ravel(), atol=2.0)


def test_pairs_without_the_board_are_named_and_the_others_used(tmp_path):
    cv2 = pytest.importorskip("cv2")
    squares = np.kron(np.indices((7, 10)).sum(axis=0) % 2, np.ones((20, 20))) * 200 + 30
    for side, shift in (("left", 30), ("right", 10)):
        for number in range(1, 7):
            image = np.full((240, 320), 230, np.uint8)
            if number != 3:
                image[40 : 40 + 140, shift + 5 * number : shift + 5 * number + 200] = squares
            cv2.imwrite(str(tmp_path / f"{side}{number}.png"), image)
    corners = find_corners(tmp_path, (9, 6), 0.03)
    assert corners.missed == ["left3.png"]
    assert corners.names == [f"left{k}.png" for k in (1, 2, 4, 5, 6)]
    assert corners.left.shape == (5, 54, 2)
    assert np.allclose(corners.left - corners.right, [20.0, 0.0], atol=0.3)
    assert np.allclose(corners.left[1] - corners.left[0], [5.0, 0.0], atol=0.3)


def pixels(points, f, k1, centre):
    """Column and row of points in sensor axes, with radial distortion."""
    x, y = -points[:, 1] / points[:, 0], -points[:, 2] / points[:, 0]
    bent = 1.0 + k1 * (x**2 + y**2)
    return np.column_stack([f * bent * x, f * bent * y]) + centre


def test_a_calibration_without_distortion_model_leaves_a_bias(rng):
    pytest.importorskip("cv2")
    sights = boards(rng, 20)
    right = [points - [0.0, -B, 0.0] for points in sights]
    left, right_px = (np.stack([pixels(p, F, -0.2, (320.0, 240.0)) for p in side]) for side in (sights, right))
    noise = 0.02 * rng.standard_normal((2, *left.shape))
    corners = Corners(left + noise[0], right_px + noise[1], board(), [], [], (640, 480))
    found = {model: calibrate(corners, model) for model in ("full", "poor", "none")}
    sd = {name: residuals_about_boards(c, board()).r.std(axis=0) for name, c in found.items()}
    assert abs(found["poor"].f / F - 1.0) < 0.1  # of the rectified images
    assert abs(found["poor"].B / B - 1.0) < 0.01
    assert (sd["poor"] < 0.06).all()
    assert (sd["none"] > 3.0 * sd["poor"]).any()
    assert found["none"].rms[2] > 3.0 * found["poor"].rms[2]
