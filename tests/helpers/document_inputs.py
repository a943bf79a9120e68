"""What the commands and the code of the documents find in their folder, and which of them are not run here."""

import csv
import shutil

import numpy as np
from documents import ROOT
from scipy import stats
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.bench.runs.montecarlo import simulate_log

RNG = np.random.default_rng(20070)  # what is judged right or wrong is not asserted
DT, STEPS, RUNS = 0.5, 120, 12
SIGMA = np.array([0.02, 0.02, 0.02, 0.004, 0.004, 0.004])  # m, rad
T = DT * np.arange(STEPS)
PLACE = np.column_stack([0.3 * T, np.sin(0.2 * T), 0.02 * T])
TURN = Rotation.from_rotvec(np.outer(T, [0, 0, 0.05]))
P = np.broadcast_to(np.diag(SIGMA**2).ravel(), (STEPS, 36))
DAY, DRIVE = "2011_09_26", "2011_09_26_drive_0001_sync"

# Commands and code that are only parsed: page, what they begin with, and why.
STUDY = "takes from half a minute to hours even with two runs; tests of its experiment run its parts"
REAL = "needs real drives; tests that look for CONSISTENCY_DATA run it"
CLUSTER = "needs a cluster; tests/smoke/test_dask_cli.py and unit/bench/test_slurm.py stand in"
NOT_RUN = [
    ("docs/any-program.md", "", "needs MATLAB, Julia and ROS; tests/smoke/test_cpp_example.py runs what is in C++"),
    ("docs/case-studies.md", "python docs/case-studies", "needs the libraries; tests/oracle/test_case_studies_live.py"),
    ("docs/characterise.md", "CONSISTENCY_DATA=DIR consistency reproduce", STUDY),
    ("README.md", "pip install \"filter-consistency", "needs the network"),
    ("README.md", "consistency inspect est.csv", "tests/unit/referee/test_inspect.py"),
    ("docs/coming-from.md", "", "test_inspect.py reads a trajectory with its truth beside it"),
    ("docs/ros.md", "", "needs bags of a robot; test_inspect.py and test_bags.py write some"),
    ("docs/long-runs.md", "openssl", CLUSTER),
    ("docs/long-runs.md", "export", CLUSTER),
    ("docs/long-runs.md", "for role", CLUSTER),
    ("docs/long-runs.md", "done", CLUSTER),
    ("docs/long-runs.md", "dask", CLUSTER),
    ("docs/long-runs.md", "from dask", CLUSTER),
    ("docs/long-runs.md", "consistency run herath2007-stereo --filter ukf-uvd --runs 200000", CLUSTER),
    ("docs/consistent.md", "consistency reproduce", STUDY),
    ("docs/reference/conventions.md", "", "tests/unit/referee/test_conventions.py runs all of it"),
    ("docs/extending.md", "", "tests/unit/test_extending.py follows it in a copy of the package"),
    ("docs/reference/file-kinds.md", "consistency analyse drive.bag", "tests/unit/referee/test_bags.py"),
    ("docs/reference/file-kinds.md", "consistency analyse drive --truth-topic", "tests/unit/referee/test_bags.py"),
    ("docs/reference/file-kinds.md", "consistency analyse drives --truth-topic", "tests/unit/referee/test_bags.py"),
    ("docs/reference/file-kinds.md", "consistency analyse est.csv --truth truth.csv --columns",
     "tests/unit/referee/test_own_names.py reads such tables"),
    ("docs/files.md", "consistency analyse keyframes.csv", "tests/unit/referee/test_relative.py has cross-covariances"),
    ("docs/files.md", "consistency analyse est.tum", "tests/oracle/test_gtsam_windows.py has such marginals"),
    ("docs/files.md", "joint = marginals", "tests/oracle/test_gtsam_windows.py does the same"),
    ("docs/what-can-be-stated.md", "python docs/examples", "needs data of another package, and pyreadr"),
    ("docs/what-can-be-stated.md", "consistency analyse hub.csv", "needs data of another package"),
    ("docs/what-to-state.md", "python docs/examples", "needs a real drive"),
    ("docs/what-to-state.md", "consistency fit-covariance", "needs real drives; test_fit_command.py simulates"),
    ("docs/what-to-state.md", "consistency correct", "needs real drives; test_correct_command.py simulates"),
    ("docs/front-end.md", "from consistency.vision import fit_shared", "tests/unit/stereo/test_vision_shared.py"),
    ("docs/front-end.md", "python experiments/e11", REAL),
    ("docs/gates.md", "from consistency.testing import assert_program", "tests/smoke/test_cpp_example.py has one"),
    ("docs/filters.md", "consistency run", "compiles two guarded filters; tests/unit/bench/test_guards.py runs such"),
    ("docs/reference/recorded.md", "", f"{STUDY}; e15: {REAL}"),
    ("docs/regime.md", "consistency sweep regime --out regime --filter", "compiles two more filters for one cell"),
    ("docs/reference/sensor.md", "consistency reproduce", STUDY),
    ("docs/tuning.md", "consistency tune --log OUT", REAL),
    ("docs/tuning.md", "python experiments/e15", REAL),
]  # fmt: skip


