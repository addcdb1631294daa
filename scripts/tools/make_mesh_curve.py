"""Draw how a meshed cornea converges to the exact one: errors and cost against the length of the edges.

python scripts/tools/make_mesh_curve.py [FILE]      (default: docs/images/mesh_curve.png)
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from PIL import Image  # noqa: E402

from eyerender.backends.choose import choose_backend  # noqa: E402

EDGES_MM = (0.8, 0.56, 0.4, 0.28, 0.2, 0.14, 0.1, 0.07, 0.05)
CURVES = (
    ("glint_px", "glints, px", "o"),
    ("limbus_px", "outline of the cornea, px rms", "s"),
    ("pupil_px", "outline of the pupil, px rms", "^"),
    ("iris_rms", "iris, relative rms per pixel", "v"),
    ("iris", "iris, relative mean", "d"),
)


def main() -> int:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, nargs="?", default=ROOT / "docs" / "images" / "mesh_curve.png")
    target = parser.parse_args().file
    backend = choose_backend("auto")
    from eyerender.rendering.renderer import Renderer
    from tests.support.mesh_errors import mesh_errors, mesh_job

    renderer = Renderer(backend)
    figure = Figure(figsize=(9.0, 3.9), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, rig_name in zip(figure.subplots(1, 2, sharey=True), ("remote", "head"), strict=True):
        job = mesh_job("E5", rig_name)
        renderer.render(job, spp=16)
        base = _cpu(lambda job=job: renderer.render(job, spp=16))
        found, costs = [], []
        for edge in EDGES_MM:
            found.append(mesh_errors(renderer, job, edge, 64))
            rough = replace(job, mesh_edge_mm=edge)
            renderer.render(rough, spp=16)
            costs.append(_cpu(lambda job=rough: renderer.render(job, spp=16)) / base)
            print(f"{rig_name} {edge:5.2f} mm  CPU x {costs[-1]:.2f}  {found[-1]}", flush=True)
        for name, label, mark in CURVES:
            values = np.array([getattr(f, name) for f in found])
            axes.loglog(EDGES_MM, np.maximum(values, 1e-7), mark + "-", ms=4, lw=1, label=label)
        axes.loglog(
            EDGES_MM, 0.02 * np.square(EDGES_MM) / EDGES_MM[0] ** 2, "k:", lw=0.8, label="proportional to square"
        )
        axes.set_title(
            {"remote": "remote camera, 6 px/mm", "head": "head-mounted camera, 17 px/mm"}[rig_name], fontsize=9
        )
        axes.set_xlabel("length of the edges, mm")
        axes.axvline(0.1, color="0.7", lw=0.8)
        axes.set_xticks([0.05, 0.1, 0.2, 0.4, 0.8], labels=["0.05", "0.1", "0.2", "0.4", "0.8"])
        axes.minorticks_off()
        axes.grid(alpha=0.3, which="major")
    figure.axes[0].set_ylabel("difference to the exact surfaces")
    figure.axes[0].legend(fontsize=7, loc="lower right")
    figure.savefig(target, dpi=110)
    Image.open(target).convert("P", palette=Image.Palette.ADAPTIVE, colors=64).save(target, optimize=True)
    print(target)
    return 0


def _cpu(work) -> float:  # type: ignore[no-untyped-def]
    """CPU seconds, best of three."""
    best = np.inf
    for _ in range(3):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return float(best)


if __name__ == "__main__":
    sys.exit(main())
