"""Gaze estimators: observations in, gaze points out."""
