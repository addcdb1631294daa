"""The replications of two comparative studies, the comparison of observers on them, and what lies beyond the paper."""
