"""Statistics of filter consistency: arrays in, verdicts out; needs numpy and scipy only.

A module imports only modules of the same line or above it:

record, groups, whitening: what is given
verdict, verdict_parts: what is found, as plain types
nees, number_of_runs, distributions, exceedance, normal_numbers: statistics
sample, scale, bias_and_shape, whiteness, tails, maps, bounds, uncertain_truth, residuals_of_fit, planning: questions
error_parts, fault_location, status, record_findings: from the tests to findings
sentences, fault_words, bound_words, number_words: a verdict in words
judge_record, comparison: what callers ask; monitor is for a deployed filter

Tables, plots and files do not belong here.
"""
