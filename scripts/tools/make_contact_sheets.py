#!/usr/bin/env python3
"""Contact sheets of the presets for visual inspection: every row varies one quantity.

    python scripts/tools/make_contact_sheets.py -o DIR [--preset NAME ...] [--spp N] [--gamma G] [--quick]

The rows of a sheet are: gaze (azimuth -25 to 25, then elevation -25 to 25 degrees), blink 0 to 1, pupil 2 to 8 mm,
iris and skin from dark to pale, and subjects drawn at random. Pictures are stretched to the full range of grey.
Near-infrared cameras are linear; the default gamma of 1.4 brightens the shadows slightly.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from eyerender.imaging.capture import make_renderer, render_windows
from eyerender.region.anatomy import Region
from eyerender.scene import Scene, load_scene
from eyerender.scene.spec import SceneSpec

PRESETS = ("desktop_tracker", "headset", "webcam", "stress")
CELL = (400, 300)


def rows(spec: dict[str, Any], quick: bool) -> Iterator[tuple[str, list[tuple[str, dict[str, Any]]]]]:
    """(title, [(caption, scene's mapping)]) of each row."""
    n = 3 if quick else 6

    def scene(az: float = 0, el: float = 0, **changes: Any) -> dict[str, Any]:
        out = {k: v for k, v in spec.items() if k != "targets"}
        out["poses"] = [{"azimuth_deg": az, "elevation_deg": el}]
        out["subject"] = {**spec.get("subject", {}), "eyes": ["right"]}
        for key, value in changes.items():
            out[key] = {**(out.get(key) or {}), **value}
        return out

    turns = np.linspace(-25, 25, n).round(1).tolist()
    yield "azimuth", [(f"azimuth {a:g}", scene(az=a)) for a in turns]
    yield "elevation", [(f"elevation {a:g}", scene(el=a)) for a in turns]
    blinks = np.linspace(0, 1, n).round(2).tolist()
    yield "blink", [(f"blink {b:g}", scene(region={"blink": b})) for b in blinks]
    pupils = np.linspace(2, 8, n).round(1).tolist()
    yield "pupil", [(f"pupil {p:g} mm", scene(eye={"pupil_diameter_mm": p})) for p in pupils]
    shades = np.linspace(0, 1, n)
    yield (
        "iris and skin",
        [
            (
                f"iris {0.18 + 0.3 * s:.2f}, skin {0.36 + 0.3 * s:.2f}",
                scene(
                    look={"iris_albedo": round(0.18 + 0.3 * s, 3), "iris_seed": 10 + i},
                    region={"skin": {"albedo": round(0.36 + 0.3 * s, 3)}, "seed": 20 + i},
                ),
            )
            for i, s in enumerate(shades.tolist())
        ],
    )
    subjects = []
    for i in range(n):
        drawn = Region.drawn(100 + i, spread=0.8).to_mapping()
        subjects.append((f"subject {100 + i}", scene(look={"iris_seed": 100 + i}, region=drawn)))
    yield "subjects", subjects


def picture(irradiance: Any, gamma: float) -> Image.Image:
    """A picture for people."""
    top = np.percentile(irradiance, 98.5) * 1.1
    grey = (np.clip(irradiance / top, 0, 1) ** (1 / gamma) * 255).astype(np.uint8)
    image = Image.fromarray(grey)
    image.thumbnail(CELL) if image.width > CELL[0] else None
    scale = min(CELL[0] / image.width, CELL[1] / image.height)
    return image.resize((round(image.width * scale), round(image.height * scale)), Image.Resampling.LANCZOS)


def sheet(name: str, renderer: Any, spp: int, gamma: float, quick: bool) -> Image.Image:
    """The contact sheet of one preset."""
    base = load_scene(name).spec.to_mapping()
    base["image"]["spp"] = spp
    lines = []
    for title, cells in rows(base, quick):
        line = []
        for caption, mapping in cells:
            scene = Scene.of(SceneSpec.from_mapping(mapping, source=f"{name}: {title}"))
            (shot,) = render_windows(scene.frames(), renderer=renderer)
            cell = Image.new("L", (CELL[0], CELL[1] + 16), 255)
            cell.paste(picture(shot.irradiance, gamma), (0, 16))
            ImageDraw.Draw(cell).text((3, 2), caption, fill=0)
            line.append(cell)
        lines.append(line)
    width, height = lines[0][0].size
    out = Image.new("L", (width * max(map(len, lines)), height * len(lines)), 255)
    for r, line in enumerate(lines):
        for c, cell in enumerate(line):
            out.paste(cell, (c * width, r * height))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the sheets")
    parser.add_argument("--preset", nargs="*", default=list(PRESETS), choices=PRESETS)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--gamma", type=float, default=1.4)
    parser.add_argument("--quick", action="store_true", help="three pictures a row instead of six")
    parser.add_argument("--backend", default="auto", choices=("auto", "cuda", "llvm"))
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    renderer = make_renderer(arguments.backend)
    for name in arguments.preset:
        path = arguments.output / f"{name}.png"
        sheet(name, renderer, arguments.spp, arguments.gamma, arguments.quick).save(path)
        print(path)


if __name__ == "__main__":
    main()
