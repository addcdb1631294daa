"""Describe what bench_world samples: shares of the hard cases, and spans of size, contrast, blur and noise.

python scripts/tools/describe_bench_world.py [SPEC] [--count N]  from its plan and ray optics; the blink stands for lids
python scripts/tools/describe_bench_world.py --bench DIR         as measured in the images of a bench, of any folder
"""

from __future__ import annotations

import argparse
import csv
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from eyerender.base.errors import EyerenderError
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import sample


def exposure(spec: Any) -> float:
    """Exposure of the eye over the full well, with lamps as far away as the single one (413 mm)."""
    eye = np.array([0.0, -31.5, 0.0])
    lamps = [light.intensity_mw_sr * (413 / np.linalg.norm(light.position_mm - eye)) ** 2 for light in spec.rig.lights]
    return float(spec.sensor.exposure_ms * sum(lamps) / spec.sensor.full_well_e)


def describe(found: Any) -> dict[str, float]:
    """Numbers of one sample."""
    scene, truth = found.scene, found.observations
    camera, spec = scene.rig.cameras[0], scene.spec
    pupil = truth.pupil
    scale = camera.scale_at(truth.index.eye_position_mm[0])
    azimuth, elevation = float(truth.pose.azimuth_rad[0]), float(truth.pose.elevation_rad[0])
    axis = np.array(
        [math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)]
    )
    toward = -camera.R.T @ camera.t - truth.index.eye_position_mm[0]
    out = {
        "view_deg": math.degrees(math.acos(float(axis @ toward) / float(np.linalg.norm(toward)))),
        "stop_mm": scene.stop_diameter_mm("right"),
        "blink": spec.region.blink,
        "radius_px": math.sqrt(float(np.prod(pupil.semi_axes_px[0]))) if pupil.ok[0] else math.nan,
        "px_per_mm": float(scale),
        "speed_deg_s": math.hypot(*spec.motion.eye_deg_s) if spec.motion else 0.0,
        "field_delay_ms": 1e3 * scene.timings[0].field_delay_s,
        "window": float(bool(spec.ambient and spec.ambient.panels)),
        "exposure": exposure(spec),
        "psf_px": spec.sensor.psf_sigma_px,
        "jpeg": spec.sensor.jpeg_quality or 100,
        "full_well_e": spec.sensor.full_well_e,
    }
    spots = truth.glints.xy_px[0][truth.glints.ok[0]]
    if pupil.ok[0] and len(spots):
        away = spots[:, None] - pupil.points_px[0][None]
        out["glint_from_edge_px"] = float(np.hypot(away[..., 0], away[..., 1]).min())
    return out


def describe_bench(folder: Path) -> None:
    """Print what a bench measured in its images: conditions, edges along the true outline, and spans."""
    with open(folder / "results.csv", encoding="utf-8") as file:
        images = {row["image"]: row for row in csv.DictReader(file)}.values()
    shown = [row for row in images if row["pupil_px"]]
    known = [row for row in shown if row["noise_dn"]]
    print(f"{len(images)} images; {len(shown)} show a pupil, {len(known)} of them have figures of its edge")
    counts = Counter(name for row in images for name in row["conditions"].split("; "))
    for name, count in counts.most_common():
        print(f"{100 * count / len(images):5.1f} %  {name}")
    for name, bar in (("contrast_to_noise", None), ("blur_px", 1.2), ("noise_dn", 1.0), ("pupil_px", None)):
        values = np.array([float(row[name]) for row in shown if row[name]])
        if len(values):
            above = "" if bar is None else f"   above {bar:g}: {np.mean(values > bar):.2f}"
            print(f"{name:20}", *(f"{v:9.3g}" for v in np.percentile(values, (5, 50, 95))), above)


def main() -> None:
    """Print shares and spans."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bench", type=Path, help="folder that bench-extractors wrote")
    parser.add_argument("spec", nargs="?", default="bench_world")
    parser.add_argument("--count", type=int, default=100, help="number of samples, spread over the plan")
    args = parser.parse_args()
    if args.bench is not None:
        describe_bench(args.bench)
        return
    plan = Plan.load(args.spec)
    rows, failed = [], []
    for index in np.linspace(0, plan.spec.count - 1, args.count).astype(int):
        try:
            found = sample(plan, int(index))
            if found.scene is None:
                failed.append(f"{index}: {found.rejections[-1].reason}")
            else:
                rows.append(describe(found))
        except EyerenderError as error:
            failed.append(f"{index}: {error}")
    table = {name: np.array([row.get(name, math.nan) for row in rows]) for name in rows[0]}
    cases = {
        "lids closed (blink > 0.9)": table["blink"] > 0.9,
        "lids half closed (blink 0.3 to 0.7)": (table["blink"] >= 0.3) & (table["blink"] <= 0.7),
        "view > 50 deg": table["view_deg"] > 50,
        "stop < 1.75 mm (entrance < 2)": table["stop_mm"] < 1.75,
        "stop > 5.75 mm (entrance > 6.5)": table["stop_mm"] > 5.75,
        "a glint within 3 px of the edge": table["glint_from_edge_px"] < 3,
        "a window": table["window"] > 0,
        "motion": table["speed_deg_s"] > 50,
        "interlaced": table["field_delay_ms"] > 0,
        "clipped skin (exposure > 1)": table["exposure"] > 1.0,
    }
    print(f"{len(rows)} samples, {len(failed)} cannot be made")
    for line in failed[:5]:
        print("  ", line)
    for name, holds in cases.items():
        print(f"{100 * holds.mean():5.1f} %  {name}")
    for name, values in table.items():
        print(f"{name:20}", *(f"{v:9.3g}" for v in np.nanpercentile(values, (5, 50, 95))))


if __name__ == "__main__":
    main()
