"""Bias maps and what makes them: a table over the image, an effect, a belief, and the distortion of two cameras."""

import numpy as np
import pytest
from scenario_files import load, put
from scipy.interpolate import RegularGridInterpolator

import consistency as cs
from consistency.bench.runs.montecarlo import simulate_log
from consistency.bench.scenario import BiasMap
from consistency.bench.scenario.effects import Distortion, LocalBias
from consistency.bench.simulation import World
from consistency.bench.store.recorded_log import read_log
from consistency.scenario import scenario_text

U, V = [-150.0, -40.0, 30.0, 160.0], [-100.0, 10.0, 90.0]
D = [[0.5, -1.0, 0.2, 2.0], [0.0, 0.3, -0.4, 1.0], [-2.0, 0.7, 0.1, -0.6]]
W = [[0.1, 0.0, 0.0, -0.3], [0.2, 0.4, 0.0, 0.0], [0.0, 0.0, -0.5, 0.0]]
MAP = {"u_px": U, "v_px": V, "bias_v_px": W, "bias_d_px": D}
BIAS = {"kind": "local-bias", **MAP}
WIDE = {"truth__sensor__disparity": (1e-6, 1e6)}


def ideal_of(scenario, trial):
    return World(scenario.truth).context(trial.truth).measure(trial.step, trial.landmark)


def test_a_map_is_bilinear_between_its_nodes_and_constant_beyond(rng):
    """SciPy's interpolation on a regular grid is the oracle."""
    bias = BiasMap.model_validate(MAP)
    u, v = rng.uniform(-220.0, 220.0, (2, 40, 5))
    inside = np.stack([np.clip(v, V[0], V[-1]), np.clip(u, U[0], U[-1])], axis=-1)
    expected = [np.zeros(u.shape), *(RegularGridInterpolator((V, U), np.array(table))(inside) for table in (W, D))]
    assert np.allclose(bias.at(u, v), np.stack(expected, axis=-1), rtol=0, atol=1e-12)
    assert np.allclose(bias.at(np.array(U)[None], np.array(V)[:, None])[..., 2], D, rtol=0, atol=1e-15)
    assert np.allclose(bias.at(np.float64(30.0), np.float64(500.0)), [0.0, -0.5, 0.1])


def test_one_node_is_a_constant():
    bias = BiasMap.model_validate({"u_px": [0.0], "v_px": [-10.0, 10.0], "bias_d_px": [[1.0], [3.0]]})
    assert np.allclose(bias.at(np.array([-99.0, 99.0]), np.array([0.0, 5.0])), [[0, 0, 2.0], [0, 0, 2.5]])


@pytest.mark.parametrize("noise_on", ["odometry", "motion"])
def test_the_effect_adds_the_bias_of_the_ideal_pixel(small, noise_on):
    plain = small("herath2007-stereo", truth__motion__noise_on=noise_on, **WIDE)
    biased = plain.variant("biased", truth__sensor__effects=[BIAS])
    a, b = cs.simulate(plain, 1), cs.simulate(biased, 1)
    ideal = ideal_of(plain, a)
    expected = BiasMap.model_validate(MAP).at(ideal[:, 0], ideal[:, 1])
    assert np.abs(expected[:, 2]).max() > 1.0
    assert np.array_equal(a.landmark, b.landmark)
    assert np.allclose(b.z - a.z, expected, rtol=0, atol=1e-12)
    at_measured = BiasMap.model_validate(MAP).at(b.z[:, 0], b.z[:, 1])
    assert not np.allclose(b.z - a.z, at_measured, rtol=0, atol=1e-3)  # negative control
    assert b.source is None


def test_an_effect_gives_the_map_that_a_belief_holds(small):
    effect = LocalBias.model_validate(BIAS)
    scenario = small("herath2007-stereo", belief__sensor__bias=effect.map())
    assert scenario.belief.sensor.bias == BiasMap.model_validate(MAP)


def test_a_believed_map_goes_through_files(small, tmp_path):
    scenario = small("herath2007-stereo", belief__sensor__bias=MAP)
    assert scenario.hash != small("herath2007-stereo").hash
    (tmp_path / "mine.toml").write_text(scenario_text(scenario), encoding="utf-8")
    assert cs.load_scenario(tmp_path / "mine.toml").hash == scenario.hash
    simulate_log(scenario, runs=1, seed=0, out=tmp_path / "log")
    assert read_log(tmp_path / "log").belief == scenario.belief


