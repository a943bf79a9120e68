"""Scenario files: what is read, and what every kind of mistake is answered with."""

import re

import numpy as np
import pytest
from pydantic import ValidationError
from scenario_files import drop, load, put

import consistency as cs
from consistency.bench.scenario import scenario_text

EXPECTED = {
    "esde-xy", "iekf-slam-xy", "ocekf-slam-xy", "range-bearing",
    "herath2007-optimistic", "herath2007-stereo", "herath2007-wide-baseline", "herath2007-xyz", "linear-gaussian",
    "long-loop",
    *(f"herath2007-{issue}" for issue in ("bias", "drift", "fov", "growth", "junction", "mismatch", "selection")),
}  # fmt: skip


# --- what is read --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_every_built_in_scenario_loads_and_shows_a_landmark(name):
    scenario = cs.load_scenario(name)
    assert scenario.name == name
    assert scenario.summary
    assert len(cs.simulate(scenario.variant("short", truth__steps=30)).z) > 0


def test_by_path_a_scenario_is_named_after_its_file(tmp_path):
    scenario = load(tmp_path)
    assert scenario.name == "mine"
    assert scenario.truth == cs.load_scenario("herath2007-stereo").truth


def test_units_become_si(tmp_path):
    degrees = load(tmp_path)
    assert degrees.truth.motion.sigma_omega == pytest.approx(np.deg2rad(5.0), rel=1e-15)
    assert degrees.truth.path.heading == pytest.approx(np.pi / 2)
    radians = load(
        tmp_path,
        drop("truth.motion.sigma_omega_deg"), put("truth.motion.sigma_omega", np.deg2rad(5.0)),
        drop("truth.path.radius_m"), put("truth.path.radius", 4.0),
        drop("truth.sensor.f_px"), put("truth.sensor.f", 150.0),
    )  # fmt: skip
    assert radians.truth == degrees.truth


def test_degrees_reach_into_lists(tmp_path):
    mount = {"position_m": [0.1, 0.0, 0.2], "rotation_deg": [0.0, -10.0, 90.0]}
    scenario = load(tmp_path, put("belief.sensor.mount", mount))
    assert np.allclose(scenario.belief.sensor.mount.rotation, np.deg2rad([0.0, -10.0, 90.0]))


# --- identity ------------------------------------------------------------------------------------


def test_hash_follows_content_only(tmp_path):
    base = cs.load_scenario("herath2007-stereo")
    assert load(tmp_path, put("summary", "told differently")).hash == base.hash
    assert base.variant("renamed").hash == base.hash
    others = [
        base.variant("a", truth__steps=499),
        base.variant("b", belief__motion__sigma_v=0.051),
        base.variant("c", truth__landmarks__seed=1),
        base.variant("d", belief__sigma_points__alpha=0.5),
    ]
    assert len({base.hash, *(other.hash for other in others)}) == 5
    assert re.fullmatch("[0-9a-f]{16}", base.hash)


def test_hash_does_not_depend_on_the_order_or_the_unit_of_keys(tmp_path):
    base = cs.load_scenario("herath2007-stereo")

    def reverse(data):
        data["truth"] = dict(reversed(data["truth"].items()))

    assert load(tmp_path, reverse).hash == base.hash


def test_variant_changes_what_is_named_and_nothing_else():
    base = cs.load_scenario("herath2007-stereo")
    far = base.variant("far", truth__sensor__range=(0.5, 8.0))
    assert far.name == "far"
    assert far.truth.sensor.range == (0.5, 8.0)
    assert base.truth.sensor.range == (0.5, 4.0)
    assert far.variant("back", truth__sensor__range=(0.5, 4.0)).truth == base.truth


@pytest.mark.parametrize("key", ["truth__sensor__rnage", "truth__nothing__here", "truth__motion__sigma_v__x"])
def test_variant_refuses_a_path_that_is_not_there(key):
    with pytest.raises((ValidationError, KeyError, TypeError, ValueError)):
        cs.load_scenario("herath2007-stereo").variant("typo", **{key: 1.0})


def test_variant_is_validated():
    with pytest.raises(ValueError, match="sigma_v"):
        cs.load_scenario("herath2007-stereo").variant("bad", truth__motion__sigma_v=-1.0)


def test_scenario_is_frozen():
    scenario = cs.load_scenario("herath2007-stereo")
    with pytest.raises(ValidationError, match="frozen"):
        scenario.truth.steps = 3  # type: ignore[misc]


# --- mistakes ------------------------------------------------------------------------------------

UNKNOWN = {
    "colour": ["summary", "truth", "belief"],
    "truth.colour": ["dt", "steps", "path", "landmarks", "motion", "sensor"],
    "truth.path.colour": ["radius", "speed", "start", "heading", "shape"],
    "truth.landmarks.colour": ["count", "seed", "x", "y", "z", "layout"],
    "truth.motion.colour": ["model", "sigma_v", "sigma_omega", "noise_on"],
    "truth.sensor.colour": ["B", "disparity", "f", "image", "principal_point", "range", "sigma", "mount"],
    "belief.colour": ["motion", "sensor", "sigma_points"],
    "belief.motion.colour": ["sigma_v", "sigma_omega"],
    "belief.sensor.colour": ["model", "sigma", "f", "B", "mount"],
}


