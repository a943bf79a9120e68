"""The sections of a report; ``study_sections`` has their order."""
