#!/usr/bin/env python3
"""Renew the tables of the pages on studies, docs/studies*.md.

    study_tables.py [FOLDER ...]

Each folder is the result of a study. The numbers of eye models (guestrin2006, blignaut2014, conditions) go into
docs/data/studies/results.json, those over people into people.json beside it, where the numbers of other studies and
observers stay. Then every table between `<!-- table NAME -->` and `<!-- end -->` in the pages is written from these
files. Without folders, only the pages are written.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eyerender.apps.study import literature as lit

ROOT = Path(__file__).parents[1]
DATA, PEOPLE_DATA = ROOT / "docs/data/studies/results.json", ROOT / "docs/data/studies/people.json"
UNTESTED = ROOT / "docs/data/studies/untested_sentences.csv"
MODELS = lit.MODELS
READINGS = ("published", "corrected")
HEADS, SETS, LISTED = ("H1", "H2"), tuple(lit.CALIBRATION_SETS), ("C5", "C9", "C135")
KNOWN = ("guestrin2006", "blignaut2014", "conditions")


# Table over people -> its columns: heading -> a key, or the keys of a mean and its interval.
_MEAN = ("mean_deg", "low_deg", "high_deg")
PEOPLE_COLUMNS: dict[str, dict[str, str | tuple[str, ...]]] = {
    "people": {
        "reading": "protocol", "observer": "observer", "condition": "condition", "people": "people",
        "mean (95 % interval)": _MEAN, "SD": "sd_deg", "5 %": "p5_deg", "50 %": "p50_deg", "95 %": "p95_deg",
        "U50E95": "U50E95", "images add": tuple(f"added_{key}" for key in _MEAN),
        "experiment": ("measured_deg", "measured_low_deg", "measured_high_deg"), "verdict": "verdict",
    },
    "causes": {
        "cause": "cause", "people": "people",
        "adds to the rise (deg)": tuple(f"adds to the rise, deg_{end}" for end in ("mean", "low", "high")),
    },
    "sizes": {
        "observer": "observer", "camera": "camera", "stop (mm)": "stop_mm", "correction": "correction",
        "people": "people", "missing": "missing", "median (%)": "p50", "95th percentile (%)": ("p95", "low", "high"),
    },
    "straight_ahead": {
        "camera": "camera", "stop (mm)": "stop_mm",
        **{name: tuple(f"{name}_{end}" for end in ("mean", "low", "high"))
           for name in ("over the stop", "over the entrance pupil")},
        "per dioptre (%)": "percent per dioptre", "half interval": "half of its 95 % interval",
    },
    "artefacts": {
        "camera": "camera", "cause": "cause", "mean (deg)": _MEAN, "least": "least_deg", "most": "most_deg",
        "sizes of both eyes differ by": tuple(f"sizes_differ_{end}" for end in ("mean", "low", "high")),
        "vergence": tuple(f"vergence_{end}" for end in ("mean", "low", "high")), "its SD": "vergence_sd",
        "concentration": "concentration", "differs over targets": "pattern_deg",
        "share of that": ("share", "share_low", "share_high"),
    },
}  # fmt: skip


def people_of(folder: Path) -> dict[str, Any]:
    """Extract what the page over people states from the files of a study; nothing if it had eye models only."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    kept = {name: summary[name] for name in PEOPLE_COLUMNS if summary.get(name)}
    if not kept or summary["study"] == "rigs":
        return {}
    found = json.loads((folder / "findings.json").read_text(encoding="utf-8"))["findings"]
    own = [{k: f[k] for k in ("id", "rule", "value", "threshold", "verdict", "detail")} for f in found]
    return {summary["study"]: {**kept, "findings": own if summary["study"] not in KNOWN else []}}


