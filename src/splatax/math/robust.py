"""Robust statistics."""

MAD_TO_SIGMA = 1.4826  # standard deviation over the median absolute deviation of a normal distribution
