"""Ray optics: media, interfaces, tracing, and the solvers for apparent points and mirror points."""
