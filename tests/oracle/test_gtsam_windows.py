"""Windows of a chain of motions: gtsam's joint marginals and independent motions say the same, in files as well."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import consistency as cs

gtsam = pytest.importorskip("gtsam", reason="gtsam is not installed: pip install -e '.[smoothing]'")

from relative_poses import drive, motion_stretch, vectors  # noqa: E402

STEPS, APART = 40, 5
ROTATION_FIRST = [3, 4, 5, 0, 1, 2]


def test_joint_marginals_of_keyframes_agree_with_independent_motions(tmp_path, rng):
    """As docs/files.md writes them: the error ``left``, rotation first."""
    log = drive(rng, "SE(3)", STEPS)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    start = gtsam.Pose3(gtsam.Rot3.Rodrigues(0.3, -0.8, 1.1), np.array([4.0, -2.0, 7.0]))
    graph.add(gtsam.PriorFactorPose3(0, start, gtsam.noiseModel.Diagonal.Sigmas(np.full(6, 0.3))))
    values.insert(0, start)
    for k, (D, S) in enumerate(zip(log.motions, log.covariance, strict=True)):
        noise = gtsam.noiseModel.Gaussian.Covariance(S[ROTATION_FIRST][:, ROTATION_FIRST])
        graph.add(gtsam.BetweenFactorPose3(k, k + 1, gtsam.Pose3(D), noise))
        values.insert(k + 1, values.atPose3(k).compose(gtsam.Pose3(D)))
    marginals = gtsam.Marginals(graph, values)
    lines = []
    keys = range(0, STEPS + 1, APART)
    for before, key in zip([None, *keys], keys, strict=False):
        P, cross = marginals.marginalCovariance(key), np.zeros((6, 6))
        if before is not None:
            joint = marginals.jointMarginalCovariance(gtsam.KeyVector([before, key])).fullMatrix()
            P, cross = joint[6:, 6:], joint[:6, 6:]
        lines.append([0.1 * key, *P.ravel(), *cross.ravel()])
    estimates = vectors(np.array([values.atPose3(key).matrix() for key in keys]))
    s = motion_stretch(log)
    t = np.array(lines)[:, :1]
    np.savetxt(tmp_path / "est.tum", np.column_stack([t, estimates]), fmt="%.17g")
    np.savetxt(tmp_path / "P.txt", lines, fmt="%.17g")
    np.savetxt(tmp_path / "truth.tum", np.column_stack([s.own.t, s.true.values]), fmt="%.17g")
    np.savetxt(
        tmp_path / "motions.tum",
        np.column_stack([s.own.t, s.own.estimate, s.own.covariance.reshape(-1, 36)]),
        fmt="%.17g",
    )
    poses = cs.read(
        tmp_path / "est.tum", tmp_path / "truth.tum", tmp_path / "P.txt", "left", relative=1,
        covariance_order="rotation-translation",
    )  # fmt: skip
    motions = cs.read(tmp_path / "motions.tum", tmp_path / "truth.tum", relative=APART, motions=True)
    assert_allclose(poses.errors.error, motions.errors.error, atol=1e-9)
    assert_allclose(poses.errors.covariance, motions.errors.covariance, rtol=1e-6, atol=1e-12)
    assert_allclose(poses.errors.nees, motions.errors.nees, rtol=1e-6)
