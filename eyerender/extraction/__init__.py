"""Extraction of the pupil ellipse and the glints from a near-infrared image."""

from __future__ import annotations

from .glints.matching import Assignment, assign_lights, identify, predict_glints
from .pair import extract_eyes
from .pipeline import extract
from .result import Extraction, GlintResult, Goodness, PupilResult
from .settings import FAST, REFINED, ExtractionSettings

__all__ = [
    "FAST",
    "REFINED",
    "Assignment",
    "Extraction",
    "ExtractionSettings",
    "GlintResult",
    "Goodness",
    "PupilResult",
    "assign_lights",
    "extract",
    "extract_eyes",
    "identify",
    "predict_glints",
]
