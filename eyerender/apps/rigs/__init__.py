"""The report on a rig over a population."""
