"""The integrator: set-up of a frame, samples of its pixels, and their shading."""
