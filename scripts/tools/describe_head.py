"""Describe a head mesh for `region.head`: write its manifest with checksums, and list its objects.

python scripts/tools/describe_head.py head.obj --unit cm --licence CC-BY-4.0 --right-eye -3.1 2 9.4 \\
    --left-eye 3.1 2 9.4 --part skin=Face --part lashes=LashesUpper,LashesLower \\
    [--forward 0 0 1] [--up 0 1 0] [--texture skin.png]
python scripts/tools/describe_head.py --example DIR      writes the package's own eye region as an example mesh

The manifest is written beside the (first) mesh. The scene then needs `region: {head: {file: .../manifest.json}}`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from eyerender import load_eye
from eyerender.base.errors import InputError
from eyerender.region.anatomy import Region
from eyerender.region.globe import Globe
from eyerender.region.head import HEAD_PARTS, load_head
from eyerender.region.headspec import SCHEMA, Head
from eyerender.region.mesh import PARTS, region_mesh


def describe(files: list[Path], keys: dict[str, Any]) -> Path:
    """Check the files and write the manifest beside the first; raises `InputError`."""
    folder = files[0].resolve().parent
    names = [str(f.resolve().relative_to(folder)) for f in files]
    sums = [hashlib.sha256(f.read_bytes()).hexdigest() for f in files]
    data = {
        "file": names if len(names) > 1 else names[0],
        **{k: v for k, v in keys.items() if v is not None},
        "sha256": sums if len(sums) > 1 else sums[0],
    }
    head = load_head(Head.from_mapping(data, source=str(files[0])).resolved(folder))
    for part, end, start in zip(HEAD_PARTS, head.face_ends, [0, *head.face_ends[:-1]], strict=True):
        print(f"{part:<7} {int(end) - int(start)} triangles")
    path = folder / "manifest.json"
    path.write_text(json.dumps({"schema": SCHEMA, **data}, indent=1) + "\n", encoding="utf-8")
    return path


def example(folder: Path) -> Path:
    """The package's own eye region about a right eye E2 as head.obj: mm, y up, z forward, from the globe's centre."""
    folder.mkdir(parents=True, exist_ok=True)
    eye = load_eye("E2").build()
    limbus, centre = float(eye.limbus_radius_mm), np.asarray(eye.sclera.centre_mm)
    globe = Globe(
        cornea=eye.front[0],
        limbus_radius_mm=limbus,
        centre_mm=centre,
        radius_mm=float(eye.sclera.radius_mm),
        M=np.eye(3),
        t=np.zeros(3),
    )
    mesh = region_mesh(Region(), globe)
    lines, start = [], 1
    for name in PARTS:
        part: trimesh.Trimesh = mesh.part(name)
        x, y, z = (part.vertices - globe.centre).T
        lines += [f"o {name}", *(f"v {a:.5f} {b:.5f} {c:.5f}" for a, b, c in zip(y, z, x, strict=True))]
        lines += [f"f {a} {b} {c}" for a, b, c in part.faces + start]
        start += len(part.vertices)
    (folder / "head.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
    keys = {"unit": "mm", "licence": "MIT", "right_eye": [0, 0, 0], "parts": {name: [name] for name in PARTS}}
    return describe([folder / "head.obj"], keys)


def main() -> int:
    """Write a manifest."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--example", type=Path, metavar="DIR")
    parser.add_argument("--unit", choices=("mm", "cm", "m"))
    parser.add_argument("--licence")
    parser.add_argument("--part", action="append", metavar="PART=NAME,NAME", help=", ".join(HEAD_PARTS))
    for name in ("right-eye", "left-eye", "forward", "up"):
        parser.add_argument(f"--{name}", nargs=3, type=float)
    parser.add_argument("--texture")
    given = vars(parser.parse_args())
    folder, files, parts = given.pop("example"), given.pop("files"), given.pop("part")
    if (folder is None) == (not files):
        parser.error("give the files of a mesh, or --example DIR")
    if parts is not None:
        given["parts"] = {k: v.split(",") for k, _, v in (p.partition("=") for p in parts)}
    try:
        print(example(folder) if folder is not None else describe(files, given))
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
