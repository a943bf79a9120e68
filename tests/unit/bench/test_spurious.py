"""Heavy tails, errors of tracks and spurious data: what they change, how often, and what the trial says of it.

Statistical tests have a false-alarm rate of at most 1e-6 each.
"""

import numpy as np
import pytest
from scenario_files import load, put
from scipy import stats

import consistency as cs
from consistency.bench.runs.montecarlo import simulate_log
from consistency.bench.scenario.effects import Drift, Observations
from consistency.bench.simulation import World
from consistency.bench.store.recorded_log import read_log
from consistency.scenario import scenario_text

ALARM = 1e-6
WIDE = {"truth__sensor__disparity": (1e-6, 1e6), "truth__sensor__range": (0.5, 3.0)}  # d is 4.5 px or more
SEED = int(np.random.SeedSequence().entropy) % 2**32  # of this test run; every assertion holds for almost all of them


def pair(*effects, run=0, **changes):
    """A trial of 500 steps without the effects and with them; nothing falls out of the search range."""
    print(f"SEED = {SEED}")
    plain = cs.load_scenario("herath2007-stereo").variant("plain", **{**WIDE, **changes})
    return cs.simulate(plain, run, SEED), cs.simulate(plain.variant("with", truth__sensor__effects=effects), run, SEED)


def tracks_of(step, landmark):
    """Rows of each track, one row after the other."""
    tracks = {}
    done = []
    for row, (k, label) in enumerate(zip(step, landmark, strict=True)):
        if label in tracks and step[tracks[label][-1]] == k - 1:
            tracks[label].append(row)
        else:
            tracks[label] = [row]
            done.append(tracks[label])
    return done


def as_often(hits, of, rate):
    """Whether the number of hits is one that a rate gives, but for the false-alarm rate."""
    return bool(stats.binomtest(hits, of, rate).pvalue > ALARM)


def is_like(values, distribution):
    return bool(stats.kstest(values, distribution.cdf).pvalue > ALARM)


def test_a_track_is_what_is_seen_in_consecutive_steps(rng):
    step, landmark = np.nonzero(rng.random((40, 7)) < 0.7)
    track, age = Observations(step + 1, landmark, np.zeros((len(step), 3)), 7).tracks()
    for rows in tracks_of(step, landmark):
        assert len(set(track[rows])) == 1
        assert list(age[rows]) == list(range(len(rows)))
    assert track.max() + 1 == len(tracks_of(step, landmark)) == len(set(track))
    empty = Observations(step[:0], landmark[:0], np.zeros((0, 3)), 7).tracks()
    assert [len(values) for values in empty] == [0, 0]


# --- errors of landmarks --------------------------------------------------------------------------------


def test_heavy_tails_are_a_second_error_of_some():
    rate = 0.2
    sigma = np.array([5.0, 4.0, 0.4])
    plain, trial = pair({"kind": "heavy-tails", "rate": rate, "sigma_px": sigma.tolist()})
    error = trial.z - plain.z
    hit = np.any(error != 0.0, axis=1)
    assert as_often(int(hit.sum()), len(hit), rate)
    for i in range(3):
        assert is_like(error[hit, i] / sigma[i], stats.norm)
    assert np.abs(np.corrcoef(error[hit].T)[np.triu_indices(3, 1)]).max() < 5.5 / np.sqrt(hit.sum())
    assert trial.source is None


def test_a_log_may_hold_gross_errors(tmp_path):
    """Some pixels outside the image do not mean that pixels are counted from its corner."""
    effect = {"kind": "heavy-tails", "rate": 0.05, "sigma_px": [200.0, 200.0, 0.0]}
    scenario = cs.load_scenario("herath2007-stereo").variant("tails", truth__sensor__effects=[effect])
    simulate_log(scenario, runs=1, seed=SEED, out=tmp_path / "log")
    trial = read_log(tmp_path / "log").trials[0]
    assert (np.abs(trial.z[:, 0]) > 175.0).any()