def not_run(page, text):
    return any(page == where and text.startswith(begin) for where, begin, _ in NOT_RUN)


# --- files -------------------------------------------------------------------------------------------------


def write_rows(at, *columns):
    at.parent.mkdir(exist_ok=True, parents=True)
    np.savetxt(at, np.column_stack([T, *columns]), fmt="%.12g")


def poses(place, turn):
    return np.column_stack([place, turn.as_quat()])


def errors():
    return SIGMA * RNG.normal(size=(STEPS, 6))


def estimated():
    e = errors()
    return poses(PLACE - e[:, :3], Rotation.from_rotvec(-e[:, 3:]) * TURN)


def trajectories(folder):
    """est, truth and P as folders of RUNS files, and est.txt, truth.txt, P.txt of one run."""
    for name in ["", *(f"/{k:02d}" for k in range(RUNS))]:
        write_rows(folder / f"truth{name}.txt", poses(PLACE, TURN))
        write_rows(folder / f"est{name}.txt", estimated())
        write_rows(folder / f"P{name}.txt", P)


def inline(folder):
    """Covariances in the lines of poses: est.txt, the folders est, NEW and OLD, and rtk.txt; TRUTH as truth."""
    trajectories(folder)
    for name in ("est.txt", *(f"{of}/{k:02d}.txt" for of in ("est", "NEW", "OLD") for k in range(RUNS))):
        write_rows(folder / name, estimated(), P)
    shutil.copytree(folder / "truth", folder / "TRUTH")
    write_rows(folder / "rtk.txt", poses(PLACE, TURN), 0.1 * P)


def motions(folder):
    """motions.tum, each line a motion with its covariance, and truth.tum."""
    write_rows(folder / "truth.tum", poses(PLACE, TURN))
    before = TURN[:-1].inv()
    e = errors()[1:]
    moved = poses(before.apply(np.diff(PLACE, axis=0)) - e[:, :3], Rotation.from_rotvec(-e[:, 3:]) * before * TURN[1:])
    write_rows(folder / "motions.tum", np.vstack([[0, 0, 0, 0, 0, 0, 1], moved]), P)


def table(at, rows):
    at.parent.mkdir(exist_ok=True, parents=True)
    with at.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def detections(folder):
    """pnp.txt with covariances, tag-est without, each beside its truth; nis.csv of a gate that never rejects."""
    n = 200
    place, turn = RNG.normal(size=(n, 3)), Rotation.random(n, random_state=20070)
    error = RNG.normal(size=(n, 6)) * 0.01
    variances = np.broadcast_to((np.eye(6) * 1e-4).ravel(), (n, 36))
    moved = Rotation.from_rotvec(turn.as_rotvec() - error[:, :3])
    rows(folder / "pnp.txt", np.arange(n), place - error[:, 3:], moved.as_quat(), variances)
    rows(folder / "pnp-truth.txt", np.arange(n), place, turn.as_quat())
    for run in range(6):
        seen = turn * Rotation.from_rotvec(0.01 * RNG.normal(size=(n, 3)))
        noise = 0.02 * RNG.normal(size=(n, 3))
        rows(folder / f"tag-est/{run}.txt", 0.1 * np.arange(n), place - noise, seen.as_quat())
        rows(folder / f"tag-truth/{run}.txt", 0.1 * np.arange(n), place, turn.as_quat())
    table(folder / "nis.csv", [{"nis": 0.03 * value, "nis_dof": 3} for value in RNG.chisquare(3, 368)])


def rows(at, *columns):
    at.parent.mkdir(exist_ok=True, parents=True)
    np.savetxt(at, np.column_stack(columns))


