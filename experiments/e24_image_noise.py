"""Does the noise of disparity in rendered images behave as a robot saw it before a wall, and what is the 0.65 px?

Experiment 2 of Herath et al. (2007) sec. 3.3 and its figures 4, 5, 7 and 8: docs/reference/sensor.md.
"""

from __future__ import annotations

import sys

import numpy as np
import pandas as pd
from scipy import stats

import consistency as cs
from consistency.bench.runs.reproduce_findings import script, sibling
from consistency.referee.errors import InputError
from consistency.referee.system import each
from consistency.referee.types import Array
from consistency.stereo.rendered_images.chain import MISMATCH, Chain, Stops, Tracks, stand, track_means
from consistency.stereo.rendered_images.scene import Camera, Lens, StereoCamera
from consistency.stereo.rendered_images.stages import LeftRightCheck
from consistency.stereo.visual_odometry.arrays import opencv

drives = sibling(__file__, "image_drives")

FINDINGS = ("fig4-protocol", "fig5a", "fig5b", "fig5c", "fig7-8")
LONG = True
NEEDS = "OpenCV (the extra vision)"
OWN_PROCESS = True  # runs no filter

SOURCE = "Herath et al. 2007"
# --- printed ---------------------------------------------------------------------------------
IMAGES, KEPT, SIGMA = 29, 9, 0.65  # sec. 3.3, 4.5
MEAN_DISPARITY, LARGEST = 14.7, 2.0  # px, fig. 8 and sec. 4.1
# --- chosen, because nothing is printed ------------------------------------------------------
RESIDUAL = 0.005  # distortion that the rectification leaves, opposite in both images: 3 px between them in a corner
RESIDUALS = (0.0, 0.0025, 0.005, 0.01)
GLASS, OFF = Lens(-0.25, 0.06), 0.02  # a wide lens, and the share of its k1 by which a calibration errs in each camera
WALLS = 5  # before which fig. 8 is drawn
# --- rules -----------------------------------------------------------------------------------
LAGS, WHITE = 5, 0.1  # of a track's autocorrelation: a hundredth of the variance of the next error is foretold
DRAWS, LEVEL = 400, 0.01  # of a bootstrap over stops
FACTOR, NOISES, RIGHT = 2.0, 5.0, 0.5  # fig. 8: of the printed value; of the noise; px with the right rectification


def main(study: cs.Study) -> list[cs.Finding]:
    """The protocol with a right and with a slightly wrong rectification; then the wall of fig. 8."""
    try:
        opencv()
    except InputError as error:
        print(f"e24_image_noise: {error}", file=sys.stderr)
        return []
    findings = []
    if any(study.wants(name) for name in FINDINGS[:4]):
        tracks = {k1: protocol(study, k1) for k1 in each((0.0, RESIDUAL), 2, "stops", "cameras")}
        tables = [by_stop(part).assign(residual=k1) for k1, part in tracks.items()]
        study.tables["images_stops"] = table = pd.concat(tables, ignore_index=True).assign(sigma=SIGMA, needed=KEPT)
        own = table[table["residual"] == RESIDUAL]
        questions = (figure_4(study, own), figure_5a(study, tracks[RESIDUAL]), figure_5b(study, own, table))
        findings += [*questions, figure_5c(study, own)]
    if study.wants("fig7-8"):
        findings.append(figure_8(study))
    return findings


def generator(study: cs.Study, *purpose: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(study.seed, spawn_key=(24, *purpose)))


def glass() -> StereoCamera:
    """A wide lens whose k1 is taken for a little too small in the left and too great in the right camera."""
    left, right = (Camera(lens=GLASS, corrected=Lens(GLASS.k1 * (1.0 + off), GLASS.k2)) for off in (OFF, -OFF))
    return StereoCamera(left, right)


def protocol(study: cs.Study, k1: float) -> Tracks:
    """Experiment 2: 101 stops, with a left-right check."""
    rng = generator(study, int(1e4 * k1))
    return stand(
        Chain(filters=(LeftRightCheck(),)), StereoCamera.distorted(k1), Stops(images=IMAGES), rng, study.workers
    )


def by_stop(tracks: Tracks) -> pd.DataFrame:
    """A row for each stop: how many features are kept in all images, and the noise of their disparity."""
    rows = []
    for stop in np.unique(tracks.sequence):
        own = tracks.take(tracks.sequence == stop)
        kept = own.kept
        _, count = np.unique(kept.track, return_counts=True)
        error, within = kept.errors[:, 2], centred(kept)
        rows.append({
            "disparity": float(own.truth[:, 2].mean()), "selected": int((own.frame == 0).sum()),
            "features": int((count == IMAGES + 1).sum()), "observations": len(kept),
            "within": float(np.sqrt(np.sum(within**2) / max(len(kept) - len(count), 1))),
            "pooled": float(error.std(ddof=1)), "mismatches": int((kept.label == MISMATCH).sum()),
        })  # fmt: skip
    return pd.DataFrame(rows)


