"""Parts of an eye that a pixel shows: the classes of a mask (docs/formats.md)."""

BACKGROUND, SCLERA, IRIS, PUPIL, FRAME = 0, 1, 2, 3, 4
"""Background or skin, sclera, iris, pupil, and what frames the camera's view."""
