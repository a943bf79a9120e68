"""Angles in the state of a table are compared on one turn."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import consistency as cs

RUNS, STEPS, SIGMA = 6, 40, 0.03


def written(folder, rng, name="yaw", turn=2.0 * np.pi, wrapped=True, offset=0.0):
    """Tables of runs that turn through half a turn and more; and the errors, (runs, steps)."""
    true = rng.uniform(-3.0, 3.0, (RUNS, 1)) + 0.1 * np.arange(STEPS)
    error = SIGMA * rng.standard_normal((RUNS, STEPS)) + offset
    angles = [true - error, true]
    if wrapped:
        angles = [(angle + np.pi) % (2.0 * np.pi) - np.pi for angle in angles]
    scale = turn / (2.0 * np.pi)
    for file, angle in zip(("est.csv", "true.csv"), angles, strict=True):
        lines = [f"run,t,px,{name},var_px,var_{name}"]
        for run in range(RUNS):
            lines += [f"{run},{k},{k},{scale * angle[run, k]:.9f},1,{(scale * SIGMA) ** 2}" for k in range(STEPS)]
        (folder / file).write_text("\n".join(lines), encoding="utf-8")
    return scale * error


def errors_of(folder, name, **options):
    record = cs.read(folder / "est.csv", truth=folder / "true.csv", state=["px", name], **options)
    return record.errors.error[..., 1], " ".join(record.origin.notes)


@pytest.mark.parametrize("turn", [2.0 * np.pi, 360.0])
@pytest.mark.parametrize("name", ["yaw", "att_roll", "Theta"])
def test_errors_are_those_of_one_turn(name, turn, rng, tmp_path):
    error = written(tmp_path, rng, name, turn)
    found, notes = errors_of(tmp_path, name)
    assert_allclose(found, error, atol=1e-6)
    plain, plain_notes = errors_of(tmp_path, name, error="vector")
    apart = np.abs(plain) > 0.5 * turn
    assert 0 < apart.sum() < RUNS * STEPS / 4
    assert f"turned back: {name} ({apart.sum()} row" in notes
    assert "--error vector" in notes
    assert "turned back" not in plain_notes


@pytest.mark.parametrize(
    "name, wrapped, offset",
    [("yaw", False, 0.0), ("yaw", False, 0.6 * 2.0 * np.pi), ("yawn", True, 0.0), ("px2", True, 0.0)],
)
def test_what_is_no_angle_and_what_may_be_an_error_stays(name, wrapped, offset, rng, tmp_path):
    error = written(tmp_path, rng, name, wrapped=wrapped, offset=offset)
    found, notes = errors_of(tmp_path, name)
    assert "turned back" not in notes
    if not wrapped:
        assert_allclose(found, error, atol=1e-6)
    else:
        assert (np.abs(found) > np.pi).any()


def test_an_error_of_half_a_turn_stays(tmp_path):
    for file, yaw in (("est.csv", 1.0 - 0.6 * 2.0 * np.pi), ("true.csv", 1.0)):
        lines = ["t,px,yaw,var_px,var_yaw", *(f"{k},{k},{yaw:.9f},1,1" for k in range(4))]
        (tmp_path / file).write_text("\n".join(lines), encoding="utf-8")
    found, notes = errors_of(tmp_path, "yaw")
    assert_allclose(found, 0.6 * 2.0 * np.pi, atol=1e-6)
    assert "turned back" not in notes


def test_an_angle_that_counts_turns_stays(rng, tmp_path):
    error = written(tmp_path, rng, turn=3600.0, wrapped=False, offset=0.09 * 2.0 * np.pi)  # 0.9 of 360
    found, notes = errors_of(tmp_path, "yaw")
    assert_allclose(found, error, atol=1e-5)
    assert "turned back" not in notes


def test_the_truth_is_interpolated_on_one_turn(rng, tmp_path):
    """Where it passes half a turn between two rows of the truth, an estimate between them is near it."""
    true = np.array([3.0, 3.1, 3.2 - 2.0 * np.pi, 3.3 - 2.0 * np.pi])
    (tmp_path / "true.csv").write_text(
        "t,px,yaw\n" + "\n".join(f"{0.1 * k:.1f},0,{a:.9f}" for k, a in enumerate(true)), encoding="utf-8"
    )
    lines = ["t,px,yaw,var_px,var_yaw", *(f"{t},0,{a:.9f},1,1" for t, a in ((0.05, 3.0), (0.15, -3.13), (0.25, 3.2)))]
    (tmp_path / "est.csv").write_text("\n".join(lines), encoding="utf-8")
    found, _ = errors_of(tmp_path, "yaw")
    assert_allclose(found[0], [0.05, 3.15 + 3.13 - 2.0 * np.pi, 0.05], atol=1e-6)
