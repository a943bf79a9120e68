"""Names of the stereo front-end and the modules they come from; ``__init__.py`` loads each when it is first used."""

from .consensus import register_ransac as register_ransac
from .errors import ConsensusError as ConsensusError
from .errors import ConvergenceError as ConvergenceError
from .errors import DegenerateError as DegenerateError
from .errors import GimbalLockError as GimbalLockError
from .errors import PointError as PointError
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
from .registration import register_svd as register_svd
from .rig import StereoRig as StereoRig
from .rig import triangulable as triangulable
from .rig import triangulate as triangulate
