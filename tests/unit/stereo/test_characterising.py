"""Characterisation of a sensor: its likelihood beside dense matrices, its estimates beside what was simulated.

Random tests have levels of 1e-7 an interval, so that one of them fails by chance in less than one of a million runs.
"""

from dataclasses import replace

import characterisation as benchmark
import numpy as np
import pytest
from painted import by_title, panels
from scipy import stats

import consistency as cs
from consistency.bench.scenario import PicturedSensor
from consistency.bench.scenario.observations import BiasMap, bilinear, hats
from consistency.bench.simulation import simulate
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.errors import InputError
from consistency.stereo.characterising import coordinate_fit
from consistency.stereo.characterising.characterise import (
    Residuals,
    characterise,
    estimate_bias,
    grid_of,
    octaves,
    residuals_of,
    select,
    shrunken,
)
from consistency.stereo.characterising.coordinate_fit import (
    Levels,
    Likelihood,
    Mixture,
    Parameters,
    Rows,
    fit,
    moving_over_rest,
    rate,
    regress,
    tails,
)
from consistency.stereo.characterising.sensor_text import sentences
from consistency.stereo.pages import compose_sensor

LEVEL = 1e-7
SENSOR = PicturedSensor(model="uvd", sigma=(1.0, 1.0, 1.0), f=150.0, B=0.09, disparity=(1.0, 32.0), image=(320, 240))


def rows_of(rng, tracks, length, sigma=1.0, rho=0.0, tau=0.0):
    """Residuals of tracks without gaps, about a mean of 0.3."""
    e = rng.standard_normal((tracks, length))
    for k in range(1, length):
        e[:, k] = rho * e[:, k - 1] + np.sqrt(1 - rho**2) * e[:, k]
    r = (0.3 + sigma * e + tau * rng.standard_normal((tracks, 1))).ravel()
    first = np.arange(tracks) * length
    gap = np.ones(len(r), int)
    gap[first] = 0
    ones = np.ones((len(r), 1))
    return Rows(r, ones, ones, first, gap, np.zeros(1))


