"""Scenes of triangles: the eye region, a head, the background; and what pixels can show, from their projection."""
