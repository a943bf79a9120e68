"""Implementation of the gates of ``consistency.testing``: checks of input, the session's watch, budget and report.

Statistics do not belong here; they are in ``diagnostics``.
"""