def data_of(rng, n, sigma, track=20):
    """White noise all over an image, at disparities from 1 to 31 px."""
    ideal = rng.uniform((-160, -120, 1), (160, 120, 31), (n, 3))
    r = rng.standard_normal((n, 3)) * sigma
    return Residuals(r, ideal, np.arange(n) // track, np.arange(n) % track, np.zeros(n, bool))


# --- functions of place ------------------------------------------------------------------------------


def test_weights_of_nodes_interpolate_as_a_bias_map_does(rng):
    u, v = np.array([-160.0, -20.0, 60.0, 160.0]), np.array([-120.0, 30.0, 120.0])
    matrix = rng.standard_normal((3, 4))
    at = rng.uniform(-200, 200, (50, 2))
    bias = BiasMap(u=tuple(u), v=tuple(v), bias_d=tuple(map(tuple, matrix.tolist())))
    assert np.allclose(bilinear(at[:, 0], at[:, 1], u, v) @ matrix.ravel(), bias.at(*at.T)[:, 2])
    assert np.allclose(hats(at[:, 0], u) @ u, np.clip(at[:, 0], -160, 160))


def test_nodes_of_disparity_are_octaves_between_the_ends_of_the_data():
    nodes = octaves(np.linspace(3.0, 27.0, 10_001))
    assert np.allclose(nodes, [3.12, 4.0, 8.0, 16.0, 26.88])
    assert len(octaves(np.full(50, 7.0))) == 1
    d = np.concatenate([np.linspace(3.0, 3.5, 500), np.linspace(20.0, 30.0, 500)])
    apart = octaves(d)
    assert (hats(d, apart).sum(axis=0) >= 30).all()
    assert 8.0 not in apart


# --- likelihood --------------------------------------------------------------------------------------


def dense(rows, a, rho, q):
    """Coefficients and restricted likelihood from the whole covariance matrix."""
    sd = rows.G @ a
    place, track = np.cumsum(rows.gap), rows.track
    same = track[:, None] == track[None, :]
    V = np.where(same, np.outer(sd, sd) * rho ** np.abs(place[:, None] - place[None, :]), 0.0)
    V += np.where(same, np.mean(sd**2) * q, 0.0)
    W = np.linalg.inv(V)
    normal = rows.X.T @ W @ rows.X + np.diag(rows.ridge)
    beta = np.linalg.solve(normal, rows.X.T @ W @ rows.r)
    e = rows.r - rows.X @ beta
    logs = np.linalg.slogdet(V)[1] + np.linalg.slogdet(normal)[1]
    return beta, float(-0.5 * (logs + e @ W @ e + rows.ridge @ beta**2))


@pytest.mark.parametrize("rho, q", [(0.0, 0.0), (0.6, 0.0), (-0.3, 0.8), (0.4, -0.02)])
def test_the_restricted_likelihood_is_that_of_dense_matrices(rng, rho, q):
    first = np.array([0, 5, 6, 14])
    gap = rng.integers(1, 4, 20)
    gap[first] = 0
    G = rng.dirichlet([1.0, 1.0], 20)
    ridge = np.array([0.0, 0.0, 0.3])
    rows = Rows(rng.standard_normal(20), rng.standard_normal((20, 3)), G, first, gap, ridge)
    a = np.array([0.7, 1.9])
    found = regress(rows, Parameters(a, rho, q))
    beta, value = dense(rows, a, rho, q)
    assert np.allclose(found.beta, beta, rtol=1e-9)
    assert np.isclose(found.value, value, rtol=1e-10)


def test_impossible_parameters_have_no_likelihood(rng):
    rows = rows_of(rng, 4, 10)
    assert regress(rows, Parameters(np.ones(1), 0.0, -0.2)) is None
    assert regress(rows, Parameters(np.ones(1), 0.999, 0.0)) is None


def test_without_memory_the_variance_is_that_of_a_sample(rng):
    rows = rows_of(rng, 10, 3, sigma=2.0)
    found = fit(rows, 1.0, memory=False)
    assert np.isclose(found.parameters.a[0], rows.r.std(ddof=1), rtol=1e-5)
    # variance of log s: 1 / (2 (n - 1)) for Gaussian noise
    assert np.isclose(found.cov[0, 0], 1.0 / (2 * 29), rtol=1e-3)
    assert np.isclose(found.regression.cov[0, 0], rows.r.var(ddof=1) / 30, rtol=1e-4)


@pytest.mark.parametrize("tracks, length, memory", [(12, 9, True), (2, 30, False), (1, 30, False)])
def test_the_scatter_of_tracks_is_that_of_their_scores(rng, tracks, length, memory):
    """H^-1 J H^-1 with J from the slopes of each track's dense likelihood, about their mean; 0 of a single track."""
    rows = rows_of(rng, tracks, length, 1.5, 0.4 if memory else 0.0, 1.0 if memory else 0.0)
    found = fit(rows, 1.0, memory)
    free = 3 if memory else 1
    lag = np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
    residuals = (rows.r - rows.X @ found.regression.beta).reshape(tracks, length)

    def by_track(theta):
        p = Likelihood(rows, memory=True).parameters(theta)
        V = p.a[0] ** 2 * (p.rho**lag + p.ratio)
        return np.asarray(stats.multivariate_normal(cov=V).logpdf(residuals)).reshape(tracks)

    steps = 1e-4 * np.eye(3)[:free]
    scores = np.column_stack([(by_track(found.theta + d) - by_track(found.theta - d)) / 2e-4 for d in steps])
    scores -= scores.mean(axis=0)
    wanted = found.cov[:free, :free] @ scores.T @ scores @ found.cov[:free, :free] * tracks / max(tracks - 1, 1)
    scale = np.abs(wanted).max()
    assert np.allclose(found.robust[:free, :free], wanted, rtol=1e-4, atol=1e-4 * scale + 1e-12)
    assert scale > 1e-6 or tracks == 1


def test_a_fit_is_the_top_of_the_likelihood(rng):
    rows = rows_of(rng, 60, 8, 1.5, 0.5, 1.0)
    found = fit(rows, 1.0)
    for k in range(3):
        for sign in (-1.0, 1.0):
            theta = found.theta + sign * 0.02 * np.eye(3)[k]
            other = regress(rows, Likelihood(rows, memory=True).parameters(theta))
            assert other.value < found.regression.value


def test_noise_memory_and_offsets_are_told_apart(rng):
    found = fit(rows_of(rng, 400, 25, 1.5, 0.5, 0.9), 1.0)
    assert coordinate_fit.noise_interval(found, LEVEL).holds(1.5)
    assert coordinate_fit.correlation(found, LEVEL).holds(0.5)
    assert coordinate_fit.correlation(found, LEVEL).low > 0.3
    assert coordinate_fit.offset_share(found, LEVEL).holds(0.81 / (0.81 + 2.25))
    assert coordinate_fit.offset_share(found, LEVEL).low > 0.1
    lags, _ = coordinate_fit.autocorrelation(found)
    # about the means of tracks: the pooled correlations keep the shape, if not the size
    assert 0.3 < lags[0] < 0.6
    assert lags[0] > lags[1] > lags[3]


def test_white_noise_without_offsets_is_found_as_such(rng):
    found = fit(rows_of(rng, 300, 20), 1.0)
    assert coordinate_fit.correlation(found, LEVEL).holds(0.0)
    share = coordinate_fit.offset_share(found, LEVEL)
    assert share.low == 0.0
    assert share.high < 0.1


def test_intervals_of_heavy_tailed_noise_are_wider(rng):
    """Kurtosis k multiplies the variance of s^2 by 1 + k / 2: for Student's with 6 degrees of freedom, by 2.5."""
    rows = rows_of(rng, 1000, 10)
    heavy = Rows(stats.t.rvs(6, size=10_000, random_state=rng), *list(vars(rows).values())[1:])
    found = [fit(each, 1.0) for each in (rows, heavy)]
    width = [
        np.log(coordinate_fit.noise_interval(f, 0.01).high / coordinate_fit.noise_interval(f, 0.01).low) for f in found
    ]
    assert 1.2 < width[1] / width[0] < 3.0
    assert np.isclose(found[1].robust[0, 0] / found[1].cov[0, 0], 2.5, rtol=0.6)


# --- levels, tails, rates ----------------------------------------------------------------------------


def test_the_chances_of_all_intervals_add_up_to_the_rate():
    levels = Levels(0.01, growth=5, bias=42)
    groups = ("sigma", "growth", "bias", "correlation", "offset", "tails")
    assert np.isclose(sum(levels.of(group) * getattr(levels, group) for group in groups), 0.01)


def test_tails_are_those_of_student(rng):
    heavy = tails(stats.t.rvs(5, size=6000, random_state=rng), LEVEL)
    assert heavy.weight.holds(0.2)
    assert heavy.weight.low > 0.05
    light = tails(rng.standard_normal(6000), LEVEL)
    assert light.weight.low == 0.0
    assert light.weight.high < 0.08
    assert light.weight.value < 0.03


def test_few_wide_errors_are_told_from_students_tails(rng):
    wide = rng.random(8000) < 0.03
    found = tails(rng.standard_normal(8000) * np.where(wide, 5.0, 1.0), LEVEL)
    assert 0.02 < found.mixture.share < 0.04
    assert np.isclose(found.mixture.wide / found.mixture.core, 5.0, rtol=0.2)
    # both together have the variance of the residuals
    both = (1 - found.mixture.share) * found.mixture.core**2 + found.mixture.share * found.mixture.wide**2
    assert np.isclose(both, 1.0, rtol=0.01)
    assert tails(stats.t.rvs(4, size=8000, random_state=rng), LEVEL).mixture is None


def test_a_mixture_is_told_by_its_parts(rng):
    of = characterise(data_of(rng, 2000, 1.0), SENSOR, "test")
    sigma = of.coordinates[0].sigma.value
    mixed = of.coordinates[0].tails._replace(weight=Interval(0.2, 0.1, 0.3), mixture=Mixture(0.05, 0.9, 3.0))
    of = replace(of, coordinates=(replace(of.coordinates[0], tails=mixed), *of.coordinates[1:]))
    told = f"not Gaussian: as if 95 % had sd {0.9 * sigma:.3g} px and 5 % {3.0 * sigma:.3g} px"
    assert told in sentences(of)[0]


def test_a_rate_has_the_interval_of_clopper_and_pearson():
    share = rate(3, 200, 0.01)
    assert np.isclose(share.low, stats.beta.ppf(0.005, 3, 198))
    assert np.isclose(share.high, stats.beta.ppf(0.995, 4, 197))
    assert rate(0, 200, 0.01).low == 0.0


def test_noise_that_doubles_while_moving_has_a_ratio_of_two(rng):
    moving = np.arange(6000) < 3000
    w = rng.standard_normal((6000, 3)) * np.where(moving, 2.0, 1.0)[:, None]
    found = moving_over_rest(w, np.ones((6000, 3)), moving, np.arange(6000) // 20, LEVEL)
    assert len(found) == 3
    for each in found:
        assert each.holds(2.0)
        assert not each.holds(1.5)
    assert moving_over_rest(w, np.ones((6000, 3)), np.ones(6000, bool), np.arange(6000), LEVEL) == ()


# --- residuals and their selection -------------------------------------------------------------------


def test_residuals_are_the_noise_alone(uvd, tilted):
    changes = {"truth__sensor__mount": tilted, "truth__sensor__sigma": (1e-7, 1e-7, 1e-7)}
    trial = simulate(uvd.variant("tilted", **changes))
    sensor = PicturedSensor.model_validate(SENSOR.model_dump() | {"mount": tilted})
    data, strange = residuals_of([trial, trial], sensor)
    assert strange == 0
    assert len(data) == 2 * len(trial.z)
    assert np.abs(data.r).max() < 1e-6
    assert len(data.first) == len(np.unique(data.track)) == 2 * len(np.unique(trial.landmark))
    assert (np.diff(data.step)[np.diff(data.track) == 0] > 0).all()


def test_near_the_search_range_rows_are_left_out_by_their_ideal_value(rng):
    data = data_of(rng, 60_000, (1.0, 1.0, 0.65))
    measured = data.ideal[:, 2] + data.r[:, 2]
    seen = data.keep((measured >= 1.0) & (measured <= 32.0))
    weights = grid_of(seen, np.linspace(-160, 160, 5), np.linspace(-120, 120, 4)).regressors(seen)
    chosen = select(seen, SENSOR, weights)
    d = chosen.kept.ideal[:, 2]
    assert 3.3 < d.min() < 4.2  # 1 + 4 sigma, sigma within 20 %
    assert 28.8 < d.max() < 29.7
    near = chosen.kept.keep(d < 4.5)
    half = 5.5 / np.sqrt(2 * len(near))  # of a log sd, missed in less than 1 of 10^6
    assert abs(np.log(near.r[:, 2].std() / 0.65)) < half
    cut = seen.keep(seen.ideal[:, 2] < 1.3)
    assert abs(np.log(cut.r[:, 2].std() / 0.65)) > 0.2  # negative control: truncated noise looks smaller
    u = chosen.kept.ideal[:, 0]
    assert 3.0 < 160 - np.abs(u).max() < 5.0


def test_mismatches_are_counted_and_are_no_noise(rng):
    data = data_of(rng, 6_000, (1.0, 1.0, 0.65))
    wrong = rng.random(len(data)) < 0.02
    r = data.r + np.where(wrong[:, None], [0.0, 0.0, 25.0], 0.0)
    of = characterise(Residuals(r, *list(vars(data).values())[1:]), SENSOR, "test", miss=1e-6)
    assert of.gross.holds(0.02)
    assert of.gross.low > 0.008
    assert of.coordinates[2].sigma.holds(0.65)


# --- bias --------------------------------------------------------------------------------------------


def test_shrinkage_is_that_of_empirical_bayes():
    b = np.array([1.0, -2.0, 0.5, 1.5])
    w2 = np.mean(b**2) - 0.25  # largest likelihood where all have the variance 0.25
    assert np.allclose(shrunken(b, 0.25 * np.eye(4)), b * w2 / (w2 + 0.25), rtol=1e-3)
    assert np.abs(shrunken(0.01 * b, np.eye(4))).max() < 1e-4


def test_a_bias_is_shown_where_there_is_one_and_zero_where_nothing_is_known(rng):
    data = data_of(rng, 6000, (1.0, 1.0, 0.6))
    data = data.keep(~((data.ideal[:, 0] > 90.0) & (data.ideal[:, 1] > 50.0)))
    r = data.r.copy()
    r[:, 2] += 0.01 * data.ideal[:, 0]
    biased = Residuals(r, *list(vars(data).values())[1:])
    of = characterise(biased, SENSOR, "test", miss=1e-6)
    assert of.bias.shown.tolist() == [False, False, True]
    u = np.tile(of.bias.grid.u, 4)
    known = of.bias.grid.known
    assert not known[-1]
    assert known.sum() >= 17
    assert (np.abs(of.bias.value[2] - 0.01 * u) < of.bias.half[2])[known].all()
    assert of.bias.believed[2, -1] == 0.0
    assert (of.bias.believed[:2] == 0.0).all()
    assert np.sqrt(np.mean((of.bias.believed[2] - 0.01 * u)[known] ** 2)) < 0.15


def test_the_test_for_a_bias_pays_for_offsets_of_tracks(rng):
    """Tracks with offsets scatter about zero without any bias; as if rows were independent, it would be found."""
    rows = rows_of(rng, 40, 50, 0.5, 0.0, 1.0)
    zero = Rows(rows.r - rows.r.mean(), *list(vars(rows).values())[1:])
    ideal = np.zeros((2000, 3))
    grid = grid_of(Residuals(ideal, ideal, rows.track, np.arange(2000), np.ones(2000, bool)), *[np.zeros(1)] * 2)
    found = [fit(zero, 1.0)] * 3
    bias = estimate_bias(found, grid, LEVEL, LEVEL)
    assert not bias.shown.any()
    # 1 / sqrt(40) from the offsets, not 1 / sqrt(2000)
    assert np.isclose(bias.half[0, 0], stats.norm.isf(LEVEL / 2) / np.sqrt(40), rtol=0.6)


def test_a_bias_scatters_as_tracks_do_where_offsets_are_not_modelled(rng):
    """40 tracks of 50 rows with offsets: 1 / 40 of their variance, 40 times what independent rows would have."""
    rows = rows_of(rng, 40, 50, 0.5, 0.0, 1.0)
    found = fit(rows, 1.0, memory=False)
    _, half, cov = coordinate_fit.bias_coefficients(found, 0.01)
    assert 10.0 < cov[0, 0] / found.regression.cov[0, 0] < 120.0
    assert np.isclose(half[0], stats.t.isf(0.005, 39) * np.sqrt(cov[0, 0]), rtol=1e-6)


# --- all of it ---------------------------------------------------------------------------------------


def test_what_is_simulated_is_recovered_in_all_parameters_together():
    """Growth, bias map and noise of three runs at once; it fails by chance once in a million at most."""
    scenario, truth = cs.load_scenario(benchmark.SCENARIO), benchmark.real()
    world = cs_world(scenario)
    data, _ = residuals_of(benchmark.trials_of(scenario, world, truth, 3, seed=1), SENSOR)
    of = characterise(data, SENSOR, "test", miss=1e-6)
    assert benchmark.missed(of, scenario, truth) == []
    assert of.growth.shown
    assert of.bias.shown[2]
    assert benchmark.missed(of, scenario, benchmark.Real(None, None)) != []  # negative control
    assert benchmark.bias_rms(of, truth)[2] < 0.1


def cs_world(scenario):
    return benchmark.World(scenario.variant("everything", truth__sensor__disparity=benchmark.EVERYTHING).truth)


def test_too_few_data_are_refused(rng):
    with pytest.raises(InputError, match="at least 100 of 5"):
        characterise(data_of(rng, 60, (1.0, 1.0, 1.0)), SENSOR, "here")


def test_a_characterisation_says_what_it_left_out(rng):
    of = characterise(data_of(rng, 3000, (1.0, 1.0, 0.5)), SENSOR, "here", strange=7)
    assert of.left_out["of no landmark"] == 7
    assert of.rows + sum(of.left_out.values()) == 3007


def test_all_lags_are_within_their_axes(rng):
    of = characterise(data_of(rng, 3000, (1.0, 1.0, 0.5)), SENSOR, "here")
    u, *others = of.coordinates
    falling = replace(of, coordinates=(replace(u, lags=np.where(np.isfinite(u.lags), -0.6, np.nan)), *others))
    drawn = panels(by_title(compose_sensor(falling, {}))["Autocorrelation"])
    assert [axes.get_ylim() for axes in drawn] == 3 * [pytest.approx((-0.69, 0.69))]
