"""Bake the example meshes of meshes/: every surface of E2 and E5 as PLY, with a manifest (unit, frame, SHA-256).

python scripts/bake_meshes.py [FOLDER]      (default: meshes)
"""

from __future__ import annotations

import argparse
from pathlib import Path

from eyerender import load_eye
from eyerender.rendering.output.export import bake_meshes

ROOT = Path(__file__).resolve().parent.parent

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "meshes")
    out = parser.parse_args().folder
    for name in ("E2", "E5"):
        print(bake_meshes(load_eye(name).build(), out / name, rings=12, sectors=48))
