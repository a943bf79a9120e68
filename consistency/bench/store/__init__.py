"""Storage: files that appear whole, Parquet tables, output folders with a manifest, results and logs.

The layout of tables, and their writing, reading and checks belong here. Verdicts on them are in ``verdicts``, the code
that produces them is in ``runs``, and files of other estimators are read by ``referee.readers``.
"""
