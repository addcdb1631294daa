"""Report of the observers on the head-mounted rig."""

from __future__ import annotations

from collections.abc import Sequence

from . import head_mounted as h
from .budget import Budget
from .observers_compared import FeatureDifference
from .page_parts import Apart, Report, Values, budget_values, findings_values, number, observers_values
from .results import Finding, ModelResults


def page(
    parts: Sequence[ModelResults], found: Sequence[Finding], apart: Apart, made_of: Sequence[Budget] = ()
) -> Report:
    """Compose the report."""
    values: Values = {
        "reach": {"azimuth_deg": f"{max(h.AZIMUTHS_DEG):g}", "elevation_deg": f"{max(h.ELEVATIONS_DEG):g}"},
        "centres": _centres(apart[0]),
        "budget": budget_values(made_of, tuple(h.FEATURES)),
        "observers": observers_values(apart, tuple(h.FEATURES)),
        "rows": [
            (r.eye_model, r.observer, r.variant or "", number(r.mean_deg), number(r.sd_deg), str(r.n), str(r.missing))
            for part in parts
            for r in part.rows
        ],
        "findings": findings_values(found),
    }
    return Report("observers.html.j2", values)


def _centres(features: Sequence[FeatureDifference]) -> list[tuple[str, str]]:
    """Collect (distances of the pupil's centre by eye model, observer)."""
    out = []
    for observer in dict.fromkeys(f.observer for f in features):
        values = {f.eye_model: f for f in features if (f.observer, f.feature) == (observer, "pupil centre")}
        text = " ".join(f"{m}\u00a0{number(f.median_distance_px, 3)}" for m, f in values.items())
        out.append((text, observer))
    return out
