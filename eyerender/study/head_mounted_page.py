"""The report of the observers on the head-mounted rig."""

from __future__ import annotations

from collections.abc import Sequence

from ..report.study import Card, Page, Section, Table
from . import head_mounted as h
from .budget import Budget
from .head_mounted import HeadMountedPart
from .page_parts import OBSERVERS, Apart, budget_section, findings_section, number, observers_section
from .results import Finding


def page(
    parts: Sequence[HeadMountedPart], found: Sequence[Finding], apart: Apart, made_of: Sequence[Budget] = ()
) -> Page:
    """The report."""
    features, _ = apart
    cards = []
    for observer in dict.fromkeys(f.observer for f in features):
        values = {f.eye_model: f for f in features if (f.observer, f.feature) == (observer, "pupil centre")}
        text = " ".join(f"{m}\u00a0{number(f.median_distance_px, 3)}" for m, f in values.items())
        cards.append(Card(text, f"median distance of the pupil's centre from ray optics (px), {observer}"))
    sections = [
        *budget_section(made_of, h.FEATURES, "the polynomial"),
        *observers_section(apart, h.FEATURES),
        Section(
            "Errors of the direction",
            (
                "A polynomial of second order takes the feature to azimuth and elevation of the optic axis: fitted on "
                "nine directions, tested on the sixteen between them.",
            ),
            (),
            [_rows(parts)],
        ),
        findings_section(found),
    ]
    lead = (
        "An eye camera 35 mm before the right eye, with six LEDs on a ring around it: 5 x 5 directions of the eye, "
        f"{max(h.AZIMUTHS_DEG):g} deg to each side and {max(h.ELEVATIONS_DEG):g} deg up and down, seen by both "
        "observers.",
        OBSERVERS,
    )
    return Page("The observers on a head-mounted rig", lead, cards, sections)


def _rows(parts: Sequence[HeadMountedPart]) -> Table:
    rows = [
        (r.eye_model, r.observer, r.variant or "", number(r.mean_deg), number(r.sd_deg), str(r.n), str(r.missing))
        for part in parts
        for r in part.rows
    ]
    header = ("eye model", "observer", "feature", "mean (deg)", "SD (deg)", "n", "missing")
    return Table(header, rows)
