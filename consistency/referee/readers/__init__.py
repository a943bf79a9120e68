"""Files of other estimators, read as errors and covariances; docs/files.md describes the formats."""
