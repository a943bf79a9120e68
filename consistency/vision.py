"""The stereo front-end: from matches or images to a relative pose with its covariance.

Only :func:`relative_motion` and what else works on images needs OpenCV, the extra ``vision``.
"""

from consistency.referee.extras import explained_import

with explained_import(__name__):
    from consistency.referee.diagnostics.uncertain_truth import SharedError
    from consistency.stereo.visual_odometry.arrays import (
        ConsensusError,
        ConvergenceError,
        DegenerateError,
        GimbalLockError,
        PointError,
    )
    from consistency.stereo.visual_odometry.maximum_likelihood import (
        Refined,
        implicit_covariance,
        refine_reprojection,
        register_weighted,
        registration_covariance,
        triangulation_covariance,
    )
    from consistency.stereo.visual_odometry.odometry import fit_shared, sensitivities, trajectory
    from consistency.stereo.visual_odometry.relative_motion import RelativeMotion, relative_motion
    from consistency.stereo.visual_odometry.relative_pose import (
        RelativePose,
        compose,
        invert,
        register_horn,
        register_ransac,
        register_svd,
    )
    from consistency.stereo.visual_odometry.rig import StereoRig, triangulable, triangulate
    from consistency.stereo.visual_odometry.sequence import read_image, read_sequence

__all__ = [
    "ConsensusError",
    "ConvergenceError",
    "DegenerateError",
    "GimbalLockError",
    "PointError",
    "Refined",
    "RelativeMotion",
    "RelativePose",
    "SharedError",
    "StereoRig",
    "compose",
    "fit_shared",
    "implicit_covariance",
    "invert",
    "read_image",
    "read_sequence",
    "refine_reprojection",
    "register_horn",
    "register_ransac",
    "register_svd",
    "register_weighted",
    "registration_covariance",
    "relative_motion",
    "sensitivities",
    "trajectory",
    "triangulable",
    "triangulate",
    "triangulation_covariance",
]
