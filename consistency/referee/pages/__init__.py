"""Pages on the verdicts and records of any estimator: what a document of them holds, in which order."""
