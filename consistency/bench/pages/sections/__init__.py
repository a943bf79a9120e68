"""The sections of a report; ``consistency/bench/pages/contents.py`` has their order."""
