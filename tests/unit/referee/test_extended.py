"""States of SE2(3) with biases, in archives and tables: errors by the exponential of 5 x 5 matrices, NEES by hand."""

import numpy as np
import pytest
from command import consistency
from numpy.testing import assert_allclose
from scipy.linalg import expm
from test_layouts import ASL, lines, nanoseconds, skew

import consistency as cs

RUNS, STEPS = 3, 7


def exponential(phi, p, v):
    """Element of SE2(3) as a matrix (5, 5), columns 3 and 4 velocity and position."""
    generator = np.zeros((5, 5))
    generator[:3, :3], generator[:3, 3], generator[:3, 4] = skew(phi), v, p
    return np.asarray(expm(generator))


def states(convention, n=15):
    """States and truth, the errors (runs, steps, n) put between them, of half a radian and more, and covariances."""
    rng = np.random.default_rng()
    e = 0.5 * rng.normal(size=(RUNS, STEPS, n))
    root = rng.normal(size=(RUNS, STEPS, n, n))
    P = root @ np.swapaxes(root, -1, -2) + np.eye(n)
    keys = {"R": (3, 3), "p": (3,), "v": (3,)} | ({"bg": (3,), "ba": (3,)} if n == 15 else {})
    out = {f"{side}{key}": np.zeros((RUNS, STEPS, *shape)) for key, shape in keys.items() for side in ("", "true_")}
    for at in np.ndindex(RUNS, STEPS):
        phi, *rest = rng.normal(size=(3, 3))
        own = exponential(phi, *rest)
        step = exponential(e[at][:3], e[at][3:6], e[at][6:9])
        if convention in ("left", "right"):
            true = own @ step if convention == "left" else step @ own
        else:
            turn = expm(skew(e[at][:3]))
            true = own.copy()
            true[:3, :3] = turn @ own[:3, :3] if convention == "so3" else own[:3, :3] @ turn
            if convention == "additive":
                angle = np.sqrt(phi @ phi)  # Log(own) is the rotation vector of at most half a turn
                principal = phi * (1.0 - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi)) / angle)
                true[:3, :3] = expm(skew(principal + e[at][:3]))
            true[:3, 4], true[:3, 3] = own[:3, 4] + e[at][3:6], own[:3, 3] + e[at][6:9]
        for side, T in (("", own), ("true_", true)):
            out[f"{side}R"][at], out[f"{side}v"][at], out[f"{side}p"][at] = T[:3, :3], T[:3, 3], T[:3, 4]
        if n == 15:
            for k, key in enumerate(("bg", "ba")):
                out[key][at] = rng.normal(size=3)
                out[f"true_{key}"][at] = out[key][at] + e[at][9 + 3 * k : 12 + 3 * k]
    return out, e, P


def read(path, **arrays):
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize("n", [9, 15])
@pytest.mark.parametrize("convention", ["left", "right", "so3", "so3-body", "additive"])
def test_errors_are_those_put_in(convention, n, tmp_path):
    arrays, e, P = states(convention, n)
    record = cs.read(read(tmp_path / "imu.npz", **arrays, covariances=P), error=convention)
    assert_allclose(record.errors.error, e, atol=1e-9)
    nees = np.einsum("rti,rti->rt", e, np.linalg.solve(P, e[..., None])[..., 0])
    assert_allclose(record.errors.nees, nees, rtol=1e-9)
    assert record.errors.axes[:9] == ("roll", "pitch", "yaw", "x", "y", "z", "vx", "vy", "vz")
    assert record.errors.convention == convention
    assert any(note.startswith(f"error convention {convention}: ") for note in record.origin.notes)


