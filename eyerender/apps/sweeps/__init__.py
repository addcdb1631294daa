"""Sweeps: many layouts of a rig, judged over people."""
