"""Have the deviations of OpenCV's calibrateCameraExtended the size of the errors? Views of a board of known points."""

import cv2
import numpy as np
from board_scene import BOARD, TRUE, VIEWS, least_squares, simulate
from study import Argument, Case

AXES = ("fx", "fy", "cx", "cy")
cv2.setNumThreads(1)
FLAGS = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_ZERO_TANGENT_DIST
FLAGS |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3


def matrix(f):
    return np.array([[f[0], 0, f[2]], [0, f[1], f[3]], [0, 0, 1.0]])


def judged(draws):
    errors, stated = [], []
    for x, pixels in draws:
        views = list(pixels.astype(np.float32).reshape(VIEWS, -1, 1, 2))
        _, K, _, _, _, deviations, *_ = cv2.calibrateCameraExtended(
            [BOARD] * VIEWS, views, (640, 480), matrix(TRUE), np.zeros(5), flags=FLAGS
        )
        errors.append(x[:4] - K[[0, 1, 0, 1], [0, 1, 2, 2]])
        stated.append(deviations.ravel()[:4])
    return {"deviations": (np.array(errors), np.array(stated))}


def control(draws):
    fits = [least_squares(*draw) for draw in draws]
    errors = np.array([x[:4] - fit[:4] for (x, _), (fit, _) in zip(draws, fits, strict=True)])
    return {"least squares": (errors, np.array([np.sqrt(np.diag(P)[:4]) for _, P in fits]))}


def second():
    """The library's variances against (J'J)^-1 s^2: s^2 of N - n residuals in place of 2 N - n."""
    (draw,) = simulate(np.random.default_rng(1), 1)
    points, n = VIEWS * len(BOARD), 4 + 6 * VIEWS
    (_, stated), (_, P) = judged([draw])["deviations"], least_squares(*draw)
    factor = (2 * points - n) / (points - n) if tuple(map(int, cv2.__version__.split(".")[:2])) < (4, 7) else 1
    name = f"(J'J)^-1 s^2 times {factor:.3f}"
    return [Argument("deviations", name, v, e, rtol=5e-3, axis=axis) for axis, v, e in
            zip(AXES, stated[0] ** 2, factor * np.diag(P)[:4], strict=True)]  # fmt: skip


CASE = Case("opencv-python-headless", AXES, 278, simulate, judged, control, second)

if __name__ == "__main__":
    CASE.main()