def test_the_additive_error_is_the_others_to_first_order(tmp_path):
    """Jacobians of ``left`` and ``so3`` by the additive error, by complex steps of 1e-30 through the exponential.

    Errors of 1e-5 rad and m: their squares are 1e-5 of them.
    """
    arrays, e, P = states("additive", 9)
    small = {key: array[:1, :1].copy() for key, array in arrays.items()}
    own = np.eye(5)
    own[:3, :3], own[:3, 3], own[:3, 4] = small["R"][0, 0], small["v"][0, 0], small["p"][0, 0]
    phi = np.array(rotation_vector(own[:3, :3]))
    J = {kind: np.zeros((9, 9)) for kind in ("left", "so3")}
    for i in range(9):
        step = np.zeros(9, complex)
        step[i] = 1e-30j
        true = np.eye(5, dtype=complex)
        true[:3, :3] = expm(skew(phi + step[:3]))
        true[:3, 4], true[:3, 3] = own[:3, 4] + step[3:6], own[:3, 3] + step[6:]
        turned = np.linalg.solve(own.astype(complex), true).imag / 1e-30
        world = (true[:3, :3] @ own[:3, :3].T).imag / 1e-30
        J["left"][:, i] = [turned[2, 1], turned[0, 2], turned[1, 0], *turned[:3, 4], *turned[:3, 3]]
        J["so3"][:, i] = [world[2, 1], world[0, 2], world[1, 0], *step[3:].imag / 1e-30]
    tiny = 1e-5 * e[0, 0]
    small["true_R"][0, 0] = expm(skew(phi + tiny[:3]))
    small["true_p"][0, 0], small["true_v"][0, 0] = own[:3, 4] + tiny[3:6], own[:3, 3] + tiny[6:]
    for kind, jacobian in J.items():
        record = cs.read(read(tmp_path / "imu.npz", **small, covariances=P[:1, :1]), error=kind)
        assert_allclose(record.errors.error[0, 0], jacobian @ tiny, rtol=0, atol=1e-8)


def rotation_vector(R):
    """Of a rotation of less than half a turn."""
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = np.sqrt(axis @ axis)
    return np.asarray(axis * np.arctan2(sine, np.trace(R) - 1.0) / sine)


def test_another_order_of_the_covariance(tmp_path):
    """Manif has position, rotation, velocity; one run may lack its dimension."""
    arrays, e, P = states("left", 9)
    turned = [3, 4, 5, 0, 1, 2, 6, 7, 8]
    first = {key: array[0] for key, array in arrays.items()}
    path = read(tmp_path / "imu.npz", **first, covariances=P[0][:, turned][:, :, turned], order=["p", "R", "v"])
    record = cs.read(path, error="left")
    assert_allclose(record.errors.error[0], e[0][:, turned], atol=1e-9)
    assert record.errors.axes == ("x", "y", "z", "roll", "pitch", "yaw", "vx", "vy", "vz")
    assert_allclose(record.errors.nees[0], np.einsum("ti,ti->t", e[0], np.linalg.solve(P[0], e[0][..., None])[..., 0]))


def test_a_state_that_breaks_down_is_a_failure(tmp_path):
    arrays, _, P = states("right")
    arrays["R"][1, 4] = np.nan
    record = cs.read(read(tmp_path / "imu.npz", **arrays, covariances=P), error="right")
    assert [(failure.run, failure.step) for failure in record.failures] == [(1, 5)]


def broken(arrays, key, value):
    changed = dict(arrays)
    if value is None:
        del changed[key]
    else:
        changed[key] = value
    return changed


@pytest.mark.parametrize(
    "key, value, said",
    [
        ("true_v", None, "key 'true_v' is missing, of the true states"),
        ("ba", None, "key 'ba' is missing; there are two biases or none"),
        ("order", ["R", "v", "p"], "key 'order' is R, v, p; must name R, p, v, bg, ba, each once"),
        ("R", np.tile(2.0 * np.eye(3), (RUNS, STEPS, 1, 1)), "key 'R' holds a matrix that is not a rotation"),
        ("true_R", np.tile(np.diag([1.0, 1.0, -1.0]), (RUNS, STEPS, 1, 1)), "key 'true_R' holds a matrix that is no"),
        ("p", np.zeros((RUNS, STEPS, 2)), r"key 'p' has shape \(3, 7, 2\), needs \(runs, steps, 3\)"),
        ("p", np.zeros((STEPS, RUNS, 3)), r"keys 'p' and 'true_p' have shapes \(7, 3, 3\) and \(3, 7, 3\)"),
        ("true_bg", np.full((RUNS, STEPS, 3), np.nan), "key 'true_bg' is not finite"),
        ("covariances", np.tile(np.eye(9), (RUNS, STEPS, 1, 1)), "key 'covariances' has shape"),
    ],
)
def test_what_does_not_fit_is_named(key, value, said, tmp_path):
    arrays, _, P = states("left")
    path = read(tmp_path / "imu.npz", **broken({**arrays, "covariances": P}, key, value))
    with pytest.raises(cs.InputError, match=rf"imu\.npz: {said}"):
        cs.read(path, error="left")