def test_the_error_of_a_track_is_a_stationary_gauss_markov_process():
    c = 0.8
    sigma = np.array([1.0, 2.0, 0.3])
    plain, trial = pair({"kind": "track-error", "sigma_px": sigma.tolist(), "correlation": c})
    error, tracks = (trial.z - plain.z) / sigma, tracks_of(plain.step, plain.landmark)
    firsts = np.array([error[rows[0]] for rows in tracks])
    fresh = np.concatenate([error[rows][1:] - c * error[rows][:-1] for rows in tracks]) / np.sqrt(1.0 - c**2)
    assert len(fresh) > 1000
    for i in range(3):
        assert is_like(firsts[:, i], stats.norm)  # stationary from the first step on, and anew after a gap
        assert is_like(fresh[:, i], stats.norm)
    assert np.abs(np.corrcoef(fresh.T)[np.triu_indices(3, 1)]).max() < 5.5 / np.sqrt(len(fresh))
    assert trial.source is None


def test_after_a_gap_the_error_is_another_one():
    """Almost constant along a track, so that a gap of a landmark shows."""
    plain, trial = pair({"kind": "track-error", "sigma_px": [1.0, 1.0, 0.3], "correlation": 0.999999})
    error, tracks = trial.z - plain.z, tracks_of(plain.step, plain.landmark)
    label = [plain.landmark[rows[0]] for rows in tracks]
    again = [i for i in range(len(tracks)) if label[i] in label[:i]]
    assert again
    assert all(np.ptp(error[rows], axis=0).max() < 0.1 for rows in tracks)
    jumps = [error[tracks[i][0]] - error[tracks[label.index(label[i])][0]] for i in again]
    assert np.abs(jumps).max() > 0.1


# --- spurious data ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("disparity", [None, (4.0, 9.0)])
def test_a_mismatch_has_a_disparity_of_nothing(disparity):
    rate = 0.1
    effect = {"kind": "mismatch", "rate": rate} | ({} if disparity is None else {"disparity_px": list(disparity)})
    plain, trial = pair(effect, truth__sensor__disparity=(1e-6, 40.0))
    low, high = disparity or (1e-6, 40.0)
    assert np.array_equal(trial.landmark, plain.landmark)
    hit = trial.spurious
    assert as_often(int(hit.sum()), len(hit), rate)
    assert np.all(trial.source[hit] == -1)
    assert np.array_equal(trial.source[~hit], plain.landmark[~hit])
    assert np.array_equal(trial.z[~hit], plain.z[~hit])
    assert np.array_equal(trial.z[:, :2], plain.z[:, :2])
    assert is_like(trial.z[hit, 2], stats.uniform(low, high - low))


def test_a_swap_carries_another_of_the_same_step():
    rate = 0.1
    plain, trial = pair({"kind": "swap", "rate": rate})
    step, hit = plain.step, trial.spurious
    seen = np.bincount(step)[step]
    assert np.array_equal(trial.landmark, plain.landmark)
    assert as_often(int(hit.sum()), int((seen > 1).sum()), rate)
    assert np.array_equal(trial.z[~hit], plain.z[~hit])
    place = []
    for row in np.flatnonzero(hit):
        others = np.flatnonzero((step == step[row]) & (np.arange(len(step)) != row))
        at = int(np.flatnonzero(plain.landmark[others] == trial.source[row])[0])
        assert np.array_equal(trial.z[row], plain.z[others[at]])
        place.append((at, len(others)))
    chosen = np.array([at for at, of in place if of == 4])
    assert stats.chisquare(np.bincount(chosen, minlength=4)).pvalue > ALARM  # each of four as often


def test_all_are_swapped_that_have_another():
    plain, trial = pair({"kind": "swap", "rate": 1.0})
    alone = np.bincount(plain.step)[plain.step] == 1
    assert alone.any()
    assert np.array_equal(trial.spurious, ~alone)
    assert len(trial.things) == 0 or np.all(trial.things < len(trial.landmarks))


def test_a_mismatch_that_is_swapped_is_still_of_no_landmark():
    _, trial = pair({"kind": "mismatch", "rate": 1.0}, {"kind": "swap", "rate": 1.0})
    assert np.all(trial.source == -1)


