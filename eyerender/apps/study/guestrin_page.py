"""Report of the replication of Guestrin & Eizenman (2006)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ...gaze.budget import mean_interval
from . import guestrin
from . import literature as lit
from .budget import Budget
from .figures import heads_figure
from .page_parts import (
    Apart,
    Report,
    Values,
    budget_values,
    errata_values,
    findings_values,
    number,
    observers_values,
    overview,
    waterfall_values,
)
from .replicate import GuestrinPart
from .results import Erratum, Finding

# These estimators are drawn.
SHOWN = ("model-based, index fixed", "model-based, index free")


def page(
    parts: Sequence[GuestrinPart],
    found: Sequence[Finding],
    tests: Sequence[dict[str, Any]],
    faults: Sequence[Erratum],
    apart: Apart = ((), ()),
    made_of: Sequence[Budget] = (),
) -> Report:
    """Compose the report of the replication of Guestrin & Eizenman (2006)."""
    values: Values = {
        "overview": overview(_cells(parts)),
        "budget": budget_values(made_of, SHOWN),
        "heads": _heads_figure(parts),
        "e5": _about_e5(parts),
        "means": _mean_rows(parts),
        "tests": [_test_row(t) for t in tests],
        "observers": observers_values(apart, SHOWN),
        "findings": findings_values(found),
        "waterfall": waterfall_values([s for p in parts for s in p.waterfall], guestrin.DEPARTURES, ("H1", "H2")),
        "errata": errata_values(guestrin.DEPARTURES, faults),
        "calibrations": [_calibration_row(c) for part in parts for c in part.calibrations],
    }
    return Report("guestrin2006.html.j2", values)


def _by_key(parts: Sequence[GuestrinPart]) -> dict[tuple[str, str], dict[str, dict[str, float]]]:
    """Group means (deg): (protocol, observer) -> eye model -> head."""
    keys = dict.fromkeys(key for part in parts for key in part.means)
    return {key: {p.eye_model: p.means[key] for p in parts if key in p.means} for key in keys}


def _cells(parts: Sequence[GuestrinPart]) -> dict[tuple[str, str], dict[str, str]]:
    return {
        # The published variants of E5 are in the section's text and table.
        key: {m: f"{v['H1']:.2f}/{v['H2']:.2f}" for m, v in means.items() if m not in lit.VARIANTS or len(means) == 1}
        for key, means in _by_key(parts).items()
    }


def _heads_figure(parts: Sequence[GuestrinPart]) -> str | None:
    """Draw Figure 4 of the paper; None if every error is too large for it."""
    # A variant with errors above 11 deg would flatten the other curves.
    shown = {
        f"{protocol}, {observer}": {m: v for m, v in means.items() if max(v.values()) < 3}
        for (protocol, observer), means in _by_key(parts).items()
    }
    own = {label: means for label, means in shown.items() if means}
    if not own:
        return None
    measured = {h: lit.guestrin_deg(h) for h in guestrin.HEADS}
    interval = {h: mean_interval(v)[1:] for h, v in measured.items()}
    return heads_figure(own, dict(lit.PAPER_GUESTRIN), measured, interval)


def _about_e5(parts: Sequence[GuestrinPart]) -> dict[str, str] | None:
    """Explain the paper's 'errors exceeding 11 deg' with E5 and its variants, if all of them were run."""
    means = {p.eye_model: p.means["published", "analytic"] for p in parts if ("published", "analytic") in p.means}
    told = {m: f"{v['H1']:.2f}/{v['H2']:.2f} deg" for m, v in means.items() if m.startswith("E5")}
    return told if {"E5", *lit.VARIANTS} <= set(told) else None


def _mean_rows(parts: Sequence[GuestrinPart]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for row in (row for part in parts for row in part.rows):
        paper = lit.PAPER_GUESTRIN.get(row.eye_model)
        printed = "-" if paper is None else f"{paper[0 if row.head == 'H1' else 1]:.2f}"
        rows.append(
            (
                row.protocol, row.observer, row.variant or "", row.eye_model, row.eye, row.head or "",
                number(row.mean_deg), number(row.sd_deg), str(row.n), str(row.missing), str(row.in_image), printed,
            )
        )  # fmt: skip
    return rows


def _test_row(t: dict[str, Any]) -> tuple[str, ...]:
    return (
        str(t["protocol"]), str(t["observer"]), str(t["eye_model"]), str(t["head"]), f"{t['simulated_deg']:.3f}",
        f"{t['measured_deg']:.3f} ({t['measured_sd_deg']:.3f})", f"{t['t']:.2f}", f"{t['p']:.2g}",
        "yes" if t["differs"] else "no",
    )  # fmt: skip


def _calibration_row(c: dict[str, Any]) -> tuple[str, ...]:
    p, spread = c["calibration"]["parameters"], c["restarts"]
    low, high = spread["h1_mean_deg"]["min"], spread["h1_mean_deg"]["max"]
    return (
        c["protocol"], c["variant"], c["eye_model"], f"{p['cornea_radius_mm']:.3f}", f"{p['pupil_distance_mm']:.3f}",
        f"{p['index']:.4f}", f"{p['alpha_deg']:.3f}", f"{p['beta_deg']:.3f}",
        ", ".join(c["calibration"]["at_bound"]) or "-", f"{c['h1_mean_deg']:.4f}", f"{low:.4f} to {high:.4f}",
        f"{spread['within_1e-4_of_the_lowest_cost']} of {spread['count']}",
    )  # fmt: skip
