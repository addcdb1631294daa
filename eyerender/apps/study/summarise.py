"""Combine the parts of a study into rows, findings, the remaining summary and the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from ...report.page import Page
from . import (
    blignaut,
    blignaut_page,
    conditions_page,
    errata,
    featureclouds,
    findings,
    guestrin,
    guestrin_page,
    head_mounted,
    head_mounted_page,
    observers_compared,
)
from .budget import Budget, budgets
from .conditions import ConditionsPart, PeoplePart
from .literature import VARIANTS
from .page_parts import Apart
from .replicate import BlignautPart, GuestrinPart
from .results import Finding, ModelResults, Row

Results = tuple[list[Row], list[Finding], dict[str, Any], Page]


def guestrin_results(parts: Sequence[GuestrinPart], protocols: Sequence[str]) -> Results:
    """Combine the results of guestrin2006: means tested against the paper's findings and the experiment."""
    rows = [row for part in parts for row in part.rows]
    found, tests = [], []
    keys = list(dict.fromkeys(key for part in parts for key in part.means))
    for key in keys:
        means = {p.eye_model: p.means[key] for p in parts if key in p.means}
        errors = {p.eye_model: p.h1_errors[key] for p in parts if key in p.h1_errors}
        found += findings.guestrin(means, errors, *key)
        tests += [{"protocol": key[0], "observer": key[1], **t} for t in findings.t_tests(means)]
    misprints = {p.eye_model: p.misprints for p in parts if p.misprints}
    steps = [asdict(step) for part in parts for step in part.waterfall]
    faults = errata.guestrin(misprints)
    apart, made_of = _observers_apart(parts), _budgets(parts)
    more = {
        "optimiser": guestrin.optimiser_settings(protocols),
        "calibrations": [c for part in parts for c in part.calibrations],
        "t_tests": tests,
        "departures": [asdict(d) for d in guestrin.DEPARTURES],
        "errata": [asdict(e) for e in faults],
        "misprints": misprints,
        "waterfall": steps,
        **_as_mappings(apart, made_of),
    }
    return rows, found, more, guestrin_page.page(parts, found, tests, faults, apart, made_of)


def blignaut_results(parts: Sequence[BlignautPart], protocols: Sequence[str]) -> Results:
    """Combine the results of blignaut2014: means and feature clouds tested against the paper's findings."""
    rows = [row for part in parts for row in part.rows]
    found: list[Finding] = []
    keys = list(dict.fromkeys(key for part in parts for key in part.outcomes))
    for protocol, observer in keys:
        here = {p.eye_model: p for p in parts if (protocol, observer) in p.outcomes}
        found += findings.blignaut({m: p.outcomes[protocol, observer] for m, p in here.items()}, protocol, observer)
        found += featureclouds.findings({m: p.clouds[protocol, observer] for m, p in here.items()}, protocol, observer)
        if protocol == "corrected":
            centred = {m: p.centred[protocol, observer] for m, p in here.items()}
            found += findings.blignaut(centred, "corrected, centred vector", observer)
    faults = errata.blignaut()
    apart, made_of = _observers_apart(parts), _budgets(parts)
    more = {
        "departures": [asdict(d) for d in blignaut.DEPARTURES],
        "errata": [asdict(e) for e in faults],
        "waterfall": [asdict(step) for part in parts for step in part.waterfall],
        **_as_mappings(apart, made_of),
    }
    return rows, found, more, blignaut_page.page(parts, found, faults, apart, made_of)


def conditions_results(parts: Sequence[ConditionsPart | PeoplePart], protocols: Sequence[str] = ()) -> Results:
    """Combine the results of conditions: values without a published claim."""
    rows = [row for part in parts for row in part.rows]
    models = [part for part in parts if isinstance(part, ConditionsPart)]
    people = [part for part in parts if isinstance(part, PeoplePart)]
    found = conditions_page.findings(models, people)
    more = conditions_page.more(models, people)
    return rows, found, more, conditions_page.page(models, people, found)


def observers_results(parts: Sequence[ModelResults], protocols: Sequence[str] = ()) -> Results:
    """Combine the results of observers: effects of images on features and directions."""
    apart, made_of = _observers_apart(parts), _budgets(parts)
    found = head_mounted.findings(*apart)
    more = {**head_mounted.more(), **_as_mappings(apart, made_of)}
    rows = [row for part in parts for row in part.rows]
    return rows, found, more, head_mounted_page.page(parts, found, apart, made_of)


def _observers_apart(parts: Sequence[ModelResults]) -> Apart:
    """Compare the observers on the frames that both have observed."""
    features: list[observers_compared.FeatureDifference] = []
    gaze: list[observers_compared.GazeDifference] = []
    seen = {(p.eye_model, *key): (p, key) for p in parts for key in p.seen}
    for (model, protocol, observer), (other, key) in seen.items():
        analytic = seen.get((model, protocol, "analytic"))
        if observer == "analytic" or analytic is None:
            continue
        part, own = analytic
        rig, truth = part.seen[own]
        features += observers_compared.features(truth, other.seen[key][1], rig, protocol, observer, model)
        mine, theirs = part.errors[own], other.errors[key]
        for name in mine:
            if name in theirs:
                difference = observers_compared.gaze(mine[name], theirs[name], protocol, observer, model, name)
                gaze += [difference] if difference else []
    return features, gaze


def _budgets(parts: Sequence[ModelResults]) -> list[Budget]:
    """Compute error budgets of the eye models, without the published variants of E5."""
    return budgets([part for part in parts if part.eye_model not in VARIANTS])


def _as_mappings(apart: Apart, made_of: Sequence[Budget]) -> dict[str, Any]:
    features, gaze = apart
    budgets_found = [{**asdict(b), "terms": list(map(asdict, b.terms))} for b in made_of]
    out: dict[str, Any] = {"error_budget": budgets_found}
    if features:
        out["observers"] = {"features": list(map(asdict, features)), "gaze": list(map(asdict, gaze))}
    return out
