"""The monitor of a deployed filter, and innovations behind a validation gate."""
