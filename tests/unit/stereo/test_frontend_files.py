"""Calibrations, image folders and truths of the usual data sets, and what is said about damaged ones."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scene import SIZE, K, drive, write_kitti
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.referee.geometry import rotation
from consistency.stereo.frontend.camera_truth import read_truth
from consistency.stereo.visual_odometry.calibration_files import read_calibration, read_kitti
from consistency.stereo.visual_odometry.rig import rectify
from consistency.stereo.visual_odometry.sequence import read_image, read_sequence

cv2 = pytest.importorskip("cv2", reason="OpenCV (the extra vision) is not installed")

ROWS = ["700 0 600 0 0 700 180 0 0 0 1 0", "700 0 600 -350 0 700 180 0 0 0 1 0"]
EUROC = """# General sensor definitions.
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, {x}, 0.0, 1.0, 0.0, 0.2, 0.0, 0.0, 1.0, 0.3, 0.0, 0.0, 0.0, 1.0]
resolution: [480, 320]
camera_model: pinhole
intrinsics: [320.0, 320.0, 240.0, 160.0] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [{k}, 0.0, 0.0, 0.0]
"""


def opencv_file(path, **changes):
    """A calibration as OpenCV itself writes it; a change to None leaves a key out."""
    R = rotation(0.01, -0.02, 0.015)
    keys = {"K1": K, "D1": np.zeros((1, 5)), "K2": 1.01 * K + np.diag([0, 0, -0.01]), "D2": np.zeros((1, 5)), "R": R,
            "T": -R @ np.array([[0.2], [0.004], [0.001]])} | changes  # fmt: skip
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in keys.items():
        if value is not None:
            storage.write(key, value)
    storage.release()
    return path


def euroc_folder(folder, k=0.0, second=0.11):
    for camera, x in (("cam0", 0.0), ("cam1", second)):
        (folder / "mav0" / camera / "data").mkdir(parents=True)
        (folder / "mav0" / camera / "sensor.yaml").write_text(EUROC.format(x=x, k=k))
        lines = ["#timestamp [ns],filename"]
        for n in range(3):
            name = f"{10**18 + n * 50_000_000}.png"
            assert cv2.imwrite(str(folder / "mav0" / camera / "data" / name), np.zeros(SIZE[::-1], np.uint8))
            lines.append(f"{name[:-4]},{name}")
        (folder / "mav0" / camera / "data.csv").write_text("\r\n".join(lines) + "\r\n")
    return folder


def test_a_line_of_images_without_a_name_is_refused(tmp_path):
    table = euroc_folder(tmp_path) / "mav0" / "cam1" / "data.csv"
    table.write_text(table.read_text()[: table.read_text().rindex(",")])
    with pytest.raises(cs.InputError, match=r"times must be whole nanoseconds.*without the name of an image"):
        read_sequence(tmp_path)


@pytest.fixture
def kitti(tmp_path):
    write_kitti(tmp_path / "seq", drive(3), np.zeros((900, 900), np.uint8))
    return tmp_path / "seq"


# --- calibrations --------------------------------------------------------------------------------


@pytest.mark.parametrize("names", [("P0: ", "P1: "), ("", "")])
def test_kitti_calibration_with_and_without_names(tmp_path, names):
    path = tmp_path / "calib.txt"
    path.write_text("\n".join(name + row for name, row in zip(names, ROWS, strict=True)) + "\nTr: 1 2 3\n")
    rig = rectify(read_kitti(path), (1226, 370)).rig
    assert_allclose(rig.t, [0.5, 0.0, 0.0])
    assert_allclose(rig.K_left, [[700, 0, 600], [0, 700, 180], [0, 0, 1]])


def test_kitti_colour_images_go_with_the_colour_cameras(tmp_path):
    path = tmp_path / "calib.txt"
    row = "700 0 600 {} 0 700 180 0 0 0 1 0"
    path.write_text("\n".join(f"P{i}: {row.format(x)}" for i, x in enumerate((0, -350, 42, -280))))
    assert_allclose(read_calibration(path, "image_0", "image_1").T, [-0.5, 0, 0])
    assert_allclose(read_calibration(path, "image_2", "image_3").T, [-0.46, 0, 0])


@pytest.mark.parametrize(
    "text, said",
    [
        ("P0: 1 2 3\nP1: 1 2 3\n", "key 'P0': must be 12 finite numbers"),
        (f"P0: {ROWS[0]}\nPX: {ROWS[1]}\n", "key 'P1' is missing; there: P0, PX"),
        (f"P0: {ROWS[0]}\nP1: {ROWS[1].replace('350', 'nan')}", "key 'P1': must be 12 finite numbers"),
        ("P0: one two\n", "key 'P0': must be numbers, after a key and a colon"),
        (f"P0: {ROWS[1]}\nP1: {ROWS[0]}\n", "are the cameras swapped"),
        ("", "key 'P0' is missing; there: nothing"),
    ],
)
def test_unusable_kitti_calibration(tmp_path, text, said):
    path = tmp_path / "calib.txt"
    path.write_text(text)
    with pytest.raises(cs.InputError, match=said) as error:
        read_kitti(path)
    assert str(path) in str(error.value)


def test_opencv_calibration_is_bouguets(tmp_path):
    calibration = read_calibration(opencv_file(tmp_path / "stereo.yml"))
    assert_allclose(calibration.R, rotation(0.01, -0.02, 0.015), atol=1e-12)
    assert_allclose(-calibration.R.T @ calibration.T, [0.2, 0.004, 0.001], atol=1e-12)
    rectification = rectify(calibration, SIZE)
    rig = rectification.rig
    assert rectification.maps is not None
    assert_allclose(rig.R, np.eye(3))
    assert rig.t[0] == pytest.approx(np.linalg.norm([0.2, 0.004, 0.001]))


def test_every_way_in_which_opencv_writes_numbers(tmp_path):
    """Matrices of floats and integers, a bare number, a list (by hand here) and a text that is not needed."""
    T = [-0.2, 0.004, 0.001]
    changes = {"K1": K.astype(np.float32), "K2": K.astype(np.int32), "T": None, "R": None, "D1": None, "D2": None}
    path = opencv_file(tmp_path / "stereo.yaml", **changes, image_width=640, image_height=480.0, made="by hand")
    path.write_text(f"{path.read_text()}T: {T}\n")
    calibration = read_calibration(path)
    assert_array_equal([calibration.K_left, calibration.K_right], [K, K])
    assert_array_equal(calibration.T, T)
    assert calibration.image_size == (640, 480)


def test_a_calibration_without_the_first_line_of_opencv(tmp_path):
    """Written by hand: plain YAML, with lists and with tables of rows, cols and data."""
    rows = "[700.0, 0, 320, 0, 700, 240, 0, 0, 1]"
    text = f"K1: {rows}\nK2: {{rows: 3, cols: 3, data: {rows}}}\nT: [-0.2, 0, 0]\n"
    (tmp_path / "stereo.yaml").write_text(text)
    calibration = read_calibration(tmp_path / "stereo.yaml")
    assert_array_equal(calibration.K_left, calibration.K_right)
    assert calibration.K_left[0, 2] == 320.0


def test_rectified_pixels_of_a_point_are_those_of_the_rectified_rig(tmp_path):
    D = np.array([[-0.2, 0.05, 1e-3, -5e-4, 0.0]])
    c = read_calibration(opencv_file(tmp_path / "stereo.yml", D1=D, D2=0.9 * D))
    rectification = rectify(c, SIZE)
    point = np.array([[0.3, -0.2, 3.0]])
    wanted = rectification.rig.project(point @ rectification.turn.T)[0]
    raw_left, _ = cv2.projectPoints(point, np.zeros(3), np.zeros(3), c.K_left, c.D_left)
    raw_right, _ = cv2.projectPoints(point, cv2.Rodrigues(c.R)[0], c.T.reshape(3, 1), c.K_right, c.D_right)
    images = []
    for u, v in (raw_left.ravel(), raw_right.ravel()):
        column, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
        images.append((255 * np.exp(-((column - u) ** 2 + (row - v) ** 2) / 18)).astype(np.uint8))
    for image, (u, v) in zip(rectification.apply(*images), (wanted[:2], wanted[2:]), strict=True):
        weight = image / image.sum()
        found = (weight * np.arange(SIZE[0])).sum(), (weight.T * np.arange(SIZE[1])).sum()
        assert_allclose(found, (u, v), atol=0.15)  # a blob of 3 px is magnified unevenly


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"K1": None}, r"key 'K1' is missing; known keys: K1 = camera_matrix_1"),
        ({"T": None}, "key 'T' is missing"),
        ({"K2": np.eye(2)}, "key 'K2': has 4 numbers, not 9"),
        ({"R": np.diag([1.0, 1.0, -1.0])}, "the rotation between the cameras is not one"),
        ({"R": 2 * np.eye(3)}, "the rotation between the cameras is not one"),
        ({"D1": np.zeros((1, 3))}, "key 'D1': has 3 coefficients"),
        ({"T": np.array([[0.2], [0.0], [0.0]]), "R": np.eye(3)}, "are the cameras swapped"),
        ({"T": np.array([[-537.0], [0.0], [0.0]]), "R": np.eye(3)}, "stands 537 m from the left one"),
        ({"K1": -K}, "the matrix of the left camera must be"),
        ({"image_width": 100, "image_height": 50}, "is for images of 100 x 50 px"),
        ({"image_width": 100}, "image_width and image_height go together"),
        ({"D1": None, "distorsion": np.ones((1, 4))}, "key 'distorsion' is unknown while 'D1' is missing"),
        ({"R": None, "Rot": np.eye(3)}, "'Rot' is unknown while 'R' is missing"),
    ],
)
def test_unusable_opencv_calibration(tmp_path, changes, said):
    path = opencv_file(tmp_path / "stereo.yml", **changes)
    with pytest.raises(cs.InputError, match=said):
        rectify(read_calibration(path), SIZE)


def test_one_file_of_euroc(tmp_path):
    path = tmp_path / "sensor.yaml"
    path.write_text("T_BS: [1]\nintrinsics: [1, 1, 1, 1]\n")
    with pytest.raises(cs.InputError, match="is one of the two files of EuRoC; --calibration takes the folder"):
        read_calibration(path)


MATRIX = "!!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1., 0., 2. ]"


@pytest.mark.parametrize("first", ["", "%YAML:1.0\n---\n", "%YAML 1.2\n---\n"])
@pytest.mark.parametrize(
    "text, said",
    [
        ("a: [1", "cannot be read as YAML"),
        ("- 1", "no 'key: value'"),
        ("", "no 'key: value'"),
        ("K1: text", "key 'K1': must be numbers, or a matrix"),
        ("K1: [ 1., text ]", "key 'K1': must be numbers, or a matrix"),
        ("K1: [ 1., .nan ]", "key 'K1': holds a number that is not finite"),
    ],
)
def test_a_file_that_is_no_calibration(tmp_path, first, text, said):
    path = tmp_path / "stereo.yaml"
    path.write_text(first + text + "\n")
    with pytest.raises(cs.InputError, match=said) as error:
        read_calibration(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_a_matrix_of_opencv_without_all_its_numbers(tmp_path):
    (tmp_path / "stereo.yaml").write_text(f"%YAML:1.0\n---\nK1: {MATRIX}\n")
    with pytest.raises(cs.InputError, match="key 'K1': must be numbers, or a matrix with rows, cols and data"):
        read_calibration(tmp_path / "stereo.yaml")


def test_euroc_layout(tmp_path):
    sequence = read_sequence(euroc_folder(tmp_path))
    assert (sequence.format, len(sequence), sequence.timed) == ("euroc", 3, True)
    assert_allclose(np.diff(sequence.t), 0.05, atol=1e-6)
    assert_allclose(sequence.rectification.rig.t, [0.11, 0, 0], atol=1e-12)
    assert read_sequence(euroc_folder(tmp_path / "bent", k=-0.2)).rectification.maps is not None


def test_unusable_euroc(tmp_path):
    folder = euroc_folder(tmp_path / "a")
    path = folder / "mav0" / "cam1" / "sensor.yaml"
    text = path.read_text()
    for changed, said in (
        (text.replace("intrinsics", "intrinsic"), "key 'intrinsics' is missing; needed: T_BS"),
        (text.replace("radial-tangential", "equidistant"), "'equidistant' is not one of"),
        (text.replace("320.0, 320.0, ", ""), "key 'intrinsics': has 2 numbers, not 4"),
        (text.replace("[480,", "[481,"), "key 'resolution'"),
    ):
        path.write_text(changed)
        with pytest.raises(cs.InputError, match=said):
            read_sequence(folder)
    path.unlink()
    with pytest.raises(cs.InputError, match="holds no calibration of cam1"):
        read_sequence(folder)


# --- sequences -----------------------------------------------------------------------------------


def test_kitti_layout(kitti):
    sequence = read_sequence(kitti)
    assert (sequence.format, len(sequence), sequence.timed) == ("kitti", 3, True)
    assert_allclose(sequence.t, [0, 0.1, 0.2])
    assert [image.shape for image in sequence.pair(1)] == [SIZE[::-1]] * 2
    (kitti / "times.txt").unlink()
    assert np.diff(read_sequence(kitti, rate=4.0).t).tolist() == [0.25, 0.25]
    assert not read_sequence(kitti).timed


def test_plain_folders_and_patterns(tmp_path, kitti):
    calibration = opencv_file(tmp_path / "stereo.yml")
    (kitti / "image_0").rename(kitti / "left")
    (kitti / "image_1").rename(kitti / "right")
    assert read_sequence(kitti, calibration).format == "opencv"
    with pytest.raises(cs.InputError, match="plain images need --calibration"):
        read_sequence(kitti)
    found = read_sequence(kitti, calibration, left="left/*[12].png", right="right/*[01].png")
    assert [(a.name, b.name) for a, b in zip(found.left, found.right, strict=True)] == [
        ("000001.png", "000000.png"),
        ("000002.png", "000001.png"),
    ]


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda f: (f / "image_1" / "000001.png").unlink(), "000001.png: has no partner of the other camera"),
        (lambda f: (f / "image_0" / "000002.png").unlink(), "image_1/000002.png: has no partner"),
        (lambda f: [p.unlink() for p in f.glob("image_*/00000[12].png")], "1 stereo pairs"),
        (lambda f: (f / "image_0" / "000000.png").write_bytes(b"PNG"), "cannot be read as an image"),
        (lambda f: (f / "times.txt").write_text("0\n0.1\n"), "2 timestamps for 3 stereo pairs"),
        (lambda f: (f / "times.txt").write_text("0\n0.2\n0.1\n"), "not increasing"),
        (lambda f: (f / "times.txt").write_text("a b\n"), "one time in seconds a line"),
        (lambda f: (f / "calib.txt").unlink(), "calib.txt: no such file"),
        (lambda f: (f / "image_0").rename(f / "imagex"), "holds no stereo images of a known layout: image_0"),
    ],
)  # fmt: skip
def test_unusable_folder(kitti, change, said):
    change(kitti)
    with pytest.raises(cs.InputError, match=said):
        read_sequence(kitti)


def test_a_gap_in_frames_without_times(kitti):
    for side in ("image_0", "image_1"):
        (kitti / side / "000002.png").rename(kitti / side / "000003.png")
    assert len(read_sequence(kitti)) == 3  # times.txt tells when they were
    (kitti / "times.txt").unlink()
    with pytest.raises(cs.InputError, match=r"000003\.png: frames are missing between 000001\.png and it"):
        read_sequence(kitti)


def test_plain_pairs_of_different_numbers(kitti):
    (kitti / "image_0").rename(kitti / "left")
    (kitti / "image_1").rename(kitti / "right")
    (kitti / "left" / "000001.png").unlink()
    with pytest.raises(cs.InputError, match="2 images are like 'left/\\*' but 3"):
        read_sequence(kitti)
    (kitti / "right" / "000002.png").unlink()
    with pytest.raises(cs.InputError, match=r"000002\.png and 000001\.png would be a pair"):
        read_sequence(kitti, kitti / "calib.txt")


def test_images_of_different_sizes(kitti):
    path = kitti / "image_1" / "000001.png"
    assert cv2.imwrite(str(path), np.zeros((100, 200), np.uint8))
    with pytest.raises(cs.InputError, match=r"000001\.png: has 200 x 100 px, other images 480 x 320 px"):
        read_sequence(kitti).pair(1)


@pytest.mark.parametrize(
    "options, said",
    [
        ({"format": "ros"}, "--format ros: must be one of kitti"),
        ({"rate": -1.0}, "--rate -1.0"),
        ({"left": "a*"}, "--left and --right go together"),
        ({"left": "image_0/*", "right": "image_1/*1.png"}, "3 images are like"),
        ({"left": "/image_0/*", "right": "image_1/*"}, "must be patterns below"),
    ],
)
def test_unusable_options(kitti, options, said):
    with pytest.raises(cs.InputError, match=said):
        read_sequence(kitti, kitti / "calib.txt", **options)  # type: ignore[arg-type]


# --- truth ---------------------------------------------------------------------------------------


def test_truth_in_three_forms_is_the_same(kitti, tmp_path):
    sequence, poses = read_sequence(kitti), drive(3)
    R, t = np.array([p.R for p in poses]), np.array([p.t for p in poses])
    tum = np.column_stack([sequence.t, t, Rotation.from_matrix(R).as_quat()])
    np.savetxt(tmp_path / "truth.tum", tum)
    for path in (kitti / "poses.txt", tmp_path / "truth.tum"):
        found_R, found_t = read_truth(path, sequence)
        assert_allclose(found_R, R, atol=1e-8)
        assert_allclose(found_t, t, atol=1e-8)


def test_euroc_truth_is_of_the_body(tmp_path):
    sequence = read_sequence(euroc_folder(tmp_path))
    turn = Rotation.from_euler("z", 90, degrees=True)
    x, y, z, w = turn.as_quat()
    rows = [f"{10**18 + n * 50_000_000},{n},0,0,{w},{x},{y},{z}" for n in range(3)]
    path = tmp_path / "data.csv"
    path.write_text("#ns,px,py,pz,qw,qx,qy,qz\n" + "\n".join(rows) + "\n")
    R, t = read_truth(path, sequence)
    assert_allclose(R[1], turn.as_matrix(), atol=1e-12)
    assert_allclose(t[1], [1 - 0.2, 0.0, 0.3], atol=1e-12)  # the camera at (0, 0.2, 0.3) of the body
    path.write_text("\n".join(rows[:2]) + "\n")
    with pytest.raises(cs.InputError, match="1 of 3 frames have no truth"):
        read_truth(path, sequence)


@pytest.mark.parametrize(
    "text, said",
    [
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", "1 poses for 3 frames"),
        ("2 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "a rotation that is none"),
        ("1 2 3\n", "columns"),
        ("0 0 0 0 0 0 0 2\n", "quaternion has length"),
    ],
)
def test_unusable_truth(kitti, text, said):
    (kitti / "poses.txt").write_text(text)
    with pytest.raises(cs.InputError, match=said):
        read_truth(kitti / "poses.txt", read_sequence(kitti))


@pytest.mark.parametrize("kind", [str, Path])
def test_an_image_is_read_by_its_path(tmp_path, kind):
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    assert cv2.imwrite(str(tmp_path / "image.png"), grey)
    assert_array_equal(read_image(kind(tmp_path / "image.png"), (4, 3)), grey)
    with pytest.raises(cs.InputError, match="has 4 x 3 px, other images 3 x 4 px"):
        read_image(kind(tmp_path / "image.png"), (3, 4))
    with pytest.raises(cs.InputError, match="no such image"):
        read_image(kind(tmp_path / "none.png"))
