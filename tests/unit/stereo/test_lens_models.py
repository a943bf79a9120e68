"""The experiment on lens models: what the truth and each belief hold, and that its rules can fail."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from scripts import experiment

import consistency as cs
from consistency.bench.scenario import PicturedSensor
from consistency.stereo.characterising.characterise import Residuals, characterise

SIGMA = (0.2, 0.15, 0.3)


@pytest.fixture(scope="module")
def lens():
    return experiment("e26_lens_models")


def found(rng, slope, f=480.0):
    """A camera whose bias of d grows with u by ``slope``; white noise all over the image."""
    sensor = PicturedSensor(model="uvd", sigma=(1.0, 1.0, 1.0), f=f, B=0.094, image=(640, 360))
    ideal = rng.uniform((-320, -180, 20), (320, 180, 100), (3000, 3))
    r = rng.standard_normal((3000, 3)) * SIGMA
    r[:, 2] += slope * ideal[:, 0]
    row = np.arange(3000)
    return characterise(Residuals(r, ideal, row // 50, row % 50, row < 0), sensor, "test", alone=True)


def test_truth_is_what_was_found_and_a_belief_holds_all_of_it_or_its_pooled_noise(lens, rng):
    of = found(rng, 0.003)
    full, alone = lens.beliefs("poor", of).values()
    assert full.truth == alone.truth
    assert full.name != alone.name
    (bias,) = full.truth.sensor.effects
    place = np.array([-300.0, 0.0, 200.0]), np.array([-100.0, 0.0, 100.0])
    known = full.belief.sensor.bias.at(*place)
    assert_allclose(known, np.array([[0.0, 0.0, 0.003 * u] for u in place[0]]), atol=0.1)
    assert_allclose(bias.at(*place), known)
    assert full.belief.sensor.sigma == full.truth.sensor.sigma == pytest.approx(SIGMA, rel=0.15)
    assert full.truth.sensor.rig == (full.belief.sensor.f, full.belief.sensor.B) == (480.0, 0.094)
    assert full.truth.sensor.image == (640, 360)
    pooled = np.sqrt(SIGMA[2] ** 2 + (0.003 * 640) ** 2 / 12)  # of noise and of a bias that is uniform
    assert alone.belief.sensor.sigma[2] == pytest.approx(pooled, rel=0.1)
    assert alone.belief.sensor.sigma[0] == pytest.approx(of.coordinates[0].pooled)
    assert alone.belief.sensor.bias is None
    assert alone.belief.sensor.disparity_growth is None


def test_all_lens_models_share_one_camera(lens, rng, monkeypatch):
    """Three runs of one filter: a row a world, with the bias of each lens model and the rig of the full one."""
    monkeypatch.setattr(lens, "FILTERS", ("ekf-uvd",))
    known = {"full": found(rng, 0.0), "poor": found(rng, 0.003, 500.0)}
    study = cs.Study(3, 1, 1, only=["chessboard-noise"])
    (finding,) = lens.judged(study, known)
    assert finding.id == "chessboard-noise"
    assert {results.scenario.truth.sensor.f for results in study.kept.values()} == {480.0}
    table = study.tables["lens_models"]
    assert list(zip(table["model"], table["belief"], strict=True)) == [(m, b) for m in known for b in lens.BELIEFS]
    assert (table["anees"] > 0).all()
    assert table["p"].isna().tolist() == [True, False, True, False]
    sensors = study.tables["lens_models_sensors"].set_index(["model", "coordinate"])
    assert sensors.loc[("full", "d"), "bias"] == 0.0
    assert sensors.loc[("poor", "d"), "bias"] == pytest.approx(0.96, abs=0.5)
    nodes = study.tables["lens_models_bias"]
    own = nodes[nodes["model"] == "poor"]
    assert_allclose(own["bias_d"], 0.003 * own["u"], atol=0.5)  # five standard errors in a corner


def table_of(lens, status="consistent", p=1e-4):
    rows = [
        (model, belief, name, "biased" if belief == lens.BELIEFS[1] else "consistent", 3.0, 0.1, 1e-4)
        for model in ("full", *lens.POOR)
        for belief in lens.BELIEFS
        for name in lens.FILTERS
    ]
    table = pd.DataFrame(rows, columns=["model", "belief", "filter", "status", "anees", "rmse_position_m", "p"])
    last = table.index[table["model"] == "none"][-1 if status == "consistent" else 2]
    table.loc[last, ["status", "p"]] = status, p
    return table


def test_the_rules_can_fail(lens):
    study, usual = cs.Study(), table_of(lens, "biased")
    assert lens.with_map(study, table_of(lens)).verdict == "reproduced"
    assert lens.with_map(study, usual).verdict == "not reproduced"
    biased = usual.assign(status=np.where(usual["belief"] == lens.BELIEFS[1], "biased", "consistent"))
    assert lens.with_noise(study, biased).verdict == "reproduced"
    assert lens.with_noise(study, table_of(lens)).verdict == "not reproduced"  # parked is consistent with 'none'
    greatest = biased.assign(p=np.where(biased.index == 9, 0.02, biased["p"]))
    assert biased.loc[9, "belief"] == lens.BELIEFS[1]
    assert lens.with_noise(study, greatest).verdict == "not reproduced"
    of_full = biased.assign(p=np.where(biased["model"] == "full", 0.9, biased["p"]))
    assert lens.with_noise(study, of_full).verdict == "reproduced"


def test_without_images_or_opencv_it_is_left_out(lens, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("CONSISTENCY_DATA", raising=False)
    monkeypatch.setattr(lens, "opencv", lambda: None)
    assert lens.main(cs.Study()) == []
    monkeypatch.setenv("CONSISTENCY_DATA", str(tmp_path))
    assert lens.main(cs.Study()) == []
    assert capsys.readouterr().err.count("set CONSISTENCY_DATA to the folder that holds chessboard_9cm") == 2

    def missing():
        raise cs.InputError("images need OpenCV")

    monkeypatch.setattr(lens, "opencv", missing)
    assert lens.main(cs.Study()) == []
    assert "images need OpenCV" in capsys.readouterr().err
