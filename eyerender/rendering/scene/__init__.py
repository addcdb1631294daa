"""Scenes of triangles (eye region, head, background), and classes of pixels from their projection."""
