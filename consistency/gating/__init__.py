"""What stands behind the gates of ``consistency.testing``: checks of input, the session's watch, budget and report.

No statistic belongs here; those are in ``diagnostics``.
"""
