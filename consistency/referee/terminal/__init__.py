"""What a terminal shows: the progress of long work, and tables of verdicts, comparisons and findings.

Here belongs text for people who wait or read on a terminal, and its JSON for programs. Commands and their options are
in ``cli``; reports as files are in ``reporting``.
"""
