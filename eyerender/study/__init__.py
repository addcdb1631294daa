"""The replications of two comparative studies, the comparison of observers on them, and conditions beyond the paper."""
