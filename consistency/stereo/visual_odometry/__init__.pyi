"""Names of the stereo front-end and the modules they come from; ``__init__.py`` loads each when it is first used."""

from .cameras.rig import StereoRig as StereoRig
from .cameras.rig import triangulable as triangulable
from .cameras.rig import triangulate as triangulate
from .input_errors import ConsensusError as ConsensusError
from .input_errors import ConvergenceError as ConvergenceError
from .input_errors import DegenerateError as DegenerateError
from .input_errors import GimbalLockError as GimbalLockError
from .input_errors import PointError as PointError
from .motion import relative_motion as relative_motion
from .pose import RelativePose as RelativePose
from .pose import compose as compose
from .pose import invert as invert
from .propagation import implicit_covariance as implicit_covariance
from .propagation import registration_covariance as registration_covariance
from .propagation import triangulation_covariance as triangulation_covariance
from .refinement import Refined as Refined
from .refinement import refine_reprojection as refine_reprojection
from .refinement import register_weighted as register_weighted
from .registration import register_horn as register_horn
from .registration import register_ransac as register_ransac
from .registration import register_svd as register_svd
