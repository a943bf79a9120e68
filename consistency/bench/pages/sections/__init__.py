"""The sections of a report, each in a file of its own; ``consistency/bench/pages/contents.py`` has their order."""
