"""Names of the stereo front-end and the modules they come from; ``__init__.py`` loads each when it is first used."""

from .cameras.input_errors import ConsensusError as ConsensusError
from .cameras.input_errors import ConvergenceError as ConvergenceError
from .cameras.input_errors import DegenerateError as DegenerateError
from .cameras.input_errors import GimbalLockError as GimbalLockError
from .cameras.input_errors import PointError as PointError
from .cameras.rig import StereoRig as StereoRig
from .cameras.rig import triangulable as triangulable
from .cameras.rig import triangulate as triangulate
from .covariance_propagation import implicit_covariance as implicit_covariance
from .covariance_propagation import registration_covariance as registration_covariance
from .covariance_propagation import triangulation_covariance as triangulation_covariance
from .maximum_likelihood import Refined as Refined
from .maximum_likelihood import refine_reprojection as refine_reprojection
from .maximum_likelihood import register_weighted as register_weighted
from .motion import relative_motion as relative_motion
from .registration import register_horn as register_horn
from .registration import register_ransac as register_ransac
from .registration import register_svd as register_svd
from .relative_pose import RelativePose as RelativePose
from .relative_pose import compose as compose
from .relative_pose import invert as invert
