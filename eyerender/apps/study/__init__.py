"""Replications of two comparative studies, comparison of the observers on them, and further conditions."""
