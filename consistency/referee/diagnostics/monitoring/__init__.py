"""The monitor of a filter in service, and innovations behind a validation gate."""
