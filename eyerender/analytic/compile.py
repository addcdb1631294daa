"""Compile the ray optics and keep the machine code: `python -m eyerender.analytic.compile`."""

from __future__ import annotations

import sys
from pathlib import Path

from ..base.jit import RAYS, compile_share, ensure_compiled
from ..eye import pose_kernels
from ..optics import ellipse_kernels, fermat_kernels, graph_kernels, triangle_kernels
from . import view_kernels

MODULES = (graph_kernels, ellipse_kernels, fermat_kernels, pose_kernels, triangle_kernels, view_kernels)
"""Modules with compiled functions of the ray optics."""

if __name__ == "__main__":
    compile_share(Path(sys.argv[1]), int(sys.argv[2]), RAYS) if len(sys.argv) > 2 else ensure_compiled(RAYS)
