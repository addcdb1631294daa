#!/usr/bin/env python3
"""Renew the tables of docs/studies.md.

    study_tables.py [FOLDER ...]

Each folder is the result of a study (guestrin2006, blignaut2014, conditions). Its numbers go into
docs/data/studies/results.json, where those of other studies and observers stay. Then every table between
`<!-- table NAME -->` and `<!-- end -->` in docs/studies.md is written from that file. Without folders, only the page is
written.
"""

from __future__ import annotations

import csv
import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eyerender.apps.study import literature as lit

ROOT = Path(__file__).parents[1]
DATA, PAGE = ROOT / "docs/data/studies/results.json", ROOT / "docs/studies.md"
UNTESTED = ROOT / "docs/data/studies/untested_sentences.csv"
MODELS = lit.MODELS
READINGS = ("published", "corrected")
HEADS, SETS, LISTED = ("H1", "H2"), tuple(lit.CALIBRATION_SETS), ("C5", "C9", "C135")
KNOWN = ("guestrin2006", "blignaut2014", "conditions")


def numbers_of(folder: Path) -> dict[str, Any]:
    """Extract what the page states from the files of a study."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    found = json.loads((folder / "findings.json").read_text(encoding="utf-8"))["findings"]
    name = summary["study"]
    if name not in KNOWN:
        raise SystemExit(f"{folder}: {name} has no tables")
    if name == "conditions":
        models = {m["eye_model"]: m["diameters_deg"] for m in summary["models"]}
        return {name: {"mm": summary["pupil_diameters_mm"], "E2": models["E2"],
                       "people": summary["people"]["diameters_deg"]}}  # fmt: skip
    means: dict[str, dict[str, dict[str, float]]] = {}
    for row in summary["rows"]:
        if row["variant"] not in ("index fixed", "vector") or row["mean_deg"] is None:
            continue
        if name == "guestrin2006" and row["eye"] != ("both" if row["protocol"] == "corrected" else "right"):
            continue
        by = means.setdefault(f"{row['protocol']}, {row['observer']}", {}).setdefault(row["eye_model"], {})
        key = row["head"] or row["calibration"]
        by[key] = min(by.get(key, 1e9), row["mean_deg"])
    rules = [
        {k: f[k] for k in ("id", "protocol", "rule", "value", "threshold", "verdict")}
        for f in found if f["observer"] == "analytic" and f["protocol"] in READINGS and f["id"] != "G1"
    ]  # fmt: skip
    tests = [t for t in summary.get("t_tests", ()) if t["observer"] == "analytic" and t["eye_model"] in MODELS]
    return {name: {"means": means, "findings": rules, "t_tests": tests}}


def table(header: list[str], rows: list[list[str]]) -> str:
    """Format a Markdown table."""
    lines = ["| " + " | ".join(cells) + " |" for cells in (header, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(header), *lines[1:]])


def tables(data: Mapping[str, Any]) -> dict[str, str]:
    """Return every table by its name."""
    return {
        "means": _means(data),
        "experiment": _experiment(data["guestrin2006"]["t_tests"]),
        "magnitudes": _magnitudes(data),
        "pupils": _pupils(data["conditions"]),
        "findings guestrin2006": _findings(data["guestrin2006"]["findings"]),
        "findings blignaut2014": _findings(data["blignaut2014"]["findings"]),
        "sentences": _sentences(),
        "untested": _untested(),
    }


def _means(data: Mapping[str, Any]) -> str:
    paper = ["/".join(f"{v:.2f}" for v in lit.PAPER_GUESTRIN[m]) if m in lit.PAPER_GUESTRIN else "> 11" for m in MODELS]
    rows = [["guestrin2006, H1/H2", "the paper", *paper]]
    for name, keys in (("guestrin2006", HEADS), ("blignaut2014, best function on C5/C9/C135", LISTED)):
        for key, by in data[name.partition(",")[0]]["means"].items():
            first = name if name[0] == "b" and not rows[-1][0].startswith("b") and len(rows) < 8 else ""
            rows.append([first, key, *("/".join(f"{by[m][k]:.3f}" for k in keys) for m in MODELS)])
    return table(["mean error (deg)", "protocol, observer", *MODELS], rows)


def _experiment(tests: list[dict[str, Any]]) -> str:
    rows = []
    for head in dict.fromkeys(t["head"] for t in tests):
        some = [t for t in tests if t["head"] == head]
        one = some[0]
        cells = [f"{one['measured_deg']:.3f} ({one['low_deg']:.3f} to {one['high_deg']:.3f})"]
        for protocol in READINGS:
            by = {t["eye_model"]: t for t in some if t["protocol"] == protocol}
            cells.append(", ".join(f"{m} {by[m]['simulated_deg']:.3f} {by[m]['verdict']}" for m in MODELS if m in by))
        rows.append([head, *cells])
    return table(["", "four people, mean (95 % interval)", *READINGS], rows)


def _magnitudes(data: Mapping[str, Any]) -> str:
    rows = []
    measured = {h: float(lit.guestrin_deg(h).mean()) for h in HEADS} | {c: lit.blignaut_best(c)[1] for c in SETS}
    for name, keys in (("guestrin2006", HEADS), ("blignaut2014", SETS)):
        for key in keys:
            cells = []
            for protocol in READINGS:
                by = data[name]["means"][f"{protocol}, analytic"]
                shares = [100 * by[m][key] / measured[key] for m in MODELS]
                cells.append(f"{min(shares):.0f} to {max(shares):.0f} %")
            rows.append([name, key, f"{measured[key]:.2f}", *cells])
    return table(["study", "", "measured (deg)", *(f"simulated, {p}" for p in READINGS)], rows)


def _pupils(found: Mapping[str, Any]) -> str:
    at = [found["mm"].index(mm) for mm in (2.0, 4.0, 8.0)]
    names = {"both eyes, centre fixed": "both eyes, centre fixed", "right eye, centre fixed": "right eye, centre fixed",
             "both eyes, centre shifts": "both eyes, centre shifts by .06 mm per mm",
             "right eye, centre shifts": "right eye, centre shifts"}  # fmt: skip
    rows = [[label, *(f"{found['E2'][f'interpolation, {key}'][k]:.3f}" for k in at)] for key, label in names.items()]
    for side in ("right eye", "both eyes"):
        curves = [by[f"interpolation, {side}, centre shifts"] for by in found["people"].values()]
        cells = [f"{min(c[k] for c in curves):.2f} to {max(c[k] for c in curves):.2f}" for k in at]
        rows.append([f"{len(curves)} drawn people, {side}", *cells])
    return table(["mean error (deg)", "2 mm", "4 mm", "8 mm"], rows)


def _findings(found: list[dict[str, Any]]) -> str:
    told = {True: "true", False: "**false**", None: ""}
    rows: dict[tuple[str, str, str], dict[str, str]] = {}
    for f in found:
        value = "-" if f["value"] is None else f"{f['value']:.3g}"
        if value == f["threshold"].split()[-1]:  # a verdict that three digits do not explain
            value = f"{f['value']:.5g}"
        rows.setdefault((f["id"], f["rule"], f["threshold"]), {})[f["protocol"]] = f"{told[f['verdict']]}: {value}"
    body = [[id, rule, threshold, *(by.get(p, "") for p in READINGS)] for (id, rule, threshold), by in rows.items()]
    return table(["finding", "statement: value", "threshold", *READINGS], body)


def _sentences() -> str:
    ids: dict[str, list[str]] = {}
    for rule in lit.RULES.values():
        ids.setdefault(rule["sentence"], []).append(rule["finding"])
    rows = [[r["section"], r["sentence"], ", ".join(dict.fromkeys(ids[r["key"]]))] for r in lit.texts("sentences")]
    return table(["section", "sentence", "rules"], sorted(rows, key=lambda row: row[0]))


def _untested() -> str:
    with UNTESTED.open(encoding="utf-8", newline="") as file:
        return table(["section", "sentence", "why no rule"], [list(row) for row in list(csv.reader(file))[1:]])


def page_with(text: str, found: Mapping[str, str]) -> str:
    """Replace the tables of the page."""
    for name, body in found.items():
        pattern = rf"(<!-- table {re.escape(name)} -->\n).*?(<!-- end -->)"
        if not re.search(pattern, text, re.S):
            raise SystemExit(f"{PAGE}: there is no table {name}")
        before, after = re.split(pattern, text, maxsplit=1, flags=re.S)[0::3]
        text = f"{before}<!-- table {name} -->\n{body}\n<!-- end -->{after}"
    return text


def main() -> int:
    """Read folders, write data and page."""
    data = json.loads(DATA.read_text(encoding="utf-8")) if DATA.exists() else {}
    for folder in map(Path, sys.argv[1:]):
        for name, new in numbers_of(folder).items():
            old = data.get(name, {})
            means = {**old.get("means", {}), **new.get("means", {})}
            data[name] = {**old, **new, **({"means": means} if means else {})}
    DATA.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page_with(PAGE.read_text(encoding="utf-8"), tables(data)), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
