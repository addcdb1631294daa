"""Parts of an eye that a pixel shows: the classes of a mask (docs/formats.md)."""

BACKGROUND, SCLERA, IRIS, PUPIL, FRAME, SPECTACLES = 0, 1, 2, 3, 4, 5
"""Background or skin, sclera, iris, pupil, what frames the camera's view, and the frame of spectacles."""