@pytest.mark.parametrize("options", [{}, {"error": "so2"}, {"error": "vector"}])
def test_the_error_has_to_be_declared(options, tmp_path):
    arrays, _, P = states("left")
    with pytest.raises(
        cs.InputError, match=r"whose error is not known; add error=so3, .*, rvec, euler, additive: left"
    ):
        cs.read(read(tmp_path / "imu.npz", **arrays, covariances=P), **options)


def test_windows_are_refused(tmp_path):
    arrays, _, P = states("left")
    with pytest.raises(cs.InputError, match="relative needs"):
        cs.read(read(tmp_path / "imu.npz", **arrays, covariances=P), error="left", relative=2, motions=True)


# --- states in tables -----------------------------------------------------------------------------------------


T = 1403715273.25 + 0.25 * np.arange(STEPS)
POSE = ["x", "y", "z", "qw", "qx", "qy", "qz"]
MOVING = ["vx", "vy", "vz", "bgx", "bgy", "bgz", "bax", "bay", "baz"]
LABELS = ["x", "y", "z", "roll", "pitch", "yaw", *MOVING]


def position_first(arrays, e, P):
    """States with errors (N, n) and covariances (N, n, n) of the first run."""
    places = [3, 4, 5, 0, 1, 2, *range(6, P.shape[-1])]
    return arrays, e[0][:, places], P[0][:, places][:, :, places]


def w_first(R):
    """Unit quaternions (N, 4) of rotations, by the largest of the four (Shepperd 1978)."""
    out = []
    for M in R:
        squares = np.array([np.trace(M), *np.diag(M)])
        k = int(np.argmax(squares))
        q = np.zeros(4)
        if k == 0:
            q = np.array([1.0 + squares[0], M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])
        else:
            i, j, m = k - 1, k % 3, (k + 1) % 3
            q[0], q[k] = M[m, j] - M[j, m], 1.0 + M[i, i] - M[j, j] - M[m, m]
            q[j + 1], q[m + 1] = M[j, i] + M[i, j], M[m, i] + M[i, m]
        out.append(q / np.sqrt(q @ q))
    return np.array(out)


def columns(arrays, true=False):
    """Position, quaternion w first, velocity and biases of the first run."""
    side = "true_" if true else ""
    parts = [arrays[f"{side}{key}"][0] for key in ("v", "bg", "ba") if f"{side}{key}" in arrays]
    return [*np.column_stack([arrays[f"{side}p"][0], w_first(arrays[f"{side}R"][0]), *parts]).T]


def named(arrays):
    true = columns(arrays, true=True)
    return lines("truth.csv", ",".join(["t", *POSE, *MOVING][: 1 + len(true)]), [T, *true])


def stated(n, form):
    """Names of the columns of a covariance."""
    i, j = np.triu_indices(n)
    return {
        "named": [f"P_{LABELS[a]}_{LABELS[b]}" for a, b in zip(i, j, strict=True)],
        "upper": [f"cov{k}" for k in range(len(i))],
        "full": [f"covariance_{k}" for k in range(n * n)],
        "deviations": [f"sigma_{LABELS[a]}" for a in range(n)],
    }[form]


def table(arrays, P, form):
    """The first run with covariances (N, n, n) in some form."""
    n, own = P.shape[-1], columns(arrays)
    i, j = np.triu_indices(n)
    numbers = {"full": P.reshape(STEPS, -1), "deviations": np.sqrt(np.diagonal(P, axis1=1, axis2=2))}
    values = numbers.get(form, P[:, i, j])
    return lines("est.csv", ",".join(["t", *POSE, *MOVING[: n - 6], *stated(n, form)]), [T, *own, *values.T])


def nees(e, P):
    return np.array([x @ np.linalg.solve(C, x) for x, C in zip(e, P, strict=True)])


@pytest.mark.parametrize(
    "kind, form, n",
    [
        *((kind, "named", n) for kind in ("left", "right", "additive", "so3-body") for n in (9, 15)),
        *(("right", form, n) for form in ("upper", "full") for n in (9, 15)),
    ],
)
def test_states_in_a_table(kind, form, n, inside):
    arrays, e, P = position_first(*states(kind, n))
    record = cs.read(table(arrays, P, form), truth=named(arrays), error=kind)
    assert_allclose(record.errors.error[0], e, atol=1e-9)
    assert_allclose(record.errors.nees[0], nees(e, P), rtol=1e-9)
    assert record.errors.axes == tuple(LABELS[:n])
    assert record.errors.convention == kind


