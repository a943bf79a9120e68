"""The sections of a report, each in a file of its own; ``consistency/reporting/contents.py`` has their order."""
