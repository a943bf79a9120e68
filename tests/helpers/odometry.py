"""Windows of simulated drives."""

from consistency.referee.fit_covariance.drives import cut_windows, span_of


def windows(made, span="10m"):
    """Windows of drives over one span."""
    return cut_windows(made, span_of(span))
