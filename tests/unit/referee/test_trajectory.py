"""The figure of a trajectory with ellipses where the errors are largest against the covariance."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from painted import by_title, legend_of, lines, panels
from recorded import read_recordings
from records import changed
from scipy import stats

import consistency as cs
from consistency.diagnostics import make_record
from consistency.referee.pages.record_figures import MOST, ellipse, overview, record_figures, trajectory_panel, unit_of
from consistency.referee.show.figures import drawn

STEPS = 60


def record(convention="so3", axes=("x", "y", "z")):
    """A path along x and z, with errors of 1 sigma but for three steps."""
    k = np.arange(float(STEPS))
    true = np.column_stack([k, 0.01 * k, 5.0 * np.sin(k / 10.0)])
    sigma = np.array([0.1, 0.2, 0.3])
    error = np.tile(sigma, (STEPS, 1))
    for step, size in ((10, 6.0), (11, 5.0), (40, 4.0)):
        error[step] *= size
    index = ["xyz".index(axis) for axis in axes]
    nees = np.square(error / sigma)[:, index].sum(axis=1)
    P = np.broadcast_to(np.diag(sigma**2)[np.ix_(index, index)], (1, STEPS, len(axes), len(axes)))
    path = np.stack([true, true - error], axis=1)[None]
    return changed(
        make_record("est", error[None][..., index], P, nees[None], len(axes), axes=axes, t=k, convention=convention),
        path=path,
    )


def figure(one):
    return by_title(record_figures(one, cs.judge(one)))["Trajectory"]


def axes_of(one):
    """The panel of the whole path."""
    return panels(figure(one))[0]


def test_each_ellipse_is_drawn_from_near():
    one = record()
    whole, *close_ups = panels(figure(one))
    steps = [int(axes.get_title("left").split()[-1]) - 1 for axes in close_ups]
    assert steps[:2] == [10, 40]  # the worst first
    places = [axes.get_subplotspec().get_position(axes.figure) for axes in close_ups]
    assert len({(place.x0, place.y0) for place in places}) == len(close_ups)  # none on top of another
    outlines = lines(whole)[2:-1]
    for axes, step, outline in zip(close_ups, steps, outlines, strict=True):
        (low, high), places = axes.get_xlim(), outline.get_xydata()
        assert low < places[:, 0].min() < places[:, 0].max() < high
        assert np.ptp(places, axis=0).max() > 0.2 * (high - low)
        assert low < one.origin.path[0, step, 0, 0] < high
        assert axes.get_aspect() == 1.0


def test_ellipses_stand_where_the_errors_are_largest():
    one = record()
    axes = axes_of(one)
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_aspect()) == ("x (m)", "z (m)", 1.0)
    truth, estimate, *outlines, crosses = lines(axes)
    assert_array_equal(truth.get_xydata(), one.origin.path[0, :, 0][:, [0, 2]])
    assert_array_equal(estimate.get_xydata(), one.origin.path[0, :, 1][:, [0, 2]])
    assert len(outlines) == MOST
    worst = outlines[0].get_xydata()[:-1].mean(axis=0)  # about the estimate of step 11, the 10th from 0
    assert_allclose(worst, one.origin.path[0, 10, 1][[0, 2]], atol=1e-9)
    assert_allclose(crosses.get_xydata()[0], one.origin.path[0, 10, 0][[0, 2]])
    assert crosses.get_xdata()[1] == 40.0  # step 12 is beside the first and is not drawn
    assert "errors are largest against it (" in figure(one).caption
    assert set(legend_of(axes.figure.figure)) == {"truth", "estimate", "95 % ellipse", "truth there"}


def test_an_ellipse_holds_95_percent():
    """Of 20,000 points; 4 standard errors."""
    rng, P = np.random.default_rng(1), np.array([[2.0, 0.9], [0.9, 0.5]])
    outline = ellipse(np.array([1.0, -1.0]), P)
    size = np.einsum("ki,ij,kj->k", outline - [1.0, -1.0], np.linalg.inv(P), outline - [1.0, -1.0])
    assert_allclose(size, stats.chi2.ppf(0.95, 2), rtol=1e-9)
    inside = np.square(rng.standard_normal((20_000, 2))).sum(axis=1) < size[0]
    assert inside.mean() == pytest.approx(0.95, abs=4.0 * np.sqrt(0.05 * 0.95 / 20_000))
    assert np.abs(np.diff(outline, axis=0)).max() < 0.4
    assert_allclose(outline[0], outline[-1])


def test_no_ellipse_of_errors_about_other_axes():
    one = record("left")
    assert len(lines(axes_of(one))) == 2
    assert figure(one).caption.endswith("No ellipses: the stated covariance is not about the axes of the world.")


def test_only_what_is_judged_is_drawn():
    assert axes_of(record(axes=("x", "y"))).get_ylabel() == "y (m)"
    assert trajectory_panel(record(axes=("z",))) is None
    bare = record()
    assert (
        trajectory_panel(make_record("est", bare.errors.error, bare.errors.covariance, axes=bare.errors.axes)) is None
    )


def test_units():
    assert [unit_of(axis)[0] for axis in ("x", "yaw", "vx", "bgy", "baz", "other", "v", "s")] == [
        "m", "deg", "m/s", "rad/s", "m/s^2", "", "", "",
    ]  # fmt: skip


def write(folder, steps=40):
    rng = np.random.default_rng(2)
    P = " ".join(f"{x:.9g}" for x in (np.eye(6) / 100.0).ravel())
    lines = [[], []]
    for k in range(steps):
        e = 0.1 * rng.standard_normal(3)
        lines[0].append(f"{k} {k} {0.5 * k} 0 0 0 0 1 {P}")
        lines[1].append(f"{k} {k + e[0]} {0.5 * k + e[1]} {e[2]} 0 0 0 1")
    for name, text in zip(("est.txt", "truth.txt"), lines, strict=True):
        (folder / name).write_text("\n".join(text) + "\n")
    return folder / "est.txt", folder / "truth.txt"


def test_readers_keep_the_path_for_the_pictures(tmp_path):
    (one,) = read_recordings(*write(tmp_path))
    assert_allclose(one.origin.path[..., 0, :] - one.origin.path[..., 1, :], one.errors.error[..., :3], atol=1e-12)
    v = cs.judge(one)
    titles = [figure.title for figure in record_figures(one, v)]
    assert titles == ["NEES", "Errors and stated bounds", "Trajectory", "Coverage", "Errors over their stated sigma"]
    labels = [line.get_label() for axes in drawn(overview(one, v)).axes for line in axes.lines]
    assert {"truth", "estimate", "all together"} <= set(labels)
    assert one.of_runs(slice(0, 1)).origin.path is not None
    (pieces,) = read_recordings(*write(tmp_path), split="20")
    assert_array_equal(pieces.origin.path.reshape(-1, 2, 3), one.origin.path[0])


def test_tables_keep_it_too(tmp_path):
    rows = "".join(f"{k},{k},{2 * k},0.1,1,0,0,1,0,1\n" for k in range(1, 9))
    (tmp_path / "est.csv").write_text("t,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh\n" + rows)
    (tmp_path / "truth.csv").write_text("t,x,y,heading\n" + "".join(f"{k},{k + 1},{2 * k},0.1\n" for k in range(1, 9)))
    (one,) = read_recordings(tmp_path / "est.csv", tmp_path / "truth.csv")
    assert_array_equal(one.origin.path[0, 3], [[5.0, 8.0], [4.0, 8.0]])
    assert trajectory_panel(one) is not None
