"""The fits as Python calls them: their errors name arguments, where those of commands name flags."""

from consistency.referee.errors import naming_arguments
from consistency.referee.fit_covariance.correct import correct as _correct
from consistency.referee.fit_covariance.noise_model import fit_covariance as _fit_covariance

correct, fit_covariance = naming_arguments(_correct), naming_arguments(_fit_covariance)
correct.__module__ = fit_covariance.__module__ = __name__  # by which they cross processes