@pytest.mark.parametrize("name, header", [("data.csv", ASL), ("truth.csv", "")])
def test_the_truth_of_euroc_has_velocity_and_biases(name, header, inside, capsys):
    """With the rotation first in the covariance; one command."""
    arrays, e, P = states("left")
    first = table(arrays, P[0], "full")  # the columns have no labels, so that the order is declared
    truth = lines(name, header, [nanoseconds(T), *columns(arrays, true=True)])
    record = cs.read(first, truth=truth, error="left", covariance_order="rotation-translation")
    assert_allclose(record.errors.nees[0], nees(e[0], P[0]), rtol=1e-9)
    _, err = consistency(capsys, "analyse", first, "--truth", truth, "--error", "left")
    assert "error convention left: Log(estimate^-1 truth)" in err


def test_deviations_of_states_are_judged_component_by_component(inside):
    arrays, e, P = position_first(*states("so3"))
    record = cs.read(table(arrays, P, "deviations"), truth=named(arrays), error="so3")
    assert_allclose(record.errors.nees[0], (e**2 / np.diagonal(P, axis1=1, axis2=2)).sum(axis=1), rtol=1e-9)
    assert record.errors.parts == tuple((i,) for i in range(15))
    assert record.errors.axes == tuple(LABELS)


def test_the_true_velocity_between_two_samples(inside):
    arrays, _, P = position_first(*states("so3", 9))
    truth = columns(arrays, true=True)
    late = lines("truth.csv", ",".join(["t", *POSE, *MOVING[:3]]), [100.0 + 0.1 * np.arange(STEPS), *truth])
    own = [np.repeat(column[:1], STEPS) for column in columns(arrays)]
    est = lines(
        "est.csv", ",".join(["t", *POSE, *MOVING[:3], *stated(9, "full")]),
        [100.0 + 0.1 * np.arange(STEPS) * (STEPS - 1) / STEPS, *own, *P.reshape(STEPS, -1).T],
    )  # fmt: skip
    record = cs.read(est, truth=late, error="so3")
    share = np.arange(STEPS) * (STEPS - 1) / STEPS
    for i, axis in enumerate("xyz"):
        true = np.interp(share, np.arange(STEPS), truth[7 + i])
        assert_allclose(record.errors.error[0, :, record.errors.axes.index(f"v{axis}")], true - own[7 + i], atol=1e-9)


def test_without_a_true_velocity_the_pose_is_judged(inside):
    arrays, e, P = position_first(*states("so3"))
    est = table(arrays, P, "named")
    for keep, what in ((0, "velocities"), (3, "biases")):
        less = {key: value for key, value in arrays.items() if keep or key not in ("true_v", "true_bg", "true_ba")}
        less = {key: value for key, value in less.items() if not key.startswith("true_b")}
        record = cs.read(est, truth=named(less), error="so3")
        assert_allclose(record.errors.nees[0], nees(e[:, : 6 + keep], P[:, : 6 + keep, : 6 + keep]), rtol=1e-9)
        assert f"truth.csv: holds no {what}, so that those of est.csv are not judged" in record.origin.notes
    aligned = cs.read(est, truth=named(arrays), error="so3", align="posyaw-all")
    assert aligned.errors.axes == tuple(LABELS[:6])


@pytest.mark.parametrize(
    "options, said",
    [
        ({}, r"est\.csv: holds a covariance of poses with their velocity, whose error is not known; add error=so3"),
        ({"error": "guess"}, r"add error=so3, .*, rvec, euler, additive \('guess' is for poses alone\)"),
        ({"error": "left", "axes": ["bgx"]}, r"axes=bgx: 'bgx' is not one of x, y, z, roll, pitch, yaw, vx, vy, vz$"),
    ],
)
def test_what_has_to_be_declared(options, said, inside):
    arrays, _, P = states("left", 9)
    with pytest.raises(cs.InputError, match=said):
        cs.read(table(arrays, P[0], "full"), truth=named(arrays), **options)


def test_the_additive_error_is_of_states(inside):
    arrays, _, P = states("left", 9)
    alone = columns(arrays)[:7]
    est = lines(
        "est.csv", ",".join(["t", *POSE, *stated(6, "full")]), [T, *alone, *P[0, :, :6, :6].reshape(STEPS, -1).T]
    )
    with pytest.raises(cs.InputError, match="error=additive: for a trajectory in space it is one of so3, so3-body"):
        cs.read(est, truth=named(arrays), error="additive")
    assert cs.read(est, truth=named(arrays)).errors.axes == tuple(LABELS[:6])
