"""What do tracking, junctions and each stage of the chain do to u, v and d in rendered images of a moving camera?

Experiment 1 and figures 3, 6 and 9 of Herath et al. (2007): docs/reference/sensor.md.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pandas as pd
from scipy import stats

import consistency as cs
from consistency.bench.runs.reproduce_findings import OURS, script, sibling
from consistency.referee.errors import InputError
from consistency.referee.system import each
from consistency.referee.types import Array
from consistency.stereo.rendered_images.chain import (
    DRIFTED,
    JUNCTION,
    POINT,
    Chain,
    Stops,
    Tracks,
    at_junction,
    join_tracks,
    pose_at,
    stand,
)
from consistency.stereo.rendered_images.scene import Camera, Lens, StereoCamera
from consistency.stereo.rendered_images.stages import (
    KnownDisparity,
    KnownProjection,
    LeftRightCheck,
    Spread,
    TrackResidual,
)
from consistency.stereo.visual_odometry.arrays import opencv

drives = sibling(__file__, "image_drives")

FINDINGS = ("fig6", "fig6-shake", "fig9", "fig9-dissimilarity", "exp1-tracks", "static-vs-dynamic", "fig3-chain")
LONG = True
NEEDS = "OpenCV (the extra vision)"
OWN_PROCESS = True  # runs no filter

SOURCE = "Herath et al. 2007"
# --- printed ---------------------------------------------------------------------------------
SD_U, SD_V, FEATURES_6 = 1.34, 1.53, 16  # fig. 6
STEP, FEATURES_1 = 0.02, 30  # m, experiment 1
# --- chosen, because nothing is printed ------------------------------------------------------
SHAKE = np.deg2rad(0.5)  # sd of roll, pitch and heading that a laser's alignment leaves: 1.3 px
IMAGES, ROBOTS = 100, 3  # of experiment 1: 2 m, and how often
WALLS = 8  # for fig. 6
SCENES, VIEWS = 6, 50  # for fig. 9: 1 m
STRONG = 0.15  # quality of features for fig. 9: the rest lies along edges
MIDDLE = 100.0  # px in u to both sides, where every stage works: the matchers give nothing at the left border
RESIDUAL, TURNED = 0.005, (0.002, 0.002, 0.001)  # what a rectification leaves: k1, and rad of the right camera
# --- rules -----------------------------------------------------------------------------------
LEVEL, DRAWS = 0.01, 400
RATIO_DRAWS = 4000  # for an interval whose ends are quantiles of 0.2 %
NEAR = 1.25  # factor between an sd of one sequence of 16 features and the printed one, which is such an sd, too
APART = 0.8  # probability that a junction ranks above a point
ADDS = 0.25  # by which the sum of the stages' mean squares may miss that of the whole chain


def main(study: cs.Study) -> list[cs.Finding]:
    """Fig. 6, 9, experiment 1 and the budget."""
    try:
        opencv()
    except InputError as error:
        print(f"e25_image_tracks: {error}", file=sys.stderr)
        return []
    questions: list[Callable[[cs.Study], list[cs.Finding]]] = [figure_6, figure_9, experiment_1, budget]
    names = (FINDINGS[:2], FINDINGS[2:4], FINDINGS[4:6], FINDINGS[6:])
    asked = [ask for ask, ids in zip(questions, names, strict=True) if any(study.wants(name) for name in ids)]
    return [finding for ask in asked for finding in ask(study)]


def generator(study: cs.Study, *purpose: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(study.seed, spawn_key=(25, *purpose)))


def repeated(study: cs.Study, count: int, purpose: int, once: Callable[[np.random.Generator], Tracks]) -> list[Tracks]:
    """Tracks of ``count`` draws; the same with any number of workers."""
    with ThreadPoolExecutor(study.workers) as threads:
        return list(each(threads.map(once, generator(study, purpose).spawn(count)), count, "image sequences", "draws"))


def wrong_camera() -> StereoCamera:
    """Cameras that are rectified a little wrongly."""
    return StereoCamera(Camera(lens=Lens(RESIDUAL)), Camera(lens=Lens(-RESIDUAL), turned=TURNED))


# --- fig. 6 ------------------------------------------------------------------------------------


def figure_6(study: cs.Study) -> list[cs.Finding]:
    """16 features from 1 m to 6 m, an image a stop, with and without an attitude that the expected values ignore."""
    chain, camera = Chain(selection=Spread(FEATURES_6, 4, 4), stereo_first=False), wrong_camera()
    found = {}
    for number, shake in enumerate((0.0, SHAKE)):
        parts = repeated(study, WALLS, 60 + number, partial(drives.retreat, chain, camera, Stops(), shake=shake))
        found[number] = [part.take(part.frame > 0).errors[:, :2] for part in parts]
    study.tables["images_fig6"] = pd.concat(
        [
            pd.DataFrame({"u": errors[:, 0], "v": errors[:, 1], "wall": wall, "shake": (0.0, SHAKE)[number]})
            for number, walls in found.items()
            for wall, errors in enumerate(walls)
        ]
    )
    return [figure_6_of(study, found[0], "fig6"), figure_6_of(study, found[1], "fig6-shake")]


def figure_6_of(study: cs.Study, walls: list[Array], name: str) -> cs.Finding:
    sd = np.array([errors.std(axis=0) for errors in walls])
    mean = np.sqrt((sd**2).mean(axis=0))
    low, high = sd.min(axis=0), sd.max(axis=0)
    tails = drives.bootstrap(
        generator(study, 6), walls, lambda drawn: stats.kurtosis((drawn - drawn.mean(0)) / drawn.std(0)), DRAWS, LEVEL
    )
    ratio = np.maximum(mean / (SD_U, SD_V), (SD_U, SD_V) / mean)
    shaken = name == "fig6-shake"
    return study.finding(
        bool((ratio <= NEAR).all() and tails[0] > 0.0),
        scenario="none",
        id=name,
        source=f"{SOURCE}, sec. 3.5 and fig. 6" if not shaken else f"{OURS}, on {SOURCE}, fig. 6",
        claim="features tracked from 1 m to 6 m err in u and v with sd 1.34 and 1.53 px and heavy tails"
        + (f", where roll, pitch and heading err by {np.rad2deg(SHAKE):.1f} degrees" if shaken else ""),
        statistic=f"sd over {WALLS} walls, least and greatest of one wall, excess kurtosis",
        published=f"sd u {SD_U:g}, sd v {SD_V:g} px; artefacts in the tails",
        measured=f"u {mean[0]:.2f} ({low[0]:.2f} to {high[0]:.2f}), v {mean[1]:.2f} ({low[1]:.2f} to {high[1]:.2f}) "
        f"px; kurtosis {tails[0]:.2f} to {tails[1]:.2f} ({1 - LEVEL:.0%} interval)",
        accept=f"both within a factor of {NEAR:g} of what is printed, and the kurtosis' interval, from a bootstrap "
        "over walls, above 0",
    )


# --- fig. 9 ------------------------------------------------------------------------------------


def figure_9(study: cs.Study) -> list[cs.Finding]:
    """Features where a pole crosses the edge of a partition, beside corners of posters."""
    camera = StereoCamera()
    chain = Chain(selection=Spread(40, 8, 5, STRONG), stereo_first=False)
    poses = np.stack([pose_at(STEP * k) for k in range(VIEWS)])
    rows = []
    for number, rng in enumerate(each(generator(study, 9).spawn(SCENES), SCENES, "junctions", "scenes")):
        scene = drives.partition(rng)
        tracks = drives.drive(chain, camera, scene, rng, VIEWS, STEP)
        names, residual = drives.rigid_residual(tracks, poses, camera)
        for name, value in zip(names, residual, strict=True):
            last = tracks.take(np.flatnonzero(tracks.track == name)[-1:])
            junction = bool(last.label[0] == JUNCTION)
            met = bool(at_junction(scene, camera, poses[last.frame[0]], last.real[:, :2])[0])
            if np.isfinite(value) and (junction or not met):  # a point that a pole has come near is neither
                rows.append((number, junction, value, float(last.dissimilarity[0])))
    columns = ["scene", "junction", "residual", "dissimilarity"]
    table = study.tables["images_fig9"] = pd.DataFrame(rows, columns=columns)
    claims = {
        "residual": ("fig9", "the apparent point where two edges cross moves like no rigid point"),
        "dissimilarity": ("fig9-dissimilarity", "the dissimilarity of Shi & Tomasi tells junctions from points"),
    }
    return [figure_9_of(study, table, column, *claim) for column, claim in claims.items()]


def figure_9_of(study: cs.Study, table: pd.DataFrame, column: str, name: str, claim: str) -> cs.Finding:
    scenes = [part for _, part in table.groupby("scene")]
    whole = above(table, column)
    rng = generator(study, 90)
    drawn = [above(pd.concat([scenes[k] for k in rng.integers(0, SCENES, SCENES)]), column) for _ in range(DRAWS)]
    low, high = np.quantile(drawn, [LEVEL / 2, 1 - LEVEL / 2])
    medians = table.groupby("junction")[column].median()
    unit = " px" if column == "residual" else ""
    return study.finding(
        whole >= APART and low > 0.5,
        scenario="none",
        id=name,
        source=f"{SOURCE}, sec. 4.3 and fig. 9",
        claim=claim,
        statistic=f"probability that the {column} of a junction is greater than that of a point, after {VIEWS} images",
        published="physically non-existent; a measure of dissimilarity is a possible method",
        measured=f"{whole:.2f} ({low:.2f} to {high:.2f}, {1 - LEVEL:.0%} interval); medians {medians[True]:.2f}{unit} "
        f"of {int(table['junction'].sum())} junctions, {medians[False]:.2f}{unit} of {int((~table['junction']).sum())} "
        "points",
        accept=f"at least {APART:g}, and the interval, from a bootstrap over scenes, above 0.5",
    )


def above(table: pd.DataFrame, column: str) -> float:
    junction = table["junction"].to_numpy(bool)
    values = table[column].to_numpy()
    found = stats.mannwhitneyu(values[junction], values[~junction]).statistic
    return float(found / (junction.sum() * (~junction).sum()))


# --- experiment 1 ------------------------------------------------------------------------------


def experiment_1(study: cs.Study) -> list[cs.Finding]:
    """30 features through an office, moving, and at rest with the same number of images."""
    chain, camera = Chain(selection=Spread(FEATURES_1, 6, 5)), wrong_camera()

    def once(step: float) -> Callable[[np.random.Generator], Tracks]:
        return lambda rng: drives.drive(chain, camera, drives.office(rng), rng, IMAGES, step)

    moving, still = (join_tracks(repeated(study, ROBOTS, 10, once(step))) for step in (STEP, 0.0))
    study.tables["images_exp1"] = pd.concat(
        [by_frame(part, name) for part, name in ((moving, "moving"), (still, "at rest"))]
    )
    begun = [np.unique(part.track) for part in (moving, still)]
    lived = [len(np.unique(part.track[part.frame == IMAGES - 1])) for part in (moving, still)]
    squares = [mean_squares(part) for part in (moving, still)]
    sd = [np.sqrt(part.mean(axis=0)) for part in squares]
    rng = generator(study, 11)
    drawn = [
        np.sqrt(np.divide(*(part[rng.integers(0, len(part), len(part))].mean(axis=0) for part in squares)))
        for _ in range(DRAWS)
    ]
    low, high = np.quantile(drawn, [LEVEL / 2, 1 - LEVEL / 2], axis=0)
    return [
        study.finding(
            bool((low > 1.0).all()),
            scenario="none",
            id="exp1-tracks",
            source=f"{SOURCE}, sec. 3.3 and 4.4",
            claim="tracked by a moving camera, features err more in u and v than before a camera at rest",
            statistic=f"rms about the track's mean over {IMAGES} images, an image each {STEP:g} m, moving over at rest",
            published="in some cases much higher",
            measured=f"u {low[0]:.1f} to {high[0]:.1f}, v {low[1]:.1f} to {high[1]:.1f} times ({1 - LEVEL:.0%} "
            f"intervals); moving {sd[0][0]:.2f} and {sd[0][1]:.2f} px, at rest {sd[1][0]:.3f} and {sd[1][1]:.3f} px; "
            f"{lived[0]} of {len(begun[0])} tracks live through {STEP * (IMAGES - 1):g} m, at rest {lived[1]} of "
            f"{len(begun[1])}",
            accept="both intervals, from a bootstrap over tracks, above 1",
        ),
        static_vs_dynamic(study, moving, still),
    ]


def static_vs_dynamic(study: cs.Study, moving: Tracks, still: Tracks) -> cs.Finding:
    """Noise parameters from a moving camera over those from a camera at rest, spurious features left out."""
    table = study.tables["images_static_dynamic"] = noise_ratios(moving, still, generator(study, 12))
    return study.finding(
        bool((table["low"] > 1.0).all()),
        scenario="none",
        id="static-vs-dynamic",
        source=f"{SOURCE}, sec. 4.4",
        claim="noise parameters estimated with a moving camera are larger than those from a camera at rest",
        statistic="sd of u, v and d about the means of their tracks, moving over at rest, spurious features left out",
        published="invariably larger, in some cases much; no numbers",
        measured="; ".join(
            f"{row.coordinate} {row.ratio:.2f} ({row.low:.2f} to {row.high:.2f}), {row.moving:.3f} over "
            f"{row.at_rest:.3f} px"
            for row in table.itertuples()
        ),
        accept=f"all three intervals above 1, which hold together with {1 - LEVEL:.0%} (bootstrap over tracks)",
    )


def noise_ratios(moving: Tracks, still: Tracks, rng: np.random.Generator) -> pd.DataFrame:
    """Noise of u, v, d with each camera, and their ratios with simultaneous intervals."""
    parts = [scatter(part) for part in (moving, still)]

    def noise(squares: Array, spare: Array) -> Array:
        return np.asarray(np.sqrt(squares.sum(axis=0) / spare.sum()))

    drawn = []
    for _ in range(RATIO_DRAWS):
        picked = [rng.integers(0, len(spare), len(spare)) for _, spare in parts]
        pair = (noise(squares[k], spare[k]) for k, (squares, spare) in zip(picked, parts, strict=True))
        drawn.append(np.divide(*pair))
    low, high = np.quantile(drawn, [LEVEL / 6, 1 - LEVEL / 6], axis=0)  # shared out over three coordinates
    sd = [noise(*part) for part in parts]
    columns = {"moving": sd[0], "at_rest": sd[1], "ratio": sd[0] / sd[1], "low": low, "high": high}
    return pd.DataFrame({"coordinate": list("uvd"), **columns})


def scatter(tracks: Tracks) -> tuple[Array, Array]:
    """Sums of squares of u, v, d about the mean error of each track, (n, 3), px^2, and degrees of freedom (n,)."""
    own = tracks.kept
    own = own.take(own.label == POINT)
    names, count = np.unique(own.track, return_counts=True)
    squares = np.array(
        [count_k * own.errors[own.track == k].var(axis=0) for k, count_k in zip(names, count, strict=True)]
    )
    return squares, count - 1


def mean_squares(tracks: Tracks) -> Array:
    """Of u and v about the mean of each track, (n, 2), px^2; junctions are left out."""
    own = tracks.take(tracks.label != JUNCTION)
    return np.array([own.errors[own.track == name, :2].var(axis=0) for name in np.unique(own.track)])


def by_frame(tracks: Tracks, name: str) -> pd.DataFrame:
    rows = []
    for frame in range(IMAGES):
        own = tracks.take(tracks.frame == frame)
        true = own.take((own.label != JUNCTION) & (own.label != DRIFTED))
        rows.append((name, frame, len(own), len(own) - len(true), *np.sqrt(np.square(true.errors[:, :2]).mean(axis=0))))
    return pd.DataFrame(rows, columns=["camera", "frame", "tracks", "spurious", "rms_u", "rms_v"])


# --- fig. 3 ------------------------------------------------------------------------------------


def budget(study: cs.Study) -> list[cs.Finding]:
    """Each stage with its errors and all others without, then all of them."""
    right, wrong = StereoCamera(), wrong_camera()
    none = Chain(selection=Spread(FEATURES_6, 4, 4), tracking=KnownProjection(), correspondence=KnownDisparity())
    tracked = Chain(none.selection, correspondence=none.correspondence)
    matched = Chain(none.selection, tracking=none.tracking)
    full = Chain(none.selection)
    checked = Chain(none.selection, filters=(LeftRightCheck(), TrackResidual()))
    cases = (
        ("rectification", none, wrong, 0.0), ("tracking", tracked, right, 0.0),
        ("stereo correspondence", matched, right, 0.0), ("attitude", none, right, SHAKE),
        ("all stages", full, wrong, SHAKE), ("all stages, filtered", checked, wrong, SHAKE),
    )  # fmt: skip
    stops, rows = Stops(step=0.25), []
    for number, (name, chain, camera, shake) in enumerate(cases):
        tracks = {
            "standing": stand(chain, camera, stops, generator(study, 30, number), study.workers),
            "moving": join_tracks(
                repeated(study, WALLS // 2, 300 + number, partial(drives.retreat, chain, camera, Stops(), shake=shake))
            ),
        }
        for motion, own in tracks.items():
            if motion == "standing" and name == "attitude":
                continue
            seen = own.take(np.abs(own.truth[:, 0]) <= MIDDLE)
            kept = seen.kept
            rms = np.sqrt(np.square(kept.errors).mean(axis=0))
            rows.append((motion, name, *rms, len(kept) / len(seen), len(seen)))
    columns = ["motion", "stage", "u", "v", "d", "kept", "observations"]
    table = study.tables["images_budget"] = pd.DataFrame(rows, columns=columns)
    return [budget_finding(study, table)]


def budget_finding(study: cs.Study, table: pd.DataFrame) -> cs.Finding:
    values = ["u", "v", "d"]
    whole = table[table["stage"] == "all stages"].set_index("motion")[values] ** 2
    single = table[~table["stage"].str.startswith("all")]
    total = single.assign(**{name: single[name] ** 2 for name in values}).groupby("motion")[values].sum()
    miss = (total / whole - 1.0).abs().max().max()
    return study.finding(
        bool(miss <= ADDS),
        scenario="none",
        id="fig3-chain",
        source=f"{OURS}, on {SOURCE}, fig. 3",
        claim="the stages of the chain err independently: their mean squares add up to that of the chain",
        statistic=f"rms of u, v, d in px with the errors of one stage alone, and of all, "
        f"within {MIDDLE:g} px of the middle in u",
        published="none",
        measured=f"the sum misses the whole by up to {miss:.0%}; rms by stage in images_budget.parquet",
        accept=f"the sum is within {ADDS:.0%} of the whole for u, v and d, standing and moving",
    )


if __name__ == "__main__":
    script(main)
