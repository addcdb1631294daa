"""Rig design: information about gaze (Fisher), fits of eyes to features, and eye safety."""