@pytest.mark.parametrize("rate, speed", [(0.03, 2.0), (0.2, 15.0), (1.0, 0.001)])
def test_a_drifting_track_slides_until_it_ends_or_leaves_the_image(rate, speed):
    plain, trial = pair({"kind": "drift", "rate": rate, "speed_px": speed})
    at = {key: row for row, key in enumerate(zip(trial.step, trial.landmark, strict=True))}
    step, angles, begun, could, left = plain.step, [], 0, 0, 0
    for rows in tracks_of(step, plain.landmark):
        row = [at.get((step[i], plain.landmark[i])) for i in rows]
        known = [i for i in row if i is not None]
        assert row[: len(known)] == known  # what is gone does not come back
        spurious = trial.spurious[known]
        start = int(spurious.argmax()) if spurious.any() else len(known)
        moved = trial.z[known] - plain.z[rows[: len(known)]]
        if start == len(known) and len(known) < len(rows):  # slid out of the image in its first step
            could, begun, left = could + start + 1, begun + 1, left + 1
            continue
        assert np.all(moved[:start] == 0.0)
        assert np.all(moved[:, 2] == 0.0)
        assert spurious[start:].all()
        assert np.all(trial.source[known][start:] == -1)
        could, begun = could + min(start + 1, len(rows)), begun + (start < len(known))
        if start < len(known):
            slid = speed * np.arange(1, len(known) - start + 1)
            direction = moved[start, :2] / speed
            assert np.hypot(*direction) == pytest.approx(1.0, abs=1e-9)
            assert np.allclose(moved[start:, :2], slid[:, None] * direction, rtol=0, atol=1e-9)
            assert np.all(np.abs(trial.z[known][start:, :2]) <= [160.0, 120.0])
            angles.append(np.arctan2(*direction))
        if len(known) < len(rows):
            left += 1
            u, v, _ = plain.z[rows[len(known)]] + [*(slid[-1] + speed) * direction, 0.0]
            assert not (-160.0 <= u < 160.0 and -120.0 <= v < 120.0)
    assert as_often(begun, could, rate)
    assert is_like(np.array(angles), stats.uniform(-np.pi, 2.0 * np.pi))
    assert left > 0 or speed < 10.0


def test_a_track_that_has_slid_out_of_the_image_does_not_come_back():
    """Until it is a new track: after a gap of the landmark."""
    world = World(cs.load_scenario("herath2007-stereo").truth)
    u = np.array([158.0, 162.0, 155.0, 150.0])
    z = np.column_stack([u, np.zeros(4), np.full(4, 5.0)])
    observations = Observations(np.array([1, 2, 3, 5]), np.zeros(4, int), z, 120)
    drift = Drift(rate=1.0, speed=1e-6)
    kept = drift.apply(observations, np.random.default_rng(0), world.context(world.reference))
    assert kept.step.tolist() == [1, 5]
    assert kept.sources.tolist() == [-1, -1]


# --- what is not seen -----------------------------------------------------------------------------------------


def test_images_come_after_so_many_steps_in_turn():
    plain, trial = pair({"kind": "frames", "every": [1, 2, 4]})
    images = sorted({each for k in range(0, 500, 7) for each in (k + 1, k + 3, k + 7) if each <= 500})
    kept = np.isin(plain.step, images)
    assert set(trial.step) == set(plain.step[kept])
    assert trial.landmark.tolist() == plain.landmark[kept].tolist()


def test_walls_hide_what_is_behind_them_from_where_the_sensor_is():
    wall, mount = (3.0, -2.0, 5.0, 3.0), {"position": (0.4, -0.6, 0.0), "rotation": (0.0, 0.0, 0.0)}
    plain, trial = pair({"kind": "occlusion", "walls": [wall]}, truth__sensor__mount=mount)
    step = plain.step
    heading = plain.truth[step, 2]
    c, s = np.cos(heading), np.sin(heading)
    sensor = plain.truth[step, :2] + np.stack([c * 0.4 + s * 0.6, s * 0.4 - c * 0.6], axis=1)
    point, (start, end) = plain.landmarks[plain.landmark, :2], np.reshape(wall, (2, 2))
    # sensor + t (point - sensor) = start + u (end - start)
    A = np.stack([point - sensor, np.broadcast_to(start - end, point.shape)], axis=2)
    t, u = np.linalg.solve(A, (start - sensor)[..., None])[..., 0].T
    hidden = (t > 0) & (t < 1) & (u > 0) & (u < 1)
    seen = set(zip(step[~hidden], plain.landmark[~hidden], strict=True))
    assert 20 < hidden.sum() < len(hidden) - 20
    assert set(zip(trial.step, trial.landmark, strict=True)) == seen