def planar(folder, steps=20):
    """poses.csv and truth.csv: x, y, heading of 30 runs."""
    rng, sigma = RNG, np.array([0.1, 0.1, 0.02])
    variances = dict(zip(("P_xx", "P_yy", "P_hh"), sigma**2, strict=True)) | dict.fromkeys(
        ("P_xy", "P_xh", "P_yh"), 0.0
    )
    keys = [{"run": run, "step": step, "t": 0.1 * step} for run in range(30) for step in range(1, steps + 1)]
    names = ("x", "y", "heading")
    own = [key | dict(zip(names, sigma * rng.normal(size=3), strict=True)) | variances for key in keys]
    table(folder / "poses.csv", own)
    table(folder / "truth.csv", [key | dict.fromkeys(names, 0.0) for key in keys])


def ensembles(folder):
    """members.npz and forecast.csv with members, ensemble.npz with their mean and covariance, repeats.csv."""
    draws = RNG.normal(size=(40, 10, 11, 2))
    truth, members = draws[:, :, 0], draws[:, :, 1:]
    np.savez(folder / "members.npz", members=members, truth=truth)
    rows = []
    for run, step in np.ndindex(40, 10):
        row = {"run": run, "step": step + 1} | dict(zip(("true_x", "true_y"), truth[run, step], strict=True))
        for axis, own in zip(("ex", "ey"), members[run, step].T, strict=True):
            row |= {f"{axis}{k + 1}": value for k, value in enumerate(own)}
        rows.append(row)
    table(folder / "forecast.csv", rows)
    mean = members.mean(axis=2, keepdims=True)
    P = np.swapaxes(members - mean, 2, 3) @ (members - mean) / 9
    np.savez(folder / "ensemble.npz", errors=truth - mean[:, :, 0], covariances=P)
    variances = dict.fromkeys(("P_xx", "P_yy", "P_zz"), 1.0) | dict.fromkeys(("P_xy", "P_xz", "P_yz"), 0.0)
    table(folder / "repeats.csv", [dict(zip("xyz", RNG.normal(size=3), strict=True)) | variances for _ in range(20)])


def receiver(folder):
    """receiver.csv with accuracies, and truth.csv: x, y, z of 80 runs."""
    keys = [{"run": run, "step": step} for run in range(80) for step in range(1, 11)]
    own = [key | dict(zip("xyz", RNG.normal(size=3), strict=True)) | {"h_acc": 1.1, "v_acc": 2.0} for key in keys]
    table(folder / "receiver.csv", own)
    table(folder / "truth.csv", [key | dict.fromkeys("xyz", 0.0) for key in keys])