@pytest.mark.parametrize("key", UNKNOWN)
def test_unknown_key_is_named_with_what_is_allowed_there(tmp_path, key):
    with pytest.raises(cs.InputError) as error:
        load(tmp_path, put(key, 1))
    text = str(error.value)
    assert f"key '{key}'" in text
    assert "mine.toml" in text
    allowed = text.split("allowed here: ")[1].split(", ")
    assert set(UNKNOWN[key]) <= set(allowed)
    assert "name" not in allowed


@pytest.mark.parametrize("where", ["truth.sensor.mount", "belief.sensor.mount", "belief.sigma_points"])
def test_unknown_key_in_a_nested_table(tmp_path, where):
    with pytest.raises(cs.InputError, match=rf"mine\.toml: key '{where}\.colour': unknown key; allowed here: "):
        load(tmp_path, put(where, {"colour": 1}))


BAD = {
    "negative motion noise": ((put("truth.motion.sigma_v", -0.1),), r"'truth\.motion\.sigma_v'.*greater than or equal"),
    "negative belief": ((put("belief.motion.sigma_v", -0.1),), r"'belief\.motion\.sigma_v'"),
    "zero sensor noise": ((put("belief.sensor.sigma_px", [0.0, 1.0, 1.0]),), r"'belief\.sensor\.sigma\.0'.*greater"),
    "two sigmas": ((put("belief.sensor.sigma_px", [1.0, 1.0]),), r"'belief\.sensor\.sigma"),
    "noise is not a number": ((put("truth.motion.sigma_v", float("nan")),), r"'truth\.motion\.sigma_v'.*finite"),
    "infinite range": ((put("truth.sensor.range_m", [0.5, float("inf")]),), r"'truth\.sensor\.range\.1'.*finite"),
    "missing key": ((drop("truth.dt_s"),), r"'truth\.dt': missing"),
    "missing table": ((drop("belief"),), r"'belief': missing"),
    "missing shape": ((drop("truth.path.shape"),), r"'truth\.path\.shape': missing"),
    "wrong type": ((put("truth.steps", "many"),), r"'truth\.steps'.*integer.*'many'"),
    "half a step": ((put("truth.steps", 10.5),), r"'truth\.steps'.*integer"),
    "no step": ((put("truth.steps", 0),), r"'truth\.steps'.*greater than 0"),
    "table in place of a number": ((put("truth.dt_s", {"x": 1}),), r"'truth\.dt'"),
    "number in place of a table": ((put("truth.motion", 3),), r"'truth\.motion'"),
    "both units": ((put("truth.motion.sigma_omega", 0.1),), r"'truth\.motion'.*'sigma_omega'.*given twice"),
    "unknown shape": ((put("truth.path.shape", "spiral"),), r"'truth\.path\.shape': 'spiral'.*'circle'.*'waypoints'"),
    "unknown layout": ((put("truth.landmarks.layout", "grid"),), r"'truth\.landmarks\.layout': 'grid'.*'uniform'"),
    "unknown sensor": ((put("truth.sensor.model", "lidar"),), r"'truth\.sensor\.model': 'lidar'.*'xyz'.*'uvd'"),
    "unknown noise target": ((put("truth.motion.noise_on", "wheel"),), r"'truth\.motion\.noise_on'.*'odometry'"),
    "sensors differ": (
        (put("belief.sensor.model", "xyz"), drop("belief.sensor.sigma_px"), put("belief.sensor.sigma", [0.1] * 3)),
        r"belief\.sensor\.model is 'xyz'.*'uvd' \(truth\.sensor\.model\)",
    ),
    "rig unknown": ((drop("belief.sensor.B_m"),), r"'belief\.sensor'.*needs f \(px\) and B \(m\)"),
    "unit of another sensor": (
        (drop("belief.sensor.sigma_px"), put("belief.sensor.sigma_m", [0.1, 0.1, 0.1])),
        r"'belief\.sensor\.sigma_m'.*unknown key",
    ),
    "unit of another key": ((put("truth.path.speed_deg", 28.6),), r"'truth\.path\.speed_deg'.*unknown key"),
    "range reversed": ((put("truth.sensor.range_m", [4.0, 0.5]),), r"'truth\.sensor'.*range must be"),
    "box reversed": ((put("truth.landmarks.x_m", [8.0, -8.0]),), r"'truth\.landmarks'.*x must be \[low, high\]"),
    "negative disparity": ((put("truth.sensor.disparity_px", [-1.0, 32.0]),), r"'truth\.sensor\.disparity\.0'"),
    "half a linear world": ((put("truth.motion.model", "linear"),), r"'truth'.*'linear' together"),
    "disparity reversed": ((put("truth.sensor.disparity_px", [32.0, 1.0]),), r"disparity"),
    "true is not a number": ((put("truth.motion.sigma_v", True),), r"truth\.motion\.sigma_v"),
    "text is not a number": ((put("truth.motion.sigma_v", "0.1"),), r"truth\.motion\.sigma_v"),
    "name inside": ((put("name", "other"),), r"'name': not allowed here"),
    "corner too round": (
        (
            drop("truth.path.radius_m"), put("truth.path.shape", "rounded-rectangle"), put("truth.path.length", 4.0),
            put("truth.path.width", 2.0), put("truth.path.corner_radius", 1.5),
        ),
        r"'truth\.path'.*corner_radius must be at most half",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_mistake_is_answered_with_file_and_key(tmp_path, case):
    edits, pattern = BAD[case]
    with pytest.raises(cs.InputError, match=pattern) as error:
        load(tmp_path, *edits)
    text = str(error.value)
    assert text.startswith(str(tmp_path / "mine.toml"))
    assert "\n" not in text


@pytest.mark.parametrize(
    "name, edit, complaint",
    [
        ("linear-gaussian", put("truth.motion.noise_on", "odometry"), "noise_on = 'motion'"),
        ("herath2007-xyz", drop("truth.sensor.f_px"), r"'truth\.sensor'.*image needs f"),
    ],
)
def test_what_another_world_needs(tmp_path, name, edit, complaint):
    with pytest.raises(cs.InputError, match=complaint):
        load(tmp_path, edit, name=name)


@pytest.mark.parametrize(
    "content, complaint",
    [
        (b"summary = 'x'\n[truth\n", "not valid TOML.*line 2"),
        (b"\xff\xfe\x00\x01", "not valid TOML"),
        (None, r"cannot be read \(No such file"),
    ],
)
def test_a_file_that_is_no_table(tmp_path, content, complaint):
    if content is not None:
        (tmp_path / "broken.toml").write_bytes(content)
    with pytest.raises(cs.InputError, match=rf"broken\.toml: {complaint}"):
        cs.load_scenario(tmp_path / "broken.toml")


def test_unknown_name_with_a_suggestion():
    with pytest.raises(cs.InputError, match=r"unknown scenario 'herath2007-stero' \(did you mean 'herath2007-stereo'"):
        cs.load_scenario("herath2007-stero")
    with pytest.raises(cs.InputError, match="unknown scenario 'zzz'; known: esde-xy, herath2007-bias, "):
        cs.load_scenario("zzz")


def test_effects_are_told_the_search_range_of_a_stereo_sensor_alone():
    stereo, xyz = (cs.load_scenario(name).truth.sensor for name in ("herath2007-stereo", "herath2007-xyz"))
    assert stereo.search_range == stereo.disparity
    assert stereo.search_range[0] < stereo.search_range[1]
    assert xyz.search_range is None


@pytest.mark.parametrize("name", cs.scenario_names())
def test_a_written_scenario_is_read_as_the_same(name, tmp_path):
    scenario = cs.load_scenario(name)
    (tmp_path / "again.toml").write_text(scenario_text(scenario, "two\nlines"), encoding="utf-8")
    again = cs.load_scenario(tmp_path / "again.toml")
    assert (again.hash, again.summary, again.name) == (scenario.hash, scenario.summary, "again")


def test_every_kind_of_path_landmarks_and_mount_is_written(tmp_path):
    """Lists in lists, a mount, and a key that is not given."""
    scenario = cs.load_scenario("herath2007-stereo").variant(
        "odd",
        truth__path={
            "shape": "waypoints", "points": [(4.0, 0.5), (-1e-7, 2e22)], "turn_rate": 0.5, "start": (0.0, 0.0),
            "heading": 0.1, "speed": 0.5,
        },
        truth__landmarks={"layout": "listed", "points": [(1.0, 2.0, 3.0), (4.0, 5.0, 6.5)]},
        truth__sensor__mount={"position": (0.1, 0.0, 0.2), "rotation": (0.0, 0.0, 0.3)},
        belief__sensor__disparity=None,
    )  # fmt: skip
    text = scenario_text(scenario)
    (tmp_path / "odd.toml").write_text(text, encoding="utf-8")
    assert cs.load_scenario(tmp_path / "odd.toml").hash == scenario.hash
    assert "position = [0.1, 0.0, 0.2]" in text
    assert text.startswith("summary")


def test_every_wrong_key_is_named(tmp_path):
    changes = {"sensor.colour": 1, "motion.sigma_v": -1.0, "steps": 0}
    with pytest.raises(cs.InputError) as error:
        load(tmp_path, *(put(f"truth.{key}", value) for key, value in changes.items()))
    for key in changes:
        assert f"key 'truth.{key}': " in str(error.value)
    assert "more)" not in str(error.value)
