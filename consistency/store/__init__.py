"""What is kept: files that appear whole, Parquet tables, output folders with a manifest, results and logs.

Here belongs how tables are laid out, written, read and checked. What a verdict makes of them is in ``verdicts``; who
produces them is in ``runs``; files of other people's estimators are read in ``recording``.
"""