def grouped(folder):
    """est.csv with columns to group by, and truth.csv; est.txt, truth.txt, P.txt with a table beside them."""
    trajectories(folder)
    planar(folder)
    with (folder / "poses.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for k, row in enumerate(rows):
        row |= {"n_matches": 10 * (k % 20), "weather": ("sun", "rain")[k % 2]}
    table(folder / "est.csv", rows)
    table(folder / "matches.csv", [{"t": t, "n_matches": 10 * (k % 20)} for k, t in enumerate(T.tolist())])


def started(folder):
    """est.csv, new.csv and old.csv of one truth.csv, and a folder of results."""
    planar(folder, 60)
    for name in ("est.csv", "new.csv", "old.csv"):
        shutil.copy(folder / "poses.csv", folder / name)
    results("results")(folder)


def kitti(folder):
    """A drive as truth, and estimates at the first pose all the time."""
    import drives

    (folder / DAY).mkdir()
    drives.write_drive(folder / DAY / DRIVE)
    stay = poses(np.zeros((STEPS, 3)), Rotation.identity(STEPS))
    for name in ("est.txt", f"est/{DRIVE}.txt"):
        at = folder / name
        at.parent.mkdir(exist_ok=True)
        np.savetxt(at, np.column_stack([0.103 * np.arange(50), stay[:50], P[:50]]), fmt="%.12g")
    zero = dict.fromkeys(("x", "y", "heading", "P_xy", "P_xh", "P_yh"), 0.0) | dict.fromkeys(
        ("P_xx", "P_yy", "P_hh"), 1.0
    )
    table(folder / "est.csv", [{"t": 0.103 * k, **zero} for k in range(50)])


def openvins(folder):
    import drives

    drives.write_states(folder)
    triangle = np.eye(3)[np.triu_indices(3)] * 1e-4
    both = np.broadcast_to(np.concatenate([triangle, triangle]), (STEPS, 12))
    write_rows(folder / "stamped_traj_estimate.txt", estimated(), both)
    write_rows(folder / "stamped_groundtruth.txt", poses(PLACE, TURN))


def moving(folder):
    """states.csv with a covariance 15 wide, and data.csv, the truth of EuRoC, in s."""
    rest = np.zeros((STEPS, 9))
    own, sigma = np.hstack([estimated(), rest + 0.01 * RNG.normal(size=(STEPS, 9))]), np.append(SIGMA, np.full(9, 0.01))
    full = np.broadcast_to(np.diag(sigma**2).ravel(), (STEPS, 225))
    names = ["t", "x", "y", "z", *(f"q{a}" for a in "xyzw"), *(f"{k}{a}" for k in ("v", "bg", "ba") for a in "xyz")]
    names += [f"covariance_{k}" for k in range(225)]
    rows = np.column_stack([T, own, full])
    table(folder / "states.csv", [dict(zip(names, row, strict=True)) for row in rows.tolist()])
    true = np.column_stack([T, PLACE, TURN.as_quat()[:, [3, 0, 1, 2]], rest])
    np.savetxt(folder / "data.csv", true, delimiter=",", fmt="%.12g")


def innovations(folder):
    import dataflash_log
    import flight

    nis = (RNG.normal(size=(300, 2)) ** 2).sum(axis=1)
    table(folder / "innovations.csv", [{"t": k / 10, "nis": each, "nis_dof": 2} for k, each in enumerate(nis)])
    log = flight.Flight()
    for k, each in enumerate(RNG.normal(size=300)):
        log.both(1_000_000 + 100_000 * k, {"baro_vpos": (each, 1.0)})
    log.write(folder / "flight.ulg")
    ratios = dataflash_log.Flight("XKF4", "XKFD").set({"EK3_HGT_I_GATE": 500})
    for k, each in enumerate(RNG.normal(size=300)):
        ratios.log("XKF4", 1_000_000 + 100_000 * k, {"SH": abs(each) / 5.0})
        ratios.log("XKFD", 1_000_000 + 100_000 * k, {"IX": each, "IVX": 1.0})
    ratios.write(folder / "flight.bin")


def images(folder):
    """IMAGES: a KITTI sequence of a wall; RESTING: the same pair again and again; FILE: their calibration."""
    import cv2
    import scene

    wall = scene.texture(RNG)
    scene.write_kitti(folder / "IMAGES", scene.drive(12), wall)
    shutil.copytree(folder / "IMAGES", folder / "RESTING")
    for side, image in zip(("image_0", "image_1"), scene.pair(scene.drive(1)[0], wall), strict=True):
        for path in (folder / "RESTING" / side).iterdir():
            noisy = image + RNG.normal(0, 2, image.shape)
            assert cv2.imwrite(str(path), np.clip(noisy, 0, 255).astype(np.uint8))
    (folder / "RESTING/poses.txt").unlink()
    shutil.copy(folder / "IMAGES/calib.txt", folder / "FILE")


def boards(folder, square=0.024):
    """BOARDS: pairs left1, right1, ... of a chessboard of 9 x 6 inner corners in several poses."""
    import cv2

    cells = np.kron(np.indices((7, 10)).sum(axis=0) % 2, np.ones((60, 60)))
    texture = np.pad(255 * (1 - cells), 60, constant_values=255).astype(np.uint8)
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    pixel = square / 60
    texel = np.array([[pixel, 0, -6 * square], [0, pixel, -4.5 * square], [0, 0, 1]])  # of the texture, on the board
    (folder / "BOARDS").mkdir()
    rng = RNG
    for k in range(1, 13):
        turn = Rotation.from_rotvec(rng.uniform(-0.4, 0.4, 3)).as_matrix()
        at = np.array([*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.35, 0.6)])
        for side, x in (("left", 0.0), ("right", 0.06)):
            H = K @ np.column_stack([turn[:, 0], turn[:, 1], at - [x, 0, 0]]) @ texel
            view = cv2.warpPerspective(texture, H, (640, 480), flags=cv2.INTER_AREA, borderValue=128)
            view = cv2.GaussianBlur(view, (0, 0), 0.7) + rng.normal(0, 2, view.shape)
            assert cv2.imwrite(str(folder / f"BOARDS/{side}{k}.png"), np.clip(view, 0, 255).astype(np.uint8))


def log(name):
    def write(folder):
        simulate_log(cs.load_scenario("herath2007-stereo"), 4, 11, folder / name)
        shutil.copy(folder / name / "sensor.toml", folder / "sensor.toml")

    return write


def results(*names):
    def write(folder):
        world = cs.load_scenario("herath2007-stereo").variant("short", truth__steps=60)
        done = cs.run_trials(world, ["ekf-uvd", "ukf-uvd"], runs=20, seed=5, jobs=1)
        for name in names:
            done.write(folder / name)

    return write


def repository(folder):
    shutil.copytree(ROOT / "docs/examples/repository", folder, dirs_exist_ok=True)


