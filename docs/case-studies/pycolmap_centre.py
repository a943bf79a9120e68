"""Is the covariance of the camera's position, by pycolmap's get_covariance_for_inverse, that of its error?"""

import numpy as np
import pycolmap
import pycolmap_scene as scene
from scipy.spatial.transform import Rotation
from study import Argument, Case

PLACES = (0, 20, 100)  # m, of the scene from the origin of the world, along x


def centre(x, R, t):
    """Where the camera is, after a rotation vector on the left of cam_from_world and a translation."""
    return -(Rotation.from_rotvec(x[:3]) * R).inv().apply(t + x[3:])


def inverse(R, t, P):
    """The library's covariance of the position."""
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R.as_quat()), t)
    return pycolmap.get_covariance_for_inverse(pose, P)[3:, 3:]


def propagated(R, t, P):
    return (J := scene.jacobian(centre, R, t)) @ P @ J.T


def simulate(rng, runs):
    return {place: scene.simulate(rng, runs, place) for place in PLACES}


def rows(draws, fit, covariance):
    fits = [fit(*draw) for draw in draws]
    errors = [centre(np.zeros(6), *draw[:2]) - centre(np.zeros(6), *f[:2]) for draw, f in zip(draws, fits, strict=True)]
    return np.array(errors), np.array([covariance(*f) for f in fits])


def judged(data):
    return {f"position at {place} m": rows(draws, scene.library, inverse) for place, draws in data.items()}


def control(data):
    return {f"textbook at {place} m": rows(draws, scene.textbook, propagated) for place, draws in data.items()}


def second():
    out, text = [], "the matrix of one draw, against (J'J)^-1 of half angles moved by the adjoint of SE(3)"
    for place in PLACES:
        ((*pose, points, pixels),) = scene.simulate(np.random.default_rng(1), 1, place)
        R, t, P = scene.textbook(*pose, points, pixels)
        K = R.inv().as_matrix()
        moved = np.hstack([K @ np.cross(np.eye(3), t).T, K]) @ scene.HALF
        stated = inverse(*scene.library(*pose, points, pixels))
        out.append(Argument(f"position at {place} m", text, stated, moved @ P @ moved.T))
    return out


CASE = Case("pycolmap", "xyz", 150, simulate, judged, control, second)

if __name__ == "__main__":
    CASE.main()