def joined(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Replace the tables of a study; rows of observers that the new run does not have stay."""
    seen = {row.get("observer") for rows in new.values() for row in rows}
    kept = {name: [row for row in rows if row.get("observer") and row["observer"] not in seen]
            for name, rows in old.items()}  # fmt: skip
    names = [name for name in new if new[name] or name not in old]
    return {**old, **{name: [*new[name], *kept.get(name, [])] for name in names}}


def people_tables(data: Mapping[str, Any]) -> dict[str, str]:
    """Return every table over people by the name of its study and its own."""
    out = {}
    for study, found in data.items():
        for name, rows in found.items():
            if (study, name) == ("calibration", "people"):
                out[f"{study} {name}"] = _calibrations(rows)
            elif name != "findings":
                # A page has no room for all stops.
                rows = [
                    r for r in rows if r.get("correction", "table of").startswith("table of") or r["stop_mm"] == 4.0
                ]
                columns = {h: k for h, k in PEOPLE_COLUMNS[name].items() if any(_cell(row, k) for row in rows)}
                out[f"{study} {name}"] = table(list(columns), [[_cell(r, k) for k in columns.values()] for r in rows])
            elif rows:
                told = {True: "true", False: "**false**", None: ""}
                body = [[f["id"], f["rule"], "-" if f["value"] is None else f"{f['value']:.3g}", f["threshold"],
                         told[f["verdict"]], f["detail"]] for f in rows]  # fmt: skip
                out[f"{study} findings"] = table(["id", "statement", "value", "threshold", "verdict", "detail"], body)
    out["pupil-size short"] = _sizes(data["pupil-size"]["sizes"])
    return out


def _sizes(rows: list[dict[str, Any]]) -> str:
    """Format the 95th percentiles of the exact features, a column per correction."""
    some = [r for r in rows if (r["observer"], r["stop_mm"]) == ("analytic", 4.0)]
    by = {(r["camera"], r["correction"]): f"{r['p95']:.1f}" for r in some}
    corrections = ("none", "cosine", "major axis", "table")
    cameras = dict.fromkeys(r["camera"] for r in some)
    return table(["camera", *corrections], [[c, *(by[c, name] for name in corrections)] for c in cameras])


def _calibrations(rows: list[dict[str, Any]]) -> str:
    """Format the errors of calibrations: a column per number of targets; fewer people than elsewhere are stated."""
    by: dict[tuple[str, str, str], dict[str, dict[str, Any]]] = {}
    for row in rows:
        rig, *estimator, targets, when = row["condition"].split(", ")
        by.setdefault((rig, ", ".join(estimator), when), {})[targets] = row
    targets = list(dict.fromkeys(one for cells in by.values() for one in cells))
    body = []
    for key, cells in sorted(by.items()):
        most = max(row["people"] for row in cells.values())
        texts = {one: _cell(row, _MEAN) + (f", {row['people']} people" if row["people"] < most else "")
                 for one, row in cells.items()}  # fmt: skip
        body.append([*key, str(most), *(texts.get(one, "-") for one in targets)])
    return table(["rig", "estimator", "", "people", *targets], body)


def _cell(row: Mapping[str, Any], keys: str | tuple[str, ...]) -> str:
    values = [row.get(key) for key in ((keys,) if isinstance(keys, str) else keys)]
    texts = ["" if v is None else f"{v:.3f}" if isinstance(v, float) else str(v) for v in values]
    return texts[0] if len(texts) == 1 or not all(texts) else f"{texts[0]} ({texts[1]} to {texts[2]})"


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
                       "people": summary["drawn_eyes"]["diameters_deg"]}}  # fmt: skip
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


def pages_with(found: Mapping[str, str]) -> dict[Path, str]:
    """Return the text of every page on studies with these tables; each table is on one page."""
    pages = {path: path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs").glob("studies*.md"))}
    for name, body in found.items():
        places = [path for path, text in pages.items() if f"<!-- table {name} -->\n" in text]
        if len(places) != 1:
            raise SystemExit(f"docs: {len(places)} pages have the table {name}")
        before, rest = pages[places[0]].split(f"<!-- table {name} -->\n")
        after = rest.partition("<!-- end -->")[2]
        pages[places[0]] = f"{before}<!-- table {name} -->\n{body}\n<!-- end -->{after}"
    return pages


def main() -> int:
    """Read folders, write data and page."""
    data = json.loads(DATA.read_text(encoding="utf-8")) if DATA.exists() else {}
    people = json.loads(PEOPLE_DATA.read_text(encoding="utf-8")) if PEOPLE_DATA.exists() else {}
    for folder in map(Path, sys.argv[1:]):
        if over_people := people_of(folder):
            for name, new in over_people.items():
                people[name] = joined(people.get(name, {}), new)
            continue
        for name, new in numbers_of(folder).items():
            old = data.get(name, {})
            means = {**old.get("means", {}), **new.get("means", {})}
            data[name] = {**old, **new, **({"means": means} if means else {})}
    DATA.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    PEOPLE_DATA.write_text(json.dumps(people, indent=1) + "\n", encoding="utf-8")
    for path, text in pages_with({**tables(data), **people_tables(people)}).items():
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
