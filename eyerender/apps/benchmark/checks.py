"""Checks for regression tests: required results, and losses against an earlier benchmark."""

from __future__ import annotations

import operator
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...base.errors import WRONG, InputError
from ...base.storage.files import read_json, shown
from .intervals import mcnemar

RESULTS_SCHEMA = "eyerender/bench-extractors/3"
LEVEL = 0.05
_RESULTS_BYTES = 2**30
_OPERATORS = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}
_REQUIREMENT = re.compile(r"(?:(?P<name>.+):)?(?P<figure>[a-z_0-9]+)\s*(?P<how>>=|<=|>|<)\s*(?P<bar>[0-9.eE+-]+)")
# Results that can be required, and their position in a summary.
FIGURES = {
    **{name: ("rates", name) for name in ("right", "wrong", "none", "error", "false")},
    "centre_px": ("centre_px", "median"),
    "centre_px_p95": ("centre_px", "p95"),
    "boundary_px": ("boundary_px", "median"),
    "iou": ("iou", "median"),
    "efficiency": ("efficiency", "value"),
    "glint_recall": ("glints", "recall"),
    "glint_precision": ("glints", "precision"),
    "swap_rate": ("glints", "swap_rate"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Requirement:
    """A bar for a result of one extractor, or of all (name "")."""

    text: str
    name: str
    figure: str
    how: str
    bar: float

    @classmethod
    def parse(cls, text: str, names: Sequence[str]) -> Requirement:
        """Parse `[NAME:]FIGURE>=NUMBER`, where NAME is one of the extractors' names.

        Raises:
            InputError: the text has another form, or there is no such result or extractor.
        """
        found = _REQUIREMENT.fullmatch(text.strip())
        if found is None:
            raise InputError(f"must be [NAME:]FIGURE>=NUMBER, not {shown(text)}", source="--require")
        if found["figure"] not in FIGURES:
            known = ", ".join(FIGURES)
            raise InputError(f"there is no figure {found['figure']!r}; there are {known}", source="--require")
        if found["name"] and found["name"] not in names:
            raise InputError(f"there is no extractor {found['name']!r} in this bench", source="--require")
        try:
            bar = float(found["bar"])
        except ValueError:
            raise InputError(f"{found['bar']!r} is not a number", source="--require") from None
        return cls(text=text, name=found["name"] or "", figure=found["figure"], how=found["how"], bar=bar)

    def check(self, entry: dict[str, Any]) -> dict[str, Any]:
        """Compare an extractor's result with the bar; a missing result fails."""
        group, key = FIGURES[self.figure]
        value = (entry["summary"][group] or {}).get(key)
        met = value is not None and bool(_OPERATORS[self.how](value, self.bar))
        return {"extractor": entry["name"], "require": self.text, "value": value, "met": met}


def read_results(path: str | Path) -> dict[str, Any]:
    """Read results.json of an earlier benchmark; InputError if the file is not such a result."""
    data = read_json(path, limit=_RESULTS_BYTES)
    if data.get("schema") != RESULTS_SCHEMA:
        raise InputError(f"is {shown(data.get('schema'))}; --against reads {RESULTS_SCHEMA!r}", source=str(path))
    if not isinstance(data.get("extractors"), list) or not isinstance(data.get("image_digests"), dict):
        raise InputError("is not complete", source=str(path))
    return data


def compare_with(old: dict[str, Any], new: dict[str, Any], source: str) -> list[dict[str, Any]]:
    """Compare extractors with themselves in an earlier benchmark, on the images that both have in common.

    An image counts as a success if its pupil is right, or if it shows no pupil and none is reported. Raises InputError
    if the benchmarks have no image in common.
    """
    digests = old["image_digests"]
    shared = {name for name, digest in new["image_digests"].items() if digests.get(name) == digest}
    if not shared:
        raise InputError("shares no image with this bench", source=source)
    try:
        before = {entry["name"]: _successes(entry, shared) for entry in old["extractors"]}
    except WRONG as error:
        raise InputError(f"is not complete ({type(error).__name__}: {error})", source=source) from None
    out = []
    for entry in new["extractors"]:
        if entry["name"] not in before:
            continue
        was, now = before[entry["name"]], _successes(entry, shared)
        lost = sorted(name for name in shared if was[name] and not now[name])
        gained = sorted(name for name in shared if now[name] and not was[name])
        p = mcnemar(len(lost), len(gained))
        out.append(
            {
                "extractor": entry["name"],
                "images": len(shared),
                "successes_before": sum(was.values()),
                "successes": sum(now.values()),
                "lost": lost,
                "gained": gained,
                "p": p,
                "significant_loss": p < LEVEL and len(lost) > len(gained),
            }
        )
    return out


def problems_of(data: dict[str, Any], gated: bool) -> list[str]:
    """Return the reasons for exit code 1, one line each; with `gated`, every error of an extractor is one."""
    out = []
    for entry in data["extractors"]:
        errors = entry["summary"]["errors"]
        if errors == data["images"]:
            out.append(f"{entry['name']}: gave no usable answer to any image")
        elif errors and gated:
            out.append(f"{entry['name']}: gave no usable answer to {errors} of {data['images']} images")
    for check in data["required"]:
        if not check["met"]:
            value = "-" if check["value"] is None else f"{check['value']:.4g}"
            out.append(f"{check['extractor']}: {check['require']} is not met ({value})")
    for change in data["against"]:
        if change["significant_loss"]:
            out.append(
                f"{change['extractor']}: lost {len(change['lost'])} images and gained {len(change['gained'])} of "
                f"{change['images']} (p = {change['p']:.2g})"
            )
    return out


def _successes(entry: dict[str, Any], shared: set[str]) -> dict[str, bool]:
    found = {a["image"]: a["outcome"] in ("right", "absent") for a in entry["answers"]}
    return {image: found[image] for image in shared}
