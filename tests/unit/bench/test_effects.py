"""Effects of a sensor: their order, their random numbers, what they may do to a trial, and mistakes in a scenario."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
import pandas as pd
import pytest
from scenario_files import load, put

import consistency as cs
from consistency.bench.filters.run_filter import step_through
from consistency.bench.runs.montecarlo import run_log, simulate_log
from consistency.bench.scenario import models
from consistency.bench.scenario.effects import EFFECTS, FieldOfView, ListedEffect, Observations
from consistency.bench.scenario.toml_tables import Count, Positive, Triple
from consistency.bench.simulation import World, draw_landmarks, planned_controls, purpose_of
from consistency.bench.store.parquet import observations_table
from consistency.bench.store.recorded_log import read_log

CALLS = []  # labels of effects in the order in which they were applied
DRAWN = {}  # first numbers of each effect, by label
FIRST = {"kind": "draw", "name": "first"}
SECOND = {"kind": "draw", "name": "second"}


class Shift(ListedEffect):
    """Adds a constant."""

    units: ClassVar[dict[str, str]] = {"by": "_px"}
    draws: ClassVar[bool] = False
    kind: Literal["shift"] = "shift"
    by: Triple

    def apply(self, observations, rng, context):
        CALLS.append(self.label)
        return observations.with_z(observations.z + np.array(self.by))


class Scale(ListedEffect):
    """Multiplies, before the noise."""

    draws: ClassVar[bool] = False
    before_noise: ClassVar[bool] = True
    kind: Literal["scale"] = "scale"
    factor: Positive

    def apply(self, observations, rng, context):
        CALLS.append(self.label)
        return observations.with_z(observations.z * self.factor)


class Draw(ListedEffect):
    """Draws numbers and changes nothing."""

    kind: Literal["draw"] = "draw"

    def apply(self, observations, rng, context):
        CALLS.append(self.label)
        DRAWN[self.label] = rng.standard_normal(5)
        return observations


class Ghosts(ListedEffect):
    """Features that move like no rigid point: each is seen at a fixed pixel in some steps."""

    models: ClassVar[tuple[str, ...]] = ("xyz", "uvd")
    kind: Literal["ghosts"] = "ghosts"
    count: Count
    length: Count

    def apply(self, observations, rng, context):
        start = rng.integers(1, context.steps - self.length + 2, self.count)
        pixel = rng.uniform([-50.0, -40.0, 5.0], [50.0, 40.0, 15.0], (self.count, 3))
        thing = np.repeat(np.arange(self.count), self.length)
        step = (start[:, None] + np.arange(self.length)).ravel()
        return observations.add(step, thing, pixel[thing])


class Mistaken(ListedEffect):
    """The first row of every tenth step shows what the second is of."""

    kind: Literal["mistaken"] = "mistaken"

    def apply(self, observations, rng, context):
        step = observations.step
        row = np.flatnonzero((step[:-2] == step[1:-1]) & (step[:-2] % 10 == 0) & (np.diff(step, prepend=0)[:-2] > 0))
        z, source = observations.z.copy(), observations.sources.copy()
        z[row], source[row] = z[row + 1], source[row + 1]
        return observations.with_z(z, source)


class Broken(ListedEffect):
    """Effects with a mistake."""

    kind: Literal["broken"] = "broken"
    mistake: str

    def apply(self, observations, rng, context):
        o, one = observations, np.ones(1, int)
        made = {
            "shape": lambda: o.with_z(o.z[:, :2]),
            "NaN": lambda: o.with_z(np.where(o.landmark[:, None] == o.landmark[0], np.nan, o.z)),
            "step zero": lambda: o.add(0 * one, 0 * one, o.z[:1]),
            "step beyond": lambda: o.add(one * context.steps + 1, 0 * one, o.z[:1]),
            "twice": lambda: o.add(np.array([3, 3]), np.array([0, 0]), o.z[:2]),
            "order": lambda: Observations(o.step[::-1], o.landmark[::-1], o.z[::-1], o.ids),
            "thing": lambda: o.add(one, 0 * one, o.z[:1]),
        }
        return made[self.mistake]()


class Silent(ListedEffect):
    """Says that it draws nothing, and does."""

    draws: ClassVar[bool] = False
    kind: Literal["silent"] = "silent"

    def apply(self, observations, rng, context):
        return observations.with_z(observations.z + rng.standard_normal(3))


@pytest.fixture(autouse=True)
def kinds(monkeypatch):
    for effect in (Shift, Scale, Draw, Ghosts, Mistaken, Broken, Silent):
        monkeypatch.setitem(EFFECTS, effect.model_fields["kind"].default, effect)
    CALLS.clear()
    DRAWN.clear()


def with_effects(small, *effects, name="herath2007-stereo", **changes):
    return small(name, truth__sensor__effects=effects, **changes)


# --- the first three ------------------------------------------------------------------------------


def plainly(scenario, run, seed):
    """A trial without any effects as parts: one loop over steps, noise at the end.

    Returns the controls that are told, the path without its start, and steps, landmarks and z of what is observed.
    """
    truth, sensor = scenario.truth, scenario.truth.sensor
    streams = [np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(run, purpose))) for purpose in (0, 1)]
    v_omega = streams[0].standard_normal((truth.steps, 2)) * [truth.motion.sigma_v, truth.motion.sigma_omega]
    controls, pose, path = planned_controls(truth), np.array([*truth.path.start, truth.path.heading]), []
    for (dt, v, omega), noise in zip(controls, v_omega * (truth.motion.noise_on == "motion"), strict=True):
        v, omega = v + noise[0], omega + noise[1]
        pose = pose + dt * np.array([v * np.cos(pose[2]), v * np.sin(pose[2]), omega])
        path.append(pose)
    if truth.motion.noise_on == "odometry":
        controls[:, 1:] -= v_omega
    landmarks, mount = draw_landmarks(truth), sensor.mount.packed()
    step, landmark, z = [], [], []
    for k, (x, y, heading) in enumerate(path, start=1):
        p = np.stack(models.to_sensor(*models.to_robot(x, y, heading, *landmarks.T), mount))
        distance = np.linalg.norm(p, axis=0)
        u, v, d = models.project(*p, sensor.f, getattr(sensor, "B", 0.0))
        near = (distance >= sensor.range[0]) & (distance <= sensor.range[1]) & (p[0] > 0)
        width, height = sensor.image
        column, row = sensor.principal_point or (width / 2, height / 2)
        seen = np.flatnonzero(near & (u >= -column) & (u < width - column) & (v >= -row) & (v < height - row))
        step += [k] * len(seen)
        landmark += list(seen)
        z += list((np.stack([u, v, d]) if sensor.model == "uvd" else p)[:, seen].T)
    measured = np.array(z) + streams[1].standard_normal((len(z), 3)) * np.array(sensor.sigma)
    kept = np.ones(len(z), bool)
    if sensor.model == "uvd":
        kept = (measured[:, 2] >= sensor.disparity[0]) & (measured[:, 2] <= sensor.disparity[1])
    return controls, np.array(path), np.array(step)[kept], np.array(landmark)[kept], measured[kept]


@pytest.mark.parametrize("noise_on", ["odometry", "motion"])
@pytest.mark.parametrize("name", ["herath2007-stereo", "herath2007-xyz"])
def test_field_of_view_noise_and_search_range_are_a_plain_sensor(small, tilted, name, noise_on):
    changes = {"truth__sensor__disparity": (4.0, 9.0)} if name == "herath2007-stereo" else {}
    scenario = small(name, truth__motion__noise_on=noise_on, truth__sensor__mount=tilted, **changes)
    trial = cs.simulate(scenario, run=2, seed=3)
    controls, path, step, landmark, z = plainly(scenario, 2, 3)
    assert np.allclose(trial.controls, controls, rtol=0, atol=1e-12)
    assert np.allclose(trial.truth[1:], path, rtol=0, atol=1e-9)
    assert np.array_equal(trial.step, step)
    assert np.array_equal(trial.landmark, landmark)
    assert np.allclose(trial.z, z, rtol=0, atol=1e-9)
    assert not np.allclose(cs.simulate(scenario, run=2, seed=4).z[:5], z[:5], rtol=0, atol=1e-9)  # negative control


@pytest.mark.parametrize("name", ["linear-gaussian", "herath2007-xyz"])
def test_a_linear_sensor_looks_from_the_planned_path(small, name):
    world, rng = World(small(name).truth), np.random.default_rng(0)
    aside = world.reference + np.array([0.0, 0.0, 0.5])

    def seen(path):
        context = world.context(path)
        return FieldOfView().apply(context.ideal(), rng, context).landmark

    assert np.array_equal(seen(aside), seen(world.reference)) == (name == "linear-gaussian")


def test_an_empty_list_is_no_list(small):
    base = cs.load_scenario("herath2007-stereo")
    empty = base.variant("empty", truth__sensor__effects=[])
    assert empty.hash == base.hash
    assert "effects" not in base.model_dump(mode="json")["truth"]["sensor"]
    # the hash that results folders hold of a belief that is told no search range
    assert base.variant("unknown", belief__sensor__disparity=None).hash == "0e4adbb398026474"
    shifted = base.variant("shifted", truth__sensor__effects=[{"kind": "shift", "by": (0.0, 0.0, 1.0)}])
    assert shifted.hash != base.hash
    assert base.variant("object", truth__sensor__effects=[Shift(by=(0.0, 0.0, 1.0))]).hash == shifted.hash
    assert cs.Scenario.model_validate(shifted.model_dump(mode="json")).hash == shifted.hash
    assert shifted.variant("back", truth__sensor__effects=()).hash == base.hash


# --- order ------------------------------------------------------------------------------------------


def test_effects_are_applied_in_order_and_before_the_search_range(small):
    wide = {"truth__sensor__disparity": (1e-6, 1e6)}
    plain = cs.simulate(with_effects(small, **wide))
    shift, scale = {"kind": "shift", "by": (0.0, 0.0, 5.0)}, {"kind": "scale", "factor": 2.0}
    both = cs.simulate(with_effects(small, shift, {**shift, "name": "again"}, scale, **wide))
    assert CALLS == ["scale", "shift", "again"]
    sigma = np.array(cs.load_scenario("herath2007-stereo").truth.sensor.sigma)
    rng = np.random.default_rng(np.random.SeedSequence(0, spawn_key=(0, 1)))
    noise = rng.standard_normal((len(plain.z), 3)) * sigma
    assert np.allclose(both.z, 2.0 * (plain.z - noise) + noise + [0.0, 0.0, 10.0], rtol=0, atol=1e-9)
    found = cs.simulate(with_effects(small, FIRST, shift, truth__sensor__disparity=(10.0, 20.0)))
    expected = plain.z[:, 2] + 5.0
    assert np.array_equal(found.landmark, plain.landmark[(expected >= 10.0) & (expected <= 20.0)])


@pytest.mark.parametrize("noise_on, times", [("odometry", 0), ("motion", 3)])
def test_what_is_the_same_in_every_run_is_done_once(small, noise_on, times):
    scale = {"kind": "scale", "factor": 2.0}
    world = World(with_effects(small, scale, truth__motion__noise_on=noise_on).truth)
    alone = World(with_effects(small, scale, truth__motion__noise_on=noise_on).truth)
    CALLS.clear()
    trials = [world.trial(run, 0) for run in range(3)]
    assert len(CALLS) == times
    assert np.array_equal(trials[2].z, alone.trial(2, 0).z)
    assert not np.array_equal(trials[1].z[:9], trials[2].z[:9])


# --- random numbers -----------------------------------------------------------------------------------


def test_the_purpose_of_a_name_never_changes():
    """Results that are kept depend on it."""
    assert purpose_of("noise") == 1
    assert purpose_of("bias") == 18034705287583516686  # the first 8 bytes of its SHA-256
    assert len({purpose_of(name) for name in ("bias", "first", "second", "ghosts")}) == 4


def test_random_numbers_of_an_effect_depend_on_its_name_alone(small):
    def drawn(*effects, run=0, seed=0):
        DRAWN.clear()
        cs.simulate(with_effects(small, *effects), run, seed)
        return dict(DRAWN)

    both = drawn(FIRST, SECOND)
    assert np.array_equal(drawn(FIRST)["first"], both["first"])
    assert np.array_equal(drawn(SECOND, FIRST)["first"], both["first"])
    assert np.array_equal(drawn({"kind": "ghosts", "count": 3, "length": 5}, SECOND)["second"], both["second"])
    rng = np.random.default_rng(np.random.SeedSequence(4, spawn_key=(7, purpose_of("first"))))
    assert np.array_equal(drawn(FIRST, run=7, seed=4)["first"], rng.standard_normal(5))
    others = [both["second"], drawn(FIRST, run=1)["first"], drawn(FIRST, seed=1)["first"]]
    assert all(not np.array_equal(other, both["first"]) for other in others)


def test_an_effect_that_says_it_draws_nothing_gets_nothing(small):
    with pytest.raises(TypeError, match="'silent' says draws = False and asks for random numbers"):
        cs.simulate(with_effects(small, {"kind": "silent"}))


# --- things that are not landmarks ------------------------------------------------------------------------

GHOSTS = {"kind": "ghosts", "count": 4, "length": 12}


def test_things_have_ids_of_their_own_and_labels(small):
    plain, trial = cs.simulate(with_effects(small), 1), cs.simulate(with_effects(small, GHOSTS), 1)
    N = len(plain.landmarks)
    assert plain.source is None
    assert plain.n_landmarks == N
    assert not plain.spurious.any()
    assert len(plain.things) == 0
    assert trial.n_landmarks == N + 4
    assert list(trial.things) == [N, N + 1, N + 2, N + 3]
    assert np.array_equal(trial.spurious, trial.landmark >= N)
    assert trial.spurious.sum() == 4 * 12
    assert np.all(trial.source[trial.spurious] == -1)
    real = ~trial.spurious
    assert np.array_equal(trial.source[real], plain.landmark)
    assert np.array_equal(trial.z[real], plain.z)
    assert np.array_equal(trial.step[real], plain.step)
    assert np.array_equal(trial.landmarks, plain.landmarks)
    for step in range(1, trial.steps + 1):
        assert np.all(np.diff(trial.observation(step).landmarks) > 0)
    with pytest.raises(ValueError, match="read-only"):
        trial.source[0] = 0


def test_two_effects_do_not_share_ids(small):
    trial = cs.simulate(with_effects(small, GHOSTS, {**GHOSTS, "name": "more", "count": 2}))
    assert trial.n_landmarks == len(trial.landmarks) + 6
    assert len(trial.things) == 6
    assert np.all(np.bincount(trial.landmark)[trial.things] == 12)


def test_a_mismatch_keeps_its_id_and_says_what_it_is_of(small):
    plain, trial = cs.simulate(with_effects(small)), cs.simulate(with_effects(small, {"kind": "mistaken"}))
    row = np.flatnonzero(trial.spurious)
    assert len(row) > 3
    assert np.array_equal(trial.landmark, plain.landmark)
    assert np.array_equal(trial.source[row], plain.landmark[row + 1])
    assert np.array_equal(trial.z[row], plain.z[row + 1])
    assert trial.n_landmarks == plain.n_landmarks


def test_things_that_are_never_found_leave_no_label(small):
    trial = cs.simulate(with_effects(small, GHOSTS, truth__sensor__disparity=(20.0, 32.0)))
    assert trial.source is None
    assert "source" not in observations_table([trial])


def test_a_filter_takes_a_thing_for_a_landmark(small):
    scenario = with_effects(small, GHOSTS, truth__steps=80)
    trial, filter_ = cs.simulate(scenario, run=1), cs.get_filter("ekf-uvd")
    kernel, twin = filter_.run(trial, scenario.belief), step_through(filter_.textbook, trial, scenario.belief)
    assert kernel.failure is None
    assert np.abs(kernel.pose - twin.pose).max() < 1e-9
    assert np.array_equal(kernel.nis_dof, twin.nis_dof)
    clean = filter_.run(cs.simulate(with_effects(small, truth__steps=80), run=1), scenario.belief)
    first = np.diff(trial.first)
    assert np.nansum(kernel.nis_dof) > np.nansum(clean.nis_dof)
    assert np.abs(kernel.pose - clean.pose).max() > 1e-3
    assert first.max() > 0


# --- files ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("effect", [GHOSTS, {"kind": "mistaken"}])
def test_labels_go_through_a_log(small, tmp_path, effect):
    scenario = with_effects(small, effect)
    simulate_log(scenario, runs=2, seed=5, out=tmp_path / "log")
    table = pd.read_parquet(tmp_path / "log" / "observations.parquet")
    assert table.columns[-1] == "source"
    log = read_log(tmp_path / "log")
    for trial in log.trials:
        original = cs.simulate(scenario, trial.run, seed=5)
        assert np.array_equal(trial.spurious, original.spurious)
        assert np.array_equal(trial.source == -1, original.source == -1)
        assert len(trial.things) == len(original.things)
        assert np.all(trial.things >= len(trial.landmarks))
        own = trial.source >= 0
        assert np.array_equal(trial.landmarks[trial.source[own]], original.landmarks[original.source[own]])
    direct = cs.run_trials(scenario, ["ekf-uvd"], runs=2, seed=5, jobs=1)
    logged = run_log(log, ["ekf-uvd"], jobs=1)
    pd.testing.assert_frame_equal(logged.estimates, direct.estimates, check_exact=True)


def test_a_run_without_spurious_rows_is_labelled_with_the_others(small):
    """Runs of one table: where one has labels, those of the others are the landmarks themselves."""
    trials = [cs.simulate(with_effects(small)), cs.simulate(with_effects(small, GHOSTS), 1)]
    table = observations_table(trials)
    assert np.array_equal(table["source"], np.concatenate([trials[0].landmark, trials[1].source]))


@pytest.fixture
def labelled(small, tmp_path):
    simulate_log(with_effects(small, GHOSTS), runs=1, seed=0, out=tmp_path / "log")
    return tmp_path / "log"


def change(folder, **columns):
    path = folder / "observations.parquet"
    pd.read_parquet(path).assign(**columns).to_parquet(path)


def test_a_log_without_positions_knows_landmarks_by_their_labels(labelled):
    with_positions = read_log(labelled).trials[0]
    (labelled / "landmarks.parquet").unlink()
    trial = read_log(labelled).trials[0]
    assert trial.landmarks is None
    assert np.array_equal(trial.source, with_positions.source)
    assert np.array_equal(trial.things, with_positions.things)


def test_things_of_a_log_may_have_any_number(labelled):
    """Also one that lies between those of landmarks: ids of things come last all the same."""
    before = read_log(labelled).trials[0]
    table = pd.read_parquet(labelled / "observations.parquet")
    free = sorted(set(range(120)) - set(table["landmark"]))[0]
    landmarks = pd.read_parquet(labelled / "landmarks.parquet")
    landmarks[landmarks["landmark"] != free].to_parquet(labelled / "landmarks.parquet")
    change(labelled, landmark=lambda t: t["landmark"].replace({120: free}))
    after = read_log(labelled).trials[0]
    assert np.array_equal(before.source, after.source)
    assert np.array_equal(before.things, after.things)
    assert np.array_equal(before.landmarks, after.landmarks)


BAD_LABELS = {
    "below -1": ({"source": lambda t: t["source"].where(t.index != 3, -2)}, r"row 3: .* a source is one of them or -1"),
    "negative landmark": ({"landmark": lambda t: t["landmark"].where(t.index != 4, -7)}, r"row 4: .*numbered from 0"),
    "half": ({"source": lambda t: t["source"].astype(float).where(t.index != 2, 0.5)}, r"'source', row 2: not a whole"),
    "unknown": ({"source": lambda t: t["source"].where(t.index != 3, 999)}, r"landmark 999 of observations.parquet is"),
}


@pytest.mark.parametrize("case", BAD_LABELS)
def test_bad_labels_are_refused(labelled, case):
    columns, complaint = BAD_LABELS[case]
    change(labelled, **columns)
    with pytest.raises(cs.InputError, match=complaint):
        read_log(labelled)


def test_a_linear_log_holds_landmarks_only(linear, tmp_path):
    simulate_log(linear, runs=1, seed=0, out=tmp_path / "log")
    change(
        tmp_path / "log",
        source=lambda t: t["landmark"].where(t.index > 0, -1),
        landmark=lambda t: t["landmark"].where(t.index > 0, 500),
    )
    with pytest.raises(cs.InputError, match=r"observations\.parquet: column 'landmark': 500 is not a landmark"):
        read_log(tmp_path / "log")


# --- mistakes ---------------------------------------------------------------------------------------------

SHIFT = {"kind": "shift", "by_px": [0.0, 0.0, 1.0]}
OWN = {"broken", "draw", "ghosts", "mistaken", "scale", "shift", "silent"}
ALL = ", ".join(f"'{kind}'" for kind in sorted(OWN | set(EFFECTS)))
MISTAKES = {
    "unknown kind": ([{"kind": "blur"}], rf"\.effects\.0\.kind': 'blur' is not one of .*{ALL}"),
    "no kind": ([{"by_px": [0.0, 0.0, 1.0]}], r"\.effects\.0\.kind': missing; it must be given"),
    "kind is a list": ([{"kind": ["shift"]}], r"\.effects\.0\.kind': .* is not one of"),
    "kind of every sensor": ([{"kind": "noise"}], r"\.effects\.0\.kind': 'noise' is not one of"),
    "no table": ([3], r"\.effects\.0': an effect is a table that begins with \[\[truth\.sensor\.effects\]\]"),
    "no list": (SHIFT, r"\.effects': a list of tables, each of which begins with \[\[truth\.sensor\.effects\]\]"),
    "unknown key": ([SHIFT | {"colour": 1}], r"\.effects\.0\.colour': unknown key; allowed here: kind, name, by$"),
    "unknown key of the second": (
        [SHIFT, {"kind": "scale", "by": 1}],
        r"\.effects\.1\.by': .*here: kind, name, factor",
    ),
    "wrong unit": (
        [{"kind": "shift", "by_m": [0.0, 0.0, 1.0]}],
        r"\.effects\.0\.by_m': unknown key; allowed here: kind",
    ),
    "the same twice": (
        [SHIFT, SHIFT],
        r"': the name 'shift' of an effect is taken; give each a 'name' of its own",
    ),
    "name of the noise": ([SHIFT | {"name": "noise"}], r"': the name 'noise' of an effect is taken"),
    "no name": ([SHIFT | {"name": ""}], r"\.effects\.0\.name': .*at least 1 character"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_is_answered_with_file_and_key(tmp_path, case):
    effects, complaint = MISTAKES[case]
    with pytest.raises(cs.InputError, match=r"mine\.toml: key 'truth\.sensor" + complaint) as e:
        load(tmp_path, put("truth.sensor.effects", effects))
    assert "\n" not in str(e.value)


def test_an_effect_is_read_with_units_and_name(tmp_path):
    scenario = load(tmp_path, put("truth.sensor.effects", [SHIFT, SHIFT | {"name": "again"}]))
    assert scenario.truth.sensor.effects == (
        Shift(by=(0.0, 0.0, 1.0)),
        Shift(by=(0.0, 0.0, 1.0), name="again"),
    )


BROKEN = {
    "shape": r"finite values of shape \(\d+, 3\)",
    "NaN": r"finite values",
    "step zero": "steps from 1 to 60",
    "step beyond": "steps from 1 to 60",
    "twice": "each landmark once in a step",
    "order": ".* in order of step and landmark",
}


@pytest.mark.parametrize("mistake", BROKEN)
def test_an_effect_with_a_mistake_is_named(small, mistake):
    with pytest.raises(ValueError, match=f"the effect 'broken' must give {BROKEN[mistake]}"):
        cs.simulate(with_effects(small, {"kind": "broken", "mistake": mistake}, name="herath2007-xyz"))


def test_a_linear_world_has_no_room_for_things(small):
    scenario = with_effects(small, {"kind": "broken", "mistake": "thing"}, name="linear-gaussian")
    with pytest.raises(cs.InputError, match=r"'broken' \(truth\.sensor\.effects\).* use the model 'xyz' or 'uvd'"):
        cs.simulate(scenario)


def test_effects_may_bring_a_world_into_the_search_range(small):
    far = {"truth__sensor__disparity": (100.0, 132.0)}
    with pytest.raises(cs.InputError, match="no landmark comes into view"):
        cs.run_trials(with_effects(small, **far), ["ekf-uvd"], runs=1)
    shift = {"kind": "shift", "by": (0.0, 0.0, 100.0)}
    assert len(cs.run_trials(with_effects(small, shift, **far), ["ekf-uvd"], runs=1, jobs=1).estimates)
