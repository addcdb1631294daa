"""Results of a study: rows of errors and findings, and their files."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from ...base.arrays import Floats
from ...base.errors import InputError
from ...base.storage.files import csv_text, write_json, write_text
from ...folders.imagefolder import versions
from ...rig.rig import RigGeometry
from ...scene.observation import Observations

SUMMARY_SCHEMA = "eyerender/study-summary/1"
FINDINGS_SCHEMA = "eyerender/study-findings/2"


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One mean error; keys that do not apply are None.

    `sd_deg` is over the fixations (n - 1). `missing` counts those without an estimate, `in_image` those whose features
    lie on the sensor. `reason` explains a missing mean, `solution` names how the coefficients were found.
    """

    protocol: str
    observer: str
    variant: str | None
    eye_model: str
    eye: str
    head: str | None
    calibration: str | None
    function: str | None
    mean_deg: float | None
    sd_deg: float | None
    n: int
    missing: int = 0
    in_image: int | None = None
    reason: str | None = None
    solution: str | None = None


@dataclass(slots=True, kw_only=True)
class ModelResults:
    """Results of a study for one eye model."""

    eye_model: str  # the eye model, or the name of a drawn person
    person: Mapping[str, Any] | None = None  # the choice of a drawn person: preset, seed, subject
    rows: list[Row] = field(default_factory=list)  # mean errors
    # rig and observations, by (protocol, observer)
    seen: dict[tuple[str, str], tuple[RigGeometry, Observations]] = field(default_factory=dict)
    # errors (n,) deg, by (protocol, observer) and estimator
    errors: dict[tuple[str, str], dict[str, Floats]] = field(default_factory=dict)
    # error vectors (n, 2) deg to the right and up (`error_vectors_deg`)
    vectors: dict[tuple[str, str], dict[str, Floats]] = field(default_factory=dict)
    # error vectors (s, n, 2) of s further exposures of images without noise, each with other noise
    seed_vectors: dict[tuple[str, str], dict[str, Floats]] = field(default_factory=dict)
    # results of the estimators, by (protocol, observer) and estimator
    done: dict[tuple[str, str], Any] = field(default_factory=dict)
    # errors as departures are corrected one after the other
    waterfall: list[WaterfallStep] = field(default_factory=list)
    more: dict[str, Any] = field(default_factory=dict)  # what a study computes besides


def keys_of(parts: Sequence[ModelResults]) -> list[tuple[str, str]]:
    """Return every (protocol, observer) of a run, in order."""
    return list(dict.fromkeys(key for part in parts for key in part.done))


def over_seeds(found: Sequence[dict[str, Floats]]) -> dict[str, Floats]:
    """Stack the error vectors (n, 2) of every seed, (s, n, 2) by estimator; skip estimators that a seed lacks."""
    names = [name for name in (found[0] if found else ()) if all(name in one for one in found)]
    return {name: np.stack([one[name] for one in found]) for name in names}


@dataclass(frozen=True, slots=True)
class Finding:
    """One statement tested on the study's own data; `verdict` is None where it cannot be tested.

    `sentence` quotes the paper; empty if there is no published claim.
    """

    id: str
    protocol: str
    observer: str
    rule: str
    value: float | None
    threshold: str
    verdict: bool | None
    detail: str
    sentence: str = ""

    @classmethod
    def of(
        cls,
        id: str,
        key: tuple[str, str],
        rule: str,
        value: float,
        threshold: str,
        detail: str = "",
        sentence: str = "",
    ) -> Finding:
        """Test a value against a threshold such as "< 0.01", ">= 2", "= 1" or "0.1 to 0.2"; "none" has no verdict.

        >>> er.apps.Finding.of("S1", ("own", "analytic"), "largest error (deg)", 0.3, "< 0.5").verdict
        True
        """
        verdict = None if threshold == "none" else holds(float(value), threshold)
        return cls(id, *key, rule, float(value), threshold, verdict, detail, sentence)


_COMPARE = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "=": operator.eq}


def holds(value: float, threshold: str) -> bool:
    """Return whether a value meets a threshold; NaN meets none.

    Raises:
        InputError: the threshold is not of the form of `Finding.of`.
    """
    try:
        if " to " in threshold:
            low, high = map(float, threshold.split(" to "))
            return low <= value <= high
        sign, limit = threshold.split()
        return bool(_COMPARE[sign](value, float(limit)))
    except (ValueError, KeyError):
        raise InputError(
            f"must be such as '< 0.1', '= 1' or '0.1 to 0.2', not {threshold!r}", path="threshold"
        ) from None


@dataclass(frozen=True, slots=True, kw_only=True)
class Departure:
    """A difference between the authors' software and the paper's text."""

    id: str
    title: str
    paper: str
    software: str
    corrected: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Erratum:
    """A misprint of a table or the text, the value used instead, and the effect of the misprint."""

    where: str
    printed: str
    used: str
    effect: str


@dataclass(frozen=True, slots=True)
class WaterfallStep:
    """Mean errors (deg) of one eye model after a departure has been corrected, and with only it corrected.

    `departure` is "published" for the start. `errors` holds the study's own measures by name.
    """

    eye_model: str
    departure: str
    errors: dict[str, float | None]
    alone: dict[str, float | None]


def mean_row(error_deg: Floats, **keys: Any) -> Row:
    """Create a row for errors (n,); NaN counts as missing."""
    good = error_deg[np.isfinite(error_deg)]
    n = len(good)
    return Row(
        mean_deg=known_mean(error_deg),
        sd_deg=float(good.std(ddof=1)) if n > 1 else None,
        n=n,
        missing=int(len(error_deg) - n),
        **{"variant": None, "head": None, "calibration": None, "function": None, **keys},
    )


def known_mean(errors: Floats) -> float | None:
    """Average the errors (n,) that are not NaN; None if there are none."""
    good = errors[np.isfinite(errors)]
    return float(good.mean()) if len(good) else None


def write_results(folder: Path, study: str, settings: Mapping[str, Any], report: Any) -> dict[str, Any]:
    """Write summary.json, findings.json, both as CSV, and further tables of a `StudyReport`; return the summary."""
    rows = [row if isinstance(row, Mapping) else asdict(row) for row in report.rows]
    head = {"schema": SUMMARY_SCHEMA, "study": study, "versions": versions()}
    summary = {**head, **settings, **report.more, "rows": rows}
    write_json(folder / "summary.json", summary)
    if not report.rows or isinstance(report.rows[0], Row):
        found = [asdict(finding) for finding in report.findings]
        write_json(folder / "findings.json", {"schema": FINDINGS_SCHEMA, "study": study, "findings": found})
        write_text(folder / "summary.csv", table(Row, report.rows))
        write_text(folder / "findings.csv", table(Finding, report.findings))
    for name, (header, lines) in report.tables.items():
        write_text(folder / name, csv_text(header, lines))
    return summary


def table(kind: type, items: Sequence[Any]) -> str:
    """Format dataclasses as CSV; empty cells for None."""
    names = [f.name for f in fields(kind)]
    return csv_text(names, ([getattr(item, name) for name in names] for item in items))
