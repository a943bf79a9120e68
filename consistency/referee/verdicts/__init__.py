"""From tables to verdicts: results judged, compared with others or a baseline, and watched by the monitor.

Here belongs the way between tables and :mod:`consistency.diagnostics`, which has the statistics and knows arrays only.
Nothing here runs a filter (``runs``), prints (``terminal``) or draws (``reporting``).
"""
