"""Pages on the verdicts and records of any estimator: what a document of them holds, and documents as files."""