def centred(tracks: Tracks) -> Array:
    """Disparities minus the mean of their track, (M,), px."""
    _, number = np.unique(tracks.track, return_inverse=True)
    d = tracks.z[:, 2]
    means: Array = np.bincount(number, weights=d) / np.bincount(number)
    return np.asarray(d - means[number])


# --- figures -----------------------------------------------------------------------------------


def figure_4(study: cs.Study, table: pd.DataFrame) -> cs.Finding:
    least = int(table["features"].min())
    return study.finding(
        least >= KEPT and len(table) == 101,
        scenario="none",
        id="fig4-protocol",
        source=f"{SOURCE}, sec. 3.3 and fig. 4",
        claim="from 6 m to 1 m in steps of 0.05 m, of 20 features at a stop at least 9 are kept through 29 more images",
        statistic="least number of features kept in all 30 images over all stops",
        published=f"at least {KEPT}, chosen by hand",
        measured=f"least {least}, median {table['features'].median():.0f} of {table['selected'].median():.0f} at "
        f"{len(table)} stops; {int(table['mismatches'].sum())} mismatches in {int(table['observations'].sum())}",
        accept=f"at least {KEPT} at each of 101 stops",
    )


def figure_5a(study: cs.Study, tracks: Tracks) -> cs.Finding:
    kept = whole(tracks.kept)
    errors = centred(kept).reshape(-1, IMAGES + 1)
    study.tables["images_fig5a"] = histogram(errors.ravel())
    sd = errors.std(axis=1, keepdims=True)
    scaled = (errors / np.where(sd > 0.0, sd, 1.0))[sd[:, 0] > 0.0]  # far away all 30 may be one sixteenth of a px
    # of n white errors about their own mean, two correlate by -1 / (n - 1)
    lags = [float((scaled[:, k:] * scaled[:, :-k]).mean() + 1.0 / IMAGES) for k in range(1, LAGS + 1)]
    study.tables["images_fig5a_lags"] = pd.DataFrame(
        {"lag": np.arange(1, LAGS + 1), "autocorrelation": lags, "limit": WHITE}
    )
    stop = kept.sequence.reshape(-1, IMAGES + 1)[:, 0]
    low, high = drives.bootstrap(
        generator(study, 5), [errors[stop == k].ravel() for k in np.unique(stop)], stats.kurtosis, DRAWS, LEVEL
    )
    white = max(map(abs, lags)) <= WHITE
    return study.finding(
        bool(white and (low > 0.0 or high < 0.0)),
        scenario="none",
        id="fig5a",
        source=f"{SOURCE}, sec. 3.4 and fig. 5a",
        claim="errors of disparity about the means of their tracks are white, and not Gaussian",
        statistic=f"autocorrelation at lags 1 to {LAGS}, freed of what subtracting a mean does; excess kurtosis",
        published="white; Gaussian is an oversimplification",
        measured=f"autocorrelation {', '.join(f'{lag:+.3f}' for lag in lags)}; kurtosis {low:.2f} to {high:.2f} "
        f"({1 - LEVEL:.0%} interval), sd {errors.std():.3f} px, {len(errors)} tracks",
        accept=f"every autocorrelation within {WHITE:g}, and the interval of the kurtosis, from a bootstrap over "
        "stops, leaves out 0",
    )


def figure_5b(study: cs.Study, table: pd.DataFrame, both: pd.DataFrame) -> cs.Finding:
    ratio = table["pooled"] / table["within"]
    low, high = drives.bootstrap(generator(study, 6), list(np.log(ratio.to_numpy())[:, None]), np.mean, DRAWS, LEVEL)
    totals = [
        f"k1 = {k1:g}: {rms(part['pooled']):.3f} pooled, {rms(part['within']):.3f} about track means"
        for k1, part in both.groupby("residual")
    ]
    return study.finding(
        low > 0.0,
        scenario="none",
        id="fig5b",
        source=f"{SOURCE}, sec. 3.4 and fig. 5b",
        claim="disparities pooled at a stop scatter more than about the means of their tracks",
        statistic="pooled sd over sd about track means, geometric mean over stops",
        published=f"slightly higher; sec. 4.5 uses {SIGMA:g} px",
        measured=f"{np.exp(low):.2f} to {np.exp(high):.2f} times ({1 - LEVEL:.0%} interval); px over all stops: "
        f"{'; '.join(totals)}",
        accept="the interval, from a bootstrap over stops, is above 1",
    )


