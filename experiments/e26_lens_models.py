"""What does a filter make of the noise and the bias that each lens model leaves of a real 9 cm camera?

`consistency characterise` finds them from images of a chessboard with a full lens model, with k1 alone and without any.
Each becomes the true sensor of the world of herath2007-stereo, with the
focal length, baseline and image of the full model, so that all see the same landmarks.
The images are not shipped: docs/characterise.md.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import ttest_rel

import consistency as cs
from consistency.bench.runs.reproduce_findings import OURS, script
from consistency.bench.runs.results_to_records import mean_nees_of_runs
from consistency.bench.scenario import PicturedSensor, UvdSensor
from consistency.referee.errors import InputError
from consistency.referee.system import each
from consistency.referee.types import Array
from consistency.stereo.characterising.boards import MODELS, find_corners, of_model
from consistency.stereo.characterising.characterise import GRID, Characterisation
from consistency.stereo.characterising.sensor_text import believed_sensor
from consistency.stereo.visual_odometry.arrays import opencv

FINDINGS = ("chessboard-map", "chessboard-noise")
LONG = True
NEEDS = "OpenCV and CONSISTENCY_DATA=DIR with images of a chessboard (docs/characterise.md)"

DATA = "chessboard_9cm"
BOARD, SQUARE = (9, 6), 0.02423  # inner corners; m
BELIEFS = ("noise and map", "noise alone")
FILTERS = ("ekf-uvd", "ukf-uvd", "parked-ekf-uvd")
OWN = "parked-ekf-uvd"  # consistent in the world of herath2007-stereo, so that its faults are those of the sensor
FULL, POOR = "full", ("poor", "none")  # lens models without and with a bias that is shown
# --- rules -----------------------------------------------------------------------------------
LEVEL = 0.01  # of each paired test, and false alarm of each verdict

SOURCE = f"{OURS}, on Herath 2007, sec. 3.4 and 4.1"


def main(study: cs.Study) -> list[cs.Finding]:
    """Needs the folder chessboard_9cm in the folder CONSISTENCY_DATA, and OpenCV."""
    folder = Path(os.environ.get("CONSISTENCY_DATA", "")) / DATA
    try:
        opencv()
        if not folder.is_dir():
            raise InputError(f"left out; set CONSISTENCY_DATA to the folder that holds {DATA}")
    except InputError as error:
        print(f"e26_lens_models: {error}", file=sys.stderr)
        return []
    return judged(study, sensors(folder))


def judged(study: cs.Study, known: dict[str, Characterisation]) -> list[cs.Finding]:
    camera = known[FULL].sensor
    cameras = {model: replace(of, sensor=camera) for model, of in known.items()}
    worlds = {(model, text): world for model, of in cameras.items() for text, world in beliefs(model, of).items()}
    study.tables["lens_models"] = table = verdicts(study, worlds)
    study.tables["lens_models_sensors"] = pd.concat([of_sensor(model, of) for model, of in known.items()])
    study.tables["lens_models_bias"] = pd.concat([of_bias(model, of) for model, of in known.items()])
    makers = {"chessboard-map": with_map, "chessboard-noise": with_noise}
    return [maker(study, table) for name, maker in makers.items() if study.wants(name)]


# --- sensors and worlds ------------------------------------------------------------------------------


def sensors(folder: Path) -> dict[str, Characterisation]:
    """What is known of the camera with each lens model.

    Raises
    ------
    InputError
        As :func:`consistency.stereo.characterising.boards.find_corners`.
    """
    corners = find_corners(folder, BOARD, SQUARE)
    return {model: of_model(corners, model, DATA, GRID) for model in MODELS}


def with_camera(world: cs.Scenario, camera: PicturedSensor) -> cs.Scenario:
    """The world with another stereo camera, in truth and belief alike.

    Image size and range of disparities, where the camera has none, are those of the world, for its focal length and
    baseline.
    """
    before = world.truth.sensor
    assert isinstance(before, UvdSensor)
    assert camera.f is not None
    assert camera.B is not None
    f, B = before.rig
    image, disparity = camera.image, camera.disparity
    if image is None and before.image is not None:
        width, height = (round(pixels * camera.f / f) for pixels in before.image)
        image = (width, height)
    if disparity is None:
        disparity = before.disparity[0], before.disparity[1] * camera.f * camera.B / (f * B)
    own: dict[str, Any] = {
        "f": camera.f,
        "B": camera.B,
        "sigma": camera.sigma,
        "principal_point": camera.principal_point,
    }
    own |= {"image": image, "disparity": disparity, "mount": camera.mount.model_dump()}
    bias = [] if camera.bias is None else [{"kind": "local-bias", **camera.bias.model_dump()}]
    changes = {f"truth__sensor__{key}": value for key, value in own.items()}
    return world.variant(
        "camera",
        truth__sensor__disparity_growth=camera.disparity_growth,
        truth__sensor__effects=bias,
        belief__sensor=camera.belief().model_dump() | {"disparity": disparity},
        **changes,
    )


def beliefs(model: str, of: Characterisation) -> dict[str, cs.Scenario]:
    """The camera in the world of herath2007-stereo, and what a filter may believe of it."""
    rig = with_camera(cs.load_scenario("herath2007-stereo"), believed_sensor(of))
    summary = f"herath2007-stereo with a camera that was calibrated with lens model '{model}'"
    full = rig.variant(f"lens-{model}", summary=f"{summary}; its noise and bias map believed")
    alone = rig.variant(
        f"lens-{model}-noise",
        summary=f"{summary}; all of it believed to be white noise",
        belief__sensor__sigma=tuple(c.pooled for c in of.coordinates),
        belief__sensor__disparity_growth=None,
        belief__sensor__bias=None,
    )
    return dict(zip(BELIEFS, (full, alone), strict=True))


# --- tables ------------------------------------------------------------------------------------------


def verdicts(study: cs.Study, worlds: dict[tuple[str, str], cs.Scenario]) -> pd.DataFrame:
    """A row for each lens model, belief and filter.

    p is that of the hypothesis that noise alone gives no greater NEES than noise and map, NaN for the latter.
    """
    rows, logs = [], dict[tuple[str, str], Array]()
    for (model, belief), world in each(worlds.items(), len(worlds), "beliefs", "worlds"):
        for name in FILTERS:
            found = cs.analyse(study.results(world, [name]), [name], confidence=1.0 - LEVEL)[name]
            log_nees = np.log(mean_nees_of_runs(study.judged(world, name)[1]))
            before = logs.setdefault((model, name), log_nees)  # of noise and map, which comes first
            test = ttest_rel(log_nees, before, alternative="greater", nan_policy="omit")
            p = np.nan if belief == BELIEFS[0] else float(test.pvalue)
            assert found.accuracy is not None
            rmse = found.accuracy.rmse_position, float(np.degrees(found.accuracy.rmse_heading))
            rows.append((model, belief, name, found.status, found.statistic, *rmse, p))
    columns = ["model", "belief", "filter", "status", "anees", "rmse_position_m", "rmse_heading_deg", "p"]
    return pd.DataFrame(rows, columns=columns)


def of_sensor(model: str, of: Characterisation) -> pd.DataFrame:
    """Noise, largest believed bias and both together of u, v, d, in px."""
    assert of.bias is not None
    largest = np.abs(of.bias.believed).max(axis=1)
    rows = [(model, c.name, c.sigma.value, b, c.pooled) for c, b in zip(of.coordinates, largest, strict=True)]
    return pd.DataFrame(rows, columns=["model", "coordinate", "sigma", "bias", "pooled"])


def of_bias(model: str, of: Characterisation) -> pd.DataFrame:
    """The believed bias of u, v, d at each node of the map, px."""
    assert of.bias is not None
    v, u = (axis.ravel() for axis in np.meshgrid(of.bias.grid.v, of.bias.grid.u, indexing="ij"))
    columns = {f"bias_{name}": bias for name, bias in zip("uvd", of.bias.believed, strict=True)}
    return pd.DataFrame({"model": model, "u": u, "v": v, **columns})


# --- findings ----------------------------------------------------------------------------------------


def with_map(study: cs.Study, table: pd.DataFrame) -> cs.Finding:
    """A filter that believes what was found."""
    believed = table[table["belief"] == BELIEFS[0]]
    own = believed[believed["filter"] == OWN]
    return study.finding(
        bool((own["status"] == "consistent").all()),
        scenario=f"herath2007-stereo, {len(own)} cameras",
        id="chessboard-map",
        source=SOURCE,
        claim="a filter that believes the noise and the bias map of its camera is consistent with any lens model",
        statistic="verdict, ANEES and RMSE of position with each lens model",
        published="look-up tables are suggested; not tried",
        measured=said(believed),
        accept=f"{OWN} is found consistent with each, with a false alarm of {LEVEL:.0%} in each verdict",
    )


def with_noise(study: cs.Study, table: pd.DataFrame) -> cs.Finding:
    """A filter that takes the bias for noise."""
    alone = table[(table["belief"] == BELIEFS[1]) & table["model"].isin(POOR)]
    own = alone[alone["filter"] == OWN]
    return study.finding(
        bool((alone["p"] < LEVEL).all() and (own["status"] != "consistent").all()),
        scenario=f"herath2007-stereo, {len(own)} cameras",
        id="chessboard-noise",
        source=SOURCE,
        claim="a filter that takes the bias which a poor lens model leaves for white noise is inconsistent",
        statistic="verdict, ANEES and RMSE of position with white noise of the pooled size",
        published="an all-encompassing error model is adopted; not tried",
        measured=f"{said(alone)}; p at most {alone['p'].max():.2g}",
        accept=f"with lens models {' and '.join(POOR)} log ANEES of runs is greater than with noise and map for each "
        f"of {len(FILTERS)} filters (one-sided paired t tests, {LEVEL:.0%}), and {OWN} is not found consistent",
    )


def said(table: pd.DataFrame) -> str:
    parts = []
    for model, part in table.groupby("model", sort=False):
        texts = (f"{row.filter} {row.status} {row.anees:.2f}, {row.rmse_position_m:.3f} m" for row in part.itertuples())
        parts.append(f"{model}: {', '.join(texts)}")
    return "; ".join(parts)


if __name__ == "__main__":
    script(main)
