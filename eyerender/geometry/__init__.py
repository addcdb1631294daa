"""Geometry shared by every observer: transforms, surfaces and the ellipse."""