def in_checkout(folder):
    shutil.copytree(ROOT / "docs/examples/repository", folder / "docs/examples/repository")


def case_studies(folder):
    shutil.copytree(ROOT / "docs/case-studies", folder / "docs/case-studies")


PREPARE = {
    "README.md": [in_checkout],
    "docs/case-studies.md": [case_studies],
    "docs/characterise.md": [log("drive"), images, boards],
    "docs/examples/repository/README.md": [repository],
    "docs/files.md": [inline],
    "docs/files.md The shortest way": [planar],
    "docs/reference/file-kinds.md TUM trajectories": [trajectories],
    "docs/files.md Another world frame: `--align`": [trajectories],
    "docs/reference/file-kinds.md Tables: .csv, .parquet and .jsonl": [planar],
    "docs/files.md Without the first steps: `--skip`": [started],
    "docs/reference/file-kinds.md OpenVINS": [openvins],
    "docs/reference/file-kinds.md Poses with velocity and biases": [moving],
    "docs/reference/file-kinds.md KITTI": [kitti],
    "docs/reference/results-and-logs.md Logs": [log("LOG")],
    "docs/files.md Relative poses": [motions],
    "docs/front-end.md": [images],
    "docs/groups.md": [grouped],
    "docs/monitor.md": [innovations],
    "docs/referee.md": [results("results", "DIR", "NEW")],
    "docs/regime.md": [log("log")],
    "docs/what-can-be-stated.md": [ensembles, receiver, detections],
}  # of a page, or of a part of it that has a folder of its own

# --- names that the reader brings --------------------------------------------------------------------------

TESTED = """
import numpy as np, pytest
from consistency.testing import assert_consistent, assert_not_worse

my_filter, axes = None, {axes}


def simulate(filter, runs):
    covariance = np.broadcast_to(np.eye(axes), (runs, 20, axes, axes))
    return np.random.default_rng(20070).normal(size=(runs, 20, axes)), covariance


def simulate_my_filter(runs):
    return simulate(my_filter, runs)


"""


def names_of(page, folder):
    """Variables that the code of a page does not make itself."""
    world = cs.load_scenario("herath2007-stereo").variant("short", truth__steps=40)
    if page == "docs/gates.md":
        from consistency.bench.runs.results_to_records import results_source
        from consistency.referee.verdicts.compare_sources import baseline, write_baseline
        from consistency.testing import assert_not_worse

        done = cs.run_trials(world, ["ekf-uvd", "ekf-xyz"], runs=60, seed=5, jobs=1)
        write_baseline(baseline(results_source(done)), folder / "baseline.json")
        e, covariance = RNG.normal(size=(200, 20, 3)), np.broadcast_to(np.eye(3), (200, 20, 3, 3))
        arrays = dict.fromkeys(("errors_new", "errors_old"), e) | dict.fromkeys(
            ("covariances_new", "covariances_old"), covariance
        )
        return {"assert_not_worse": assert_not_worse, "results": done, **arrays}
    if page == "docs/front-end.md":
        return {"paths": [folder / f"IMAGES/image_{side}/00000{k}.png" for k in (0, 1) for side in (0, 1)]}
    if page == "README.md":
        return {"errors": RNG.normal(size=(60, 20, 3)), "covariances": np.broadcast_to(np.eye(3), (60, 20, 3, 3))}
    if page == "docs/what-can-be-stated.md":
        from consistency.testing import assert_consistent

        errors_of_runs = stats.norm.ppf(RNG.permutation((np.arange(16000) + 0.5) / 16000)).reshape(400, 20, 2)
        return {
            "cs": cs,
            "errors": errors_of_runs,
            "radii": np.full((400, 20), 2.448),
            "assert_consistent": assert_consistent,
        }
    if page == "docs/groups.md":
        covariances = np.broadcast_to(np.eye(3), (60, 20, 3, 3))
        errors_of_runs = RNG.normal(size=(60, 20, 3))
        return {"cs": cs, "errors": errors_of_runs, "covariances": covariances, "matches": RNG.uniform(0, 200, 60)}
    if page == "docs/long-runs.md":
        return {"cs": cs, "scenario": cs.load_scenario("herath2007-stereo")}
    return {"cs": cs, "scenario": world, "my_filter": Wrapped()}


class Wrapped:
    """A filter of the reader's own."""

    name, sensors = "mine", ("uvd",)

    def __init__(self):
        self.inner = cs.get_filter("ekf-uvd")

    def __getattr__(self, name):
        if name in ("init", "predict", "update", "pose"):
            return getattr(self.inner, name)
        raise AttributeError(name)
