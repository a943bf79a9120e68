"""The referee: from any source to a record, from a record to a verdict, from a verdict to a document.

NumPy, SciPy and the command line are all that it needs. It knows neither the bench nor the stereo laboratory.
"""
