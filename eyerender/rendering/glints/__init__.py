"""Corneal reflections and Purkinje images: traced, cut at edges, splatted, and occluded."""
