"""What the page says in numbers and reasons: the table of features."""

from __future__ import annotations

import html
from typing import Any

import numpy as np

from ..observation import Observations


def feature_table(truth: Observations, found: Observations | None, hidden: tuple[str, ...]) -> str:
    """An HTML table of the pupil and the glints of one row: by ray optics, and from the picture.

    Args:
        truth: what the analytic observer reports, one row.
        found: what the image observer reports, one row; None where it was not asked.
        hidden: what hides the glint of each light in the picture.
    """
    rows = [_pupil_row(truth, found)]
    for k, light in enumerate(truth.glints.light[0]):
        rows.append(_glint_row(truth, found, k, int(light), hidden[int(light)] if int(light) < len(hidden) else ""))
    head = "<tr><th>px</th><th>analytic</th><th>extracted</th><th>difference</th></tr>"
    return f"<table>{head}{''.join(rows)}</table>"


def _pupil_row(truth: Observations, found: Observations | None) -> str:
    exact = truth.pupil.centre_px[0] if truth.pupil.ok[0] else None
    seen = found.pupil.centre_px[0] if found is not None and found.pupil.ok[0] else None
    why = found.pupil.reason[0] if found is not None and seen is None else ""
    return _row("pupil", exact, truth.pupil.reason[0], seen, why)


def _glint_row(truth: Observations, found: Observations | None, k: int, light: int, hidden: str) -> str:
    exact = truth.glints.xy_px[0, k] if truth.glints.ok[0, k] else None
    seen, why = None, ""
    if found is not None:
        at = np.flatnonzero(found.glints.ok[0] & (found.glints.light[0] == light))
        seen = found.glints.xy_px[0, at[0]] if len(at) else None
        why = "not found" if hidden in ("", "visible") else f"hidden: {hidden}"
    return _row(f"glint {light}", exact, truth.glints.reason[0, k], seen, why)


def _row(name: str, exact: Any, why_exact: Any, seen: Any, why_seen: Any) -> str:
    apart = f"{np.hypot(*(np.asarray(seen) - exact)):.2f}" if exact is not None and seen is not None else ""
    return f"<tr><td>{name}</td>{_cell(exact, why_exact)}{_cell(seen, why_seen)}<td>{apart}</td></tr>"


def _cell(place: Any, reason: Any) -> str:
    if place is None:
        return f'<td class="none">{html.escape(str(reason or ""))}</td>'
    return f"<td>{place[0]:.2f}, {place[1]:.2f}</td>"
