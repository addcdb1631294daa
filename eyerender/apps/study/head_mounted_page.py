"""Report of the observers on the head-mounted rig."""

from __future__ import annotations

from collections.abc import Sequence

from ...report.page import Card, Page, Section, Table, number
from . import head_mounted as h
from .budget import Budget
from .observers_compared import FeatureDifference
from .page_parts import ABOUT_OBSERVERS, Apart, budget_section, findings_section, observers_section
from .results import Finding, ModelResults


def page(parts: Sequence[ModelResults], found: Sequence[Finding], apart: Apart, made_of: Sequence[Budget] = ()) -> Page:
    """Compose the report."""
    lead = [
        "An eye camera is 35 mm in front of the right eye, with a ring of six LEDs around it. Both observers see the "
        f"eye in 5 x 5 directions, up to {max(h.AZIMUTHS_DEG):g} deg to each side and {max(h.ELEVATIONS_DEG):g} deg up "
        "and down.",
        ABOUT_OBSERVERS,
    ]
    rows = [
        (r.eye_model, r.observer, r.variant or "", number(r.mean_deg), number(r.sd_deg), str(r.n), str(r.missing))
        for part in parts
        for r in part.rows
    ]
    sections = [
        budget_section(made_of, tuple(h.FEATURES), "the polynomial"),
        observers_section(apart, tuple(h.FEATURES)),
        Section(
            "Errors of the direction",
            "A second-order polynomial maps the feature to the azimuth and elevation of the optic axis. It is "
            "fitted on nine directions and tested on the sixteen between them.",
            Table(("eye model", "observer", "feature", "mean (deg)", "SD (deg)", "n", "missing"), rows),
        ),
        findings_section(found),
    ]
    return Page("The observers on a head-mounted rig", lead, _centres(apart[0]), sections)


def _centres(features: Sequence[FeatureDifference]) -> list[Card]:
    """Return a card per observer with the distances of the pupil's centre by eye model."""
    out = []
    for observer in dict.fromkeys(f.observer for f in features):
        values = {f.eye_model: f for f in features if (f.observer, f.feature) == (observer, "pupil centre")}
        text = " ".join(f"{m}\u00a0{number(f.median_distance_px, 3)}" for m, f in values.items())
        out.append(Card(text, f"median distance of the pupil centre from ray optics (px), {observer}"))
    return out
