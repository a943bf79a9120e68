"""The experiments on rendered images, cut to a few images: all findings come, and a report shows their tables."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from painted import by_title, lines, panels
from scripts import experiment, figures

import consistency as cs
from consistency.bench.pages.results_report import build_report
from consistency.bench.pages.sections.published_findings import exhibit_blocks
from consistency.referee.show.blocks import Heading, Table
from consistency.stereo.rendered_images.chain import MISMATCH, POINT, Stops, Tracks, wall_texture
from consistency.stereo.rendered_images.scene import Layer, Scene

pytest.importorskip("cv2")
images = figures("images")


@pytest.fixture
def noise(monkeypatch):
    module = experiment("e24_image_noise")
    for name, value in {"IMAGES": 6, "WALLS": 1, "RESIDUALS": (0.0, 0.005), "DRAWS": 20}.items():
        monkeypatch.setattr(module, name, value)
    stops = lambda **given: Stops(**({"farthest": 1.4, "step": 0.2} | given))  # noqa: E731
    monkeypatch.setattr(module, "Stops", stops)
    return module


@pytest.fixture
def moving(monkeypatch):
    module = experiment("e25_image_tracks")
    for name, value in {"WALLS": 2, "SCENES": 1, "VIEWS": 5, "IMAGES": 4, "ROBOTS": 1, "DRAWS": 20}.items():
        monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(module, "Stops", lambda step=0.1: Stops(farthest=1.2, step=max(step, 0.1), images=1))
    monkeypatch.setattr(module.drives, "office", lambda rng: Scene((Layer.facing(3.0, wall_texture(rng)),)))
    return module


def test_noise_of_disparity(noise):
    study = cs.Study(seed=3, jobs=1)
    findings = {finding.id: finding for finding in noise.main(study)}
    assert set(findings) == set(noise.FINDINGS)
    assert findings["fig4-protocol"].verdict == "not reproduced"  # 3 stops, not 101
    assert findings["fig5b"].verdict == "reproduced"
    stops = study.tables["images_stops"]
    assert len(stops) == 6
    assert (stops["features"] >= 9).all()
    wrong, right = (stops[stops["residual"] == k1] for k1 in (0.005, 0.0))
    assert (wrong["pooled"] > 2 * wrong["within"]).all()
    assert (right["pooled"] < 2 * right["within"]).all()
    bias = study.tables["images_bias"]
    own = bias[bias["left"] == "k1 +-0.005"]
    assert np.corrcoef(own["bias_d"], own["expected"])[0, 1] > 0.95
    assert bias[bias["left"] == "glass"]["expected"].abs().max() > 0.5
    density = study.tables["images_fig5a"]
    assert (density["density"] * (density["high"] - density["low"])).sum() == pytest.approx(1.0, abs=0.05)


def test_only_what_is_asked_for_is_run(noise):
    study = cs.Study(jobs=1, only=["fig7-8"])
    assert [finding.id for finding in noise.main(study)] == ["fig7-8"]
    assert set(study.tables) == {"images_bias"}


def test_tracks_and_their_report(moving, noise, tmp_path):
    study = cs.Study(seed=3, jobs=1)
    found = moving.main(study)
    assert [finding.id for finding in found] == list(moving.FINDINGS)
    stages = study.tables["images_budget"].set_index(["motion", "stage"])
    assert stages.loc[("standing", "rectification"), "d"] > 0.2
    assert stages.loc[("standing", "tracking"), "d"] == pytest.approx(0.0, abs=1e-9)
    assert stages.loc[("standing", "stereo correspondence"), "u"] == pytest.approx(0.0, abs=1e-9)
    assert stages.loc[("moving", "attitude"), "u"] > 0.5
    assert ("standing", "attitude") not in stages.index
    noise.main(study)
    study.write(tmp_path / "out", found, 0.0)
    report = build_report(tmp_path / "out")
    blocks = exhibit_blocks(report, images.EXHIBITS)
    figures = {title: panels(figure) for title, figure in by_title(blocks).items()}
    tables = {block.label: block for block in blocks if isinstance(block, Table)}
    headings = [block.text for block in blocks if isinstance(block, Heading)]
    assert len(headings) == len(images.EXHIBITS)
    curves = lines(figures["Noise of disparity"][0])
    stops = study.tables["images_stops"].sort_values("disparity")
    assert_allclose(curves[3].get_ydata(), stops[stops["residual"] == 0.005]["within"])
    assert_allclose(curves[4].get_ydata(), stops[stops["residual"] == 0.005]["pooled"])
    kept = lines(figures["Features kept at each stop"][0])
    assert_allclose(kept[2].get_ydata(), stops[stops["residual"] == 0.005]["features"])
    lags = lines(figures["Whiteness"][0])[-1]
    assert_allclose(lags.get_ydata(), study.tables["images_fig5a_lags"]["autocorrelation"])
    for title in "Errors of disparity about track means", "Errors of tracking":
        height, edges, _ = figures[title][0].patches[0].get_data()
        assert (height * np.diff(edges)).sum() == pytest.approx(1.0, abs=0.05)
    points, junctions = lines(figures["Junctions"][0])
    features = study.tables["images_fig9"]
    assert len(junctions.get_xdata()) == features["junction"].sum()
    assert len(points.get_xdata()) == (~features["junction"]).sum()
    survivors = figures["Tracks over images"][2]
    moving_only = study.tables["images_exp1"].query("camera == 'moving'")
    assert_allclose(lines(survivors, "moving")[0].get_ydata(), moving_only["tracks"])
    largest = study.tables["images_bias"].query("left == 'k1 +-0.005'")["bias_d"].abs().max()
    (row,) = (cells for cells in rows_of(tables["Largest biases of disparity"]) if cells[0] == "k1 +-0.005")
    assert row[1] == row[2] == f"{largest:.2f}"  # one wall
    ratio = study.tables["images_static_dynamic"]["ratio"]
    assert [cells[3] for cells in rows_of(tables["Noise of a moving camera over noise at rest"])] == [
        f"{value:.2f}" for value in ratio
    ]
    spread = rows_of(tables["Spread of u and v"])
    shaken = study.tables["images_fig6"].query("shake > 0")
    assert spread[3][:3] == ("0.5 degrees", "v", f"{shaken['v'].std():.2f}")
    median = features.loc[features["junction"], "residual"].median()
    assert rows_of(tables["Junctions beside points"])[1][2] == f"{median:.2f}"


def rows_of(table):
    [(_, rows)] = table.groups
    return rows


def test_a_report_without_images_has_no_section(tmp_path):
    study = cs.Study(jobs=1)
    study.tables["images_exp1"] = pd.DataFrame({"frame": [0.0], "tracks": [3.0], "rms_u": [0.1]})
    study.write(tmp_path / "out", [], 0.0)
    with pytest.raises(cs.InputError, match=r"images_exp1\.parquet: column 'rms_v' is missing"):
        exhibit_blocks(build_report(tmp_path / "out"), images.EXHIBITS)
    (tmp_path / "out" / "images_exp1.parquet").unlink()
    assert not exhibit_blocks(build_report(tmp_path / "out"), images.EXHIBITS)


def test_a_junction_ranks_above_a_point(moving):
    table = pd.DataFrame({"junction": [True, True, False, False], "residual": [3.0, 1.0, 2.0, 0.5]})
    assert moving.above(table, "residual") == 0.75


def test_without_opencv_the_experiments_are_left_out(noise, moving, monkeypatch, capsys):
    def missing():
        raise cs.InputError("images need OpenCV")

    for module in (noise, moving):
        monkeypatch.setattr(module, "opencv", missing)
        assert module.main(cs.Study(jobs=1)) == []
    assert capsys.readouterr().err.count("images need OpenCV") == 2


def tracks_with(errors, track, label=None):
    """Kept observations with these errors (M, 3) about a truth that is not zero."""
    zero, truth = np.zeros(len(track), int), np.tile([10.0, 20.0, 5.0], (len(track), 1))
    label = zero + POINT if label is None else label
    return Tracks(zero, zero, track, truth + errors, truth, truth, zero.astype(float), label, zero)


def test_scatter_about_the_means_of_tracks(moving):
    errors = np.array([[1.0, 0, 5], [3.0, 0, 5], [2.0, 3, 5], [7.0, 7, 7], [9.0, 9, 9], [50.0, 50, 50]])
    labels = np.array([POINT] * 5 + [MISMATCH])
    squares, spare = moving.scatter(tracks_with(errors, np.array([4, 4, 4, 8, 8, 8]), labels))
    assert_allclose(squares, [[2.0, 6.0, 0.0], [2.0, 2.0, 2.0]])
    assert spare.tolist() == [2, 1]


def test_noise_ratios_are_those_simulated(moving, rng):
    """60 tracks of 20 images, sd 3, 1 and 0.5 times that at rest; each by six standard errors (below 1e-8)."""
    track, sd = np.repeat(np.arange(60), 20), np.array([3.0, 1.0, 0.5])
    offsets = rng.standard_normal((60, 3))[track]  # constant along a track: no noise
    fast, slow = (tracks_with(k * 0.1 * rng.standard_normal((1200, 3)) + offsets, track) for k in (sd, 1.0))
    table = moving.noise_ratios(fast, slow, rng)
    error = np.sqrt(2.0 / (2.0 * 60 * 19))  # of the ratio of two sd
    assert_allclose(table["ratio"] / sd, 1.0, atol=6 * error)
    assert_allclose(table["moving"], 0.1 * sd, rtol=6 * error)
    half = (table["high"] - table["low"]) / 2 / table["ratio"]
    assert_allclose(half, 2.935 * error, rtol=0.4)  # quantile of 0.5 % / 3
    assert (table["low"] < table["ratio"]).all()
