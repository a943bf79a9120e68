"""Have poses that pytransform3d composes, inverts and fuses the covariance that it states?"""

import numpy as np
from pytransform3d import uncertainty
from rigid_scene import AXES, A, B, P, exp, log, simulate, textbook
from study import Argument, Case


def estimated(xi):
    """Error and stated covariance of each estimate of one run, by name."""
    a, b, c = exp(-xi[0]) @ A, exp(-xi[1]) @ B, [exp(-e) @ A for e in xi]
    whole, of_whole = uncertainty.concat_globally_uncertain_transforms(a, P[0], b, P[1])
    inverse, of_inverse = uncertainty.invert_uncertain_transform(a, P[0])
    fused, of_fused, _ = uncertainty.pose_fusion(c, P)
    a, b = A @ exp(-xi[0]), B @ exp(-xi[1])  # errors on the other side
    local, of_local = uncertainty.concat_locally_uncertain_transforms(a, b, P[0], P[1])
    return {
        "global composition": (log(B @ A @ np.linalg.inv(whole)), of_whole),
        "local composition": (log(np.linalg.inv(local) @ B @ A), of_local),
        "inverse": (log(np.linalg.inv(inverse @ A)), of_inverse),
        "fusion of three": (log(A @ np.linalg.inv(fused)), of_fused),
    }


def judged(draws):
    found = [estimated(xi) for xi in draws]
    return {name: tuple(np.array([each[name][k] for each in found]) for k in (0, 1)) for name in found[0]}


def second():
    """Derivatives of the errors by those of the poses, at the truth."""
    h, out = 1e-6, []
    moved = [[estimated(sign * h * d) for sign in (1, -1)] for d in np.eye(18).reshape(18, 3, 6)]
    for name, (_, stated) in estimated(np.zeros((3, 6))).items():
        J = np.array([(plus[name][0] - minus[name][0]) / (2 * h) for plus, minus in moved]).reshape(3, 6, 6)
        right = sum(j.T @ C @ j for j, C in zip(J, P, strict=True))
        out.append(Argument(name, "derivatives of the error by those of the poses", stated, right, rtol=0.03))
    return out


CASE = Case("pytransform3d", AXES, 150, simulate, judged, textbook, second)

if __name__ == "__main__":
    CASE.main()
