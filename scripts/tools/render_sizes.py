"""Make one image of each recipe in many sizes, and say which cannot be made.

    python scripts/tools/render_sizes.py people_openeds people_nvgaze --sizes 40

Widths go up to 1024 px in equal ratios, and the shorter side has at least 16 px. Each width takes another sample of the
plan; images have one sample per pixel. The exit code is 1 if an image cannot be made.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from eyerender.base.errors import EyerenderError
from eyerender.dataset.maker import Maker
from eyerender.dataset.options import PlanOptions
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import frames_of


def shape_of(name: str) -> tuple[int, int]:
    """Return width and height of a recipe's pictures, px."""
    scene = Plan.load(name).draw(0).scene
    width, height = scene.get("image", {}).get("window_px") or scene["rig"]["cameras"][0]["resolution_px"]
    return width, height


def main() -> int:
    """Render all sizes of all recipes, and print a line for each recipe."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipes", nargs="+")
    parser.add_argument("--sizes", type=int, default=40)
    options = parser.parse_args()
    failures = 0
    for name in options.recipes:
        shape = shape_of(name)
        # The shorter side has at least 16 px.
        widths = np.unique(np.rint(np.geomspace(16 * max(shape[0] / shape[1], 1), 1024, options.sizes)).astype(int))
        made = 0
        for k, width in enumerate(widths.tolist()):
            size = f"{width}x{round(width * shape[1] / shape[0])}"
            try:
                plan = Plan.load(name, changes=PlanOptions(size=size))
                image = {**plan.spec.scene.get("image", {}), "spp": 1}
                spec = plan.spec.replaced("spp", {"scene": {**plan.spec.scene, "image": image}})
                plan = Plan.of(spec, base=plan.base, source=plan.source)
                found = Maker(plan, frames_of(plan)).make(plan.spread(len(widths))[k])
                if not found.images:
                    raise EyerenderError(f"sample {found.index} was given up: {found.rejections[-1].reason}")
                made += 1
            except EyerenderError as error:
                print(f"{name} --size {size}: {error}", flush=True)
        failures += len(widths) - made
        print(f"{name}: {made} of {len(widths)} sizes made", flush=True)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
