"""Compare how two benches rank the same detectors: Kendall's tau of the share of images with IoU above a threshold.

    python scripts/tools/compare_ranks.py A/results.json B/results.json [--iou .9 .75] [--without own-fast] [--json]

The share is of the images that show a pupil. Its interval comes from drawing the images of both benches again, with
replacement; it is wide with few images or where detectors are alike.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import kendalltau

from eyerender.apps.benchmark.checks import read_results
from eyerender.base.errors import InputError

RESAMPLES = 1000


def overlaps(path: Path) -> dict[str, Any]:
    """IoU of every image that shows a pupil, by detector; 0 where a detector gives no ellipse."""
    with_pupil = ("right", "wrong", "none", "error")
    out, data = {}, read_results(path)
    if data.get("centres_only"):
        raise InputError("labels only the centres of pupils, so it has no IoU", source=str(path))
    for entry in data["extractors"]:
        # An error on an image without a pupil has the same outcome, but then all detectors know none there.
        shown = [a for a in entry["answers"] if a["outcome"] in with_pupil]
        out[entry["name"]] = {a["image"]: a["iou"] or 0.0 for a in shown}
    return out


def matrix(found: dict[str, Any], names: list[str]) -> Any:
    """(detectors, images) IoU on the images that every detector was asked about."""
    images = sorted(set.intersection(*(set(found[name]) for name in names)))
    return np.array([[found[name][image] for image in images] for name in names])


def tau(first: Any, second: Any) -> float:
    """Kendall's tau b of two columns of shares; 0 where all are equal."""
    value = float(kendalltau(first, second).statistic)
    return value if np.isfinite(value) else 0.0


def compare(first: Any, second: Any, threshold: float) -> dict[str, Any]:
    """Shares of both benches and the tau of their ranks, with a 95 % interval."""
    hits = [(m > threshold).astype(np.float64) for m in (first, second)]
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(RESAMPLES):
        again = [h[:, rng.integers(h.shape[1], size=h.shape[1])].mean(axis=1) for h in hits]
        drawn.append(tau(*again))
    return {
        "iou": threshold,
        "tau": tau(hits[0].mean(axis=1), hits[1].mean(axis=1)),
        "interval": np.percentile(drawn, (2.5, 97.5)).tolist(),
        "shares": [h.mean(axis=1).tolist() for h in hits],
    }


def main() -> None:
    """Print shares and tau of two benches."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("first", type=Path)
    parser.add_argument("second", type=Path)
    parser.add_argument("--iou", type=float, nargs="+", default=[0.9, 0.75])
    parser.add_argument("--without", nargs="*", default=["own-fast", "own-refined"], help="detectors to leave out")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    try:
        found = [overlaps(args.first), overlaps(args.second)]
    except InputError as error:
        parser.error(str(error))
    names = sorted((set(found[0]) & set(found[1])) - set(args.without))
    if len(names) < 3:
        parser.error("the benches share fewer than three detectors")
    tables = [matrix(one, names) for one in found]
    result = {
        "detectors": names,
        "images": [table.shape[1] for table in tables],
        "thresholds": [compare(tables[0], tables[1], threshold) for threshold in args.iou],
    }
    if args.json:
        print(json.dumps(result, indent=1))
        return
    print(f"{len(names)} detectors, {result['images'][0]} and {result['images'][1]} images")
    for row in result["thresholds"]:
        print(f"IoU > {row['iou']:g}: tau {row['tau']:.2f} ({row['interval'][0]:.2f} to {row['interval'][1]:.2f})")
        for name, a, b in sorted(zip(names, *row["shares"], strict=True), key=lambda x: -x[2]):
            print(f"    {name:22} {a:6.3f} {b:6.3f}")


if __name__ == "__main__":
    main()