def figure_5c(study: cs.Study, table: pd.DataFrame) -> cs.Finding:
    found = stats.spearmanr(table["disparity"], table["within"], alternative="greater")
    p, rank = float(found.pvalue), float(found.statistic)
    ends = [part["within"].mean() for part in (table.nsmallest(10, "disparity"), table.nlargest(10, "disparity"))]
    return study.finding(
        p < 0.1 * LEVEL,
        scenario="none",
        id="fig5c",
        source=f"{SOURCE}, sec. 3.4 and fig. 5c",
        claim="the standard deviation of disparity grows with disparity",
        statistic="Spearman correlation over stops of disparity and sd about track means",
        published="grows gradually",
        measured=f"{rank:.2f} (p {p:.1g}); {ends[0]:.3f} px at the ten farthest, {ends[1]:.3f} px at the ten nearest "
        "stops",
        accept=f"above 0 with p below {0.1 * LEVEL:g}",
    )


def figure_8(study: cs.Study) -> cs.Finding:
    """Mean errors of features before a wall at 0.92 m, with rectifications that are wrong by more and more."""
    distance = 150.0 * 0.09 / MEAN_DISPARITY
    stops = Stops(farthest=distance, nearest=distance, images=IMAGES)
    rows = []
    cameras = {f"k1 +-{k1:g}": StereoCamera.distorted(k1) for k1 in RESIDUALS} | {"glass": glass()}
    for case, (left, camera) in enumerate(each(cameras.items(), len(cameras), "walls", "cameras")):
        for number in range(WALLS):
            tracks = stand(Chain(), camera, stops, generator(study, 8, case, number)).kept
            means, real = track_means(tracks), track_means(tracks_of_cameras(tracks))
            rows += [
                (left, number, *truth[:2], *mean, np.sqrt(variance[2]), exact[2])
                for truth, mean, variance, exact in zip(means.truth, means.mean, means.variance, real.mean, strict=True)
            ]
    columns = ["left", "wall", "u", "v", "bias_u", "bias_v", "bias_d", "sd", "expected"]
    table = study.tables["images_bias"] = pd.DataFrame(rows, columns=columns)
    largest = {
        left: float(part.groupby("wall")["bias_d"].agg(lambda bias: bias.abs().max()).median())
        for left, part in table.groupby("left", sort=False)
    }
    right, usual = (f"k1 +-{k1:g}" for k1 in (0.0, RESIDUAL))
    noise = float(table.loc[table["left"] == usual, "sd"].median())
    away = table["bias_d"] - table["expected"]
    own = largest[usual]
    return study.finding(
        LARGEST / FACTOR <= own <= LARGEST * FACTOR and own >= NOISES * noise and largest[right] <= RIGHT,
        scenario="none",
        id="fig7-8",
        source=f"{SOURCE}, sec. 4.1, fig. 7 and 8",
        claim="before a wall at a mean disparity of 14.7 px a wide lens has local biases of disparity up to 2 px",
        statistic=f"largest mean error of a track, median over {WALLS} walls, by what rectification leaves; "
        f"glass: its k1 of {GLASS.k1:g} is {OFF:.0%} off",
        published=f"as high as {LARGEST:g} px",
        measured=f"{'; '.join(f'{left!s} {value:.2f} px' for left, value in largest.items())}; noise about track means "
        f"{noise:.3f} px; measured minus worked out from the cameras: mean {away.mean():+.3f}, sd {away.std():.3f} px",
        accept=f"with +-{RESIDUAL:g} within a factor of {FACTOR:g} of what is printed and {NOISES:g} times the noise, "
        f"and at most {RIGHT:g} px with the right rectification; the chapter does not say what was left",
    )


# --- parts -------------------------------------------------------------------------------------


def tracks_of_cameras(tracks: Tracks) -> Tracks:
    """What the cameras would give if no stage erred."""
    return Tracks(**{**vars(tracks), "z": tracks.real})


def whole(tracks: Tracks) -> Tracks:
    """Tracks that are kept in all images, track by track."""
    number, count = np.unique(tracks.track, return_counts=True)
    own = tracks.take(np.isin(tracks.track, number[count == IMAGES + 1]))
    return own.take(np.lexsort((own.frame, own.track)))


def rms(values: pd.Series) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def histogram(errors: Array, bins: int = 80) -> pd.DataFrame:
    """Density of errors within five standard deviations."""
    sd = float(errors.std())
    density, edges = np.histogram(errors, bins, (-5 * sd, 5 * sd))
    density = density / (len(errors) * np.diff(edges))
    return pd.DataFrame({"low": edges[:-1], "high": edges[1:], "density": density, "sd": sd, "samples": len(errors)})


if __name__ == "__main__":
    script(main)
