"""The integrator: frame set-up, camera samples, and their shading."""
