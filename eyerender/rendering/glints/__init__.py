"""Corneal reflections and Purkinje images: traced, cut at edges, occluded, and splatted into the image."""
