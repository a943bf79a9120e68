"""Is the covariance of pycolmap's refined pose, documented for an axis-angle and a translation, that of its error?"""

import numpy as np
from pycolmap_scene import HALF, library, simulate, textbook
from study import Argument, Case


def rows(draws, fit, scale=1.0):
    """Errors, truth minus estimate, of a rotation vector on the left and the translation."""
    fits = [fit(*draw) for draw in draws]
    both = ((*draw[:2], *found[:2]) for draw, found in zip(draws, fits, strict=True))
    errors = [np.r_[scale * (R * r.inv()).as_rotvec(), t - s] for R, t, r, s in both]
    return np.array(errors), np.array([P for *_, P in fits])


def judged(draws):
    return {"pose": rows(draws, library)}


def control(draws):
    return {"least squares": rows(draws, textbook), "read as half angles": rows(draws, library, scale=0.5)}


def second():
    (draw,) = simulate(np.random.default_rng(1), 1)
    text = "the matrix of one draw, against (J'J)^-1 of half angles"
    return [Argument("pose", text, library(*draw)[2], HALF @ textbook(*draw)[2] @ HALF, rtol=1e-3)]


AXES = [f"{name} {axis}" for name in ("rotation", "translation") for axis in "xyz"]
CASE = Case("pycolmap", AXES, 150, simulate, judged, control, second)

if __name__ == "__main__":
    CASE.main()
