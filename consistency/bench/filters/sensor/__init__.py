"""What a mounted sensor measures of a point: h and its inverse, one file for each observation model."""