MISTAKES = {
    "a row too few": ({"bias_d_px": D[:2]}, r"bias_d must have 3 rows.* of 4 numbers.*; got 2 of 4$"),
    "a column too many": ({"bias_v_px": [[*row, 0.0] for row in W]}, r"bias_v must have 3 rows.*; got 3 of 5$"),
    "ragged": ({"bias_d_px": [D[0], D[1], D[2][:3]]}, r"bias_d must have .*; got 3 of 3 and 4$"),
    "not increasing": ({"u_px": U[::-1]}, r"u must increase from each number to the next, got \[160\.0"),
    "twice the same": ({"v_px": [0.0, 0.0, 1.0]}, r"v must increase from each number to the next"),
    "not finite": ({"u_px": [*U[:3], float("nan")]}, r"u\.3': .*finite"),
    "no matrix": ({"bias_d_px": [], "bias_v_px": []}, r"give at least one of bias_u, bias_v, bias_d$"),
    "unknown key": ({"bias_x_px": D}, r"bias_x_px': unknown key; allowed here: .*bias_u, bias_v, bias_d"),
}


@pytest.mark.parametrize("half", ["truth", "belief"])
@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_is_answered_with_file_and_key(tmp_path, case, half):
    change, complaint = MISTAKES[case]
    where = r"truth\.sensor\.effects\.0" if half == "truth" else r"belief\.sensor\.bias"
    with pytest.raises(cs.InputError, match=rf"mine\.toml: key '{where}" + ".*" + complaint) as e:
        load(tmp_path, given(half, MAP | change))
    assert "\n" not in str(e.value)


def given(half, table):
    if half == "belief":
        return put("belief.sensor.bias", table)
    return put("truth.sensor.effects", [{"kind": "local-bias", **table}])


def test_points_in_metres_have_no_pixel(tmp_path):
    with pytest.raises(cs.InputError, match=r"'belief\.sensor': bias is of a sensor 'uvd', not 'xyz'"):
        load(tmp_path, given("belief", MAP), name="herath2007-xyz")
    with pytest.raises(
        cs.InputError, match=r"'truth\.sensor': the effect 'local-bias' works on a sensor uvd, not 'xyz'"
    ):
        load(tmp_path, given("truth", MAP), name="herath2007-xyz")


# --- distortion ---------------------------------------------------------------------------------------

LEFT, RIGHT = [0.005, -0.002], [-0.004, 0.001]
DISTORTION = {"kind": "distortion", "left": LEFT, "right": RIGHT}


def test_both_cameras_are_distorted_as_opencv_does_it(small, rng):
    """The oracle is cv2.projectPoints on the points themselves, a camera at a time."""
    cv2 = pytest.importorskip("cv2")
    f, B = 150.0, 0.09
    x, y, up = rng.uniform([0.5, -1.5, -1.0], [5.0, 1.5, 1.0], (50, 3)).T
    K = np.array([[f, 0, 0], [0, f, 0], [0, 0, 1.0]])

    def pixels(y, k):
        points = np.column_stack([-y, -up, x])  # to the right, down, ahead
        return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array([*k, 0.0, 0.0]))[0][:, 0]

    left, right = pixels(y, LEFT), pixels(y + B, RIGHT)
    expected = np.column_stack([left, left[:, 0] - right[:, 0]])
    ideal = np.column_stack([-f * y / x, -f * up / x, f * B / x])
    effect = Distortion.model_validate(DISTORTION)
    assert np.allclose(effect.distorted(ideal, f), expected, rtol=0, atol=1e-9)
    assert np.array_equal(Distortion(left=(0.0, 0.0), right=(0.0, 0.0)).distorted(ideal, f)[:, :2], ideal[:, :2])
    scenario = small("herath2007-stereo", **WIDE)
    a, b = cs.simulate(scenario), cs.simulate(scenario.variant("d", truth__sensor__effects=[DISTORTION]))
    ideal = ideal_of(scenario, a)
    assert np.allclose(b.z - a.z, effect.distorted(ideal, f) - ideal, rtol=0, atol=1e-12)


def test_a_belief_may_hold_the_map_of_a_distortion():
    """Exact at its nodes and disparity; at first order k1 = -+ k biases d by 2 k r^2 u less what d itself adds."""
    effect = Distortion(left=(0.005, 0.0), right=(-0.005, 0.0))
    u, v, f = np.linspace(-160.0, 160.0, 9), np.linspace(-120.0, 120.0, 7), 150.0
    bias = effect.bias_map(u, v, disparity=6.0, f=f)
    columns, rows = np.meshgrid(u, v)
    ideal = np.stack([columns, rows, np.full(columns.shape, 6.0)], axis=-1)
    assert np.allclose(ideal + bias.at(columns, rows), effect.distorted(ideal, f), rtol=0, atol=1e-12)
    r2 = (columns**2 + rows**2) / f**2
    assert np.allclose(bias.at(columns, rows)[..., 0], 0.005 * r2 * columns, rtol=0, atol=1e-12)
    beside = columns - 6.0
    right = 0.005 * beside * (beside**2 + rows**2) / f**2
    assert np.allclose(bias.at(columns, rows)[..., 2], 0.005 * r2 * columns + right, rtol=0, atol=1e-12)