# --- mistakes -------------------------------------------------------------------------------------------------

GOOD = {
    "heavy-tails": {"rate": 0.1, "sigma_px": [1.0, 1.0, 1.0]},
    "track-error": {"sigma_px": [1.0, 1.0, 1.0], "correlation": 0.5},
    "mismatch": {"rate": 0.1},
    "swap": {"rate": 0.1},
    "drift": {"rate": 0.1, "speed_px": 2.0},
    "junction": {"count": 3, "seed": 1, "behind_m": [1.0, 2.0], "edge_m": 2.0, "far_share": 0.5},
    "selection": {
        "count": 5, "forget_steps": 5, "seed": 1, "cells": [4, 3], "near_px": 6.0,
        "strength": 1.0, "stereo": 1.0, "image": 1.0, "depth": 1.0,
    },
    "frames": {"every": [1, 2]},
    "occlusion": {"walls_m": [[0.0, 0.0, 1.0, 1.0]]},
}  # fmt: skip
MISTAKES = [
    *(
        (kind, {"rate": 1.5}, r"\.rate': .*less than or equal to 1 \(got 1\.5\)$")
        for kind in GOOD
        if "rate" in GOOD[kind]
    ),
    *((kind, {"rate": -0.1}, r"\.rate': .*greater than or equal to 0") for kind in GOOD if "rate" in GOOD[kind]),
    ("heavy-tails", {"sigma_px": [1.0, -1.0, 1.0]}, r"\.sigma\.1': .*greater than or equal to 0"),
    ("heavy-tails", {"sigma_px": [1.0, 1.0]}, r"\.sigma\.2': missing"),
    ("heavy-tails", {"sigma_m": [1.0, 1.0, 1.0]}, r"\.sigma_m': unknown key; allowed here: kind, name, rate, sigma"),
    ("track-error", {"correlation": 1.0}, r"\.correlation': .*less than 1 \(got 1\.0\)$"),
    ("track-error", {"correlation": -0.5}, r"\.correlation': .*greater than or equal to 0"),
    ("mismatch", {"disparity_px": [9.0, 9.0]}, r"disparity must be \[low, high\] with low < high$"),
    ("drift", {"speed_px": 0.0}, r"\.speed': .*greater than 0"),
    ("junction", {"behind_m": [2.0, 1.0]}, r"behind must be \[low, high\] with low <= high$"),
    ("junction", {"far_share": 2.0}, r"\.far_share': .*less than or equal to 1"),
    ("junction", {"count": 0}, r"\.count': .*greater than 0"),
    ("selection", {"cells": [4, 0]}, r"\.cells\.1': .*greater than 0"),
    ("selection", {"strength": -1.0}, r"\.strength': .*greater than or equal to 0"),
    ("selection", {"forget_steps": 0}, r"\.forget_steps': .*greater than 0"),
    ("frames", {"every": [1, 0]}, r"\.every\.1': .*greater than 0"),
    ("frames", {"every": []}, r"\.every': .*at least 1 item"),
    ("occlusion", {"walls_m": []}, r"\.walls': .*at least 1 item"),
]


@pytest.mark.parametrize("kind, change, complaint", MISTAKES)
def test_a_mistake_is_answered_with_file_and_key(tmp_path, kind, change, complaint):
    table = {"kind": kind, **GOOD[kind]}
    if "sigma_m" in change:
        del table["sigma_px"]
    with pytest.raises(cs.InputError, match=r"mine\.toml: key 'truth\.sensor\.effects\.0.*" + complaint) as e:
        load(tmp_path, put("truth.sensor.effects", [table | change]))
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("kind", GOOD)
def test_a_file_is_read_as_it_is_written(tmp_path, kind):
    scenario = load(tmp_path, put("truth.sensor.effects", [{"kind": kind, **GOOD[kind]}]))
    (tmp_path / "again.toml").write_text(scenario_text(scenario), encoding="utf-8")
    assert cs.load_scenario(tmp_path / "again.toml").hash == scenario.hash
