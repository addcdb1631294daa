"""Rig design: what a rig can know about gaze (Fisher information), fits of eyes to features, eye safety."""
