"""Readers of single files: options and tables that a person writes, marks and notes that this package left."""

from __future__ import annotations

import json
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from tests.fuzz.reader import Reader, suppress_input

_TOLERANCES = (
    b"format: 1\ntolerances:\n- {part: led, number: 0, quantity: position_mm, sd: 0.1, when: after}\n"
    b"- {part: camera, number: all, quantity: rotation_deg, sd: 2, when: before}\n"
)


def _seeds(*values: Any) -> Callable[[], list[bytes]]:
    return lambda: [json.dumps(value, indent=1).encode() for value in values]


def _unknowns(path: Path) -> Any:
    from eyerender.design.unknowns import Unknowns

    return Unknowns.load(path)


def _tolerances(path: Path) -> Any:
    from eyerender.design.tolerances import Tolerances

    return Tolerances.load(path)


def _population(path: Path) -> Any:
    from eyerender.cli.population import read_population

    return read_population(str(path), "--population")


def _population_table(path: Path) -> Any:
    from eyerender.population.table import PopulationTable

    return PopulationTable.load(path)


def _population_table_seeds() -> list[bytes]:
    from eyerender.population.table import FOLDER

    return [(FOLDER / "default.yaml").read_bytes()]


def _columns(path: Path) -> Any:
    from eyerender.gaze.table import observations_from_csv
    from eyerender.scene import load_scene

    (path.parent / "a.csv").write_text("t,x,y,gx,gy,eye\n1,320.5,240,300,200,left\n2,1,2,,nan,right\n")
    return observations_from_csv(path.parent / "a.csv", path, load_scene("guestrin2006").rig)


COLUMNS = {"format": 1, "pupil": ["x", "y"], "glints": [["gx", "gy"], None], "eye": "eye"}


def _rig(path: Path) -> Any:
    from eyerender.gaze.records import load_rig

    return load_rig(path)


def _rig_seeds() -> list[bytes]:
    from tests.support.dataset_specs import TINY

    return _seeds({"format": 1, **TINY["scene"]["rig"]})()


def _plan(path: Path) -> Any:
    from eyerender.dataset.plan import Plan

    return Plan.load(str(path)).warnings()


def _plan_seeds() -> list[bytes]:
    from tests.support.dataset_specs import TINY

    return _seeds({**TINY, "count": 4})()


def _sweep(path: Path) -> Any:
    from eyerender.apps.sweeps.spec import SweepSpec

    return SweepSpec.load(path)


def _named(path: Path) -> Any:
    """Find the files that an argument's file names, and whether it is a dataset."""
    from eyerender.cli.targets import _with_named
    from eyerender.scene.shipped import is_dataset

    return list(_with_named([path])), is_dataset(path)


def _table_draw(path: Path) -> Any:
    from eyerender.dataset.gathering import with_tables

    return with_tables({"a": {"draw": "table", "file": path.name, "weights": "w"}}, path.parent)


def _topography_ply(path: Path) -> Any:
    from eyerender.eye.parts import TopographySpec
    from eyerender.eye.topography import read_topography

    axes = {"x": "nasal", "y": "up", "z": "in", "unit": "mm"}
    return read_topography(TopographySpec.from_mapping({"path": path.name, "layout": "mesh", **axes}), path.parent)


def _topography_ply_seeds() -> list[bytes]:
    import trimesh
    from scipy.spatial import Delaunay

    at = np.linspace(-4, 4, 13)
    x, y = (side.ravel() for side in np.meshgrid(at, at))
    points = np.stack([x, y, 7.8 - np.sqrt(7.8**2 - x * x - y * y)], axis=1)
    mesh = trimesh.Trimesh(points, Delaunay(points[:, :2]).simplices, process=False)
    data: Any = mesh.export(file_type="ply")
    return [data]


def _topography_names(path: Path) -> Any:
    from eyerender.eye.topography import topography_files

    return topography_files(path)


GRID = {"kind": "grid", "file": {"path": "a.csv", "layout": "points"}}


def _manifest(path: Path) -> Any:
    from eyerender.region.headspec import read_manifest

    return read_manifest(path)


HEAD = {"file": "a.obj", "unit": "mm", "licence": "none", "right_eye": [75.0, 75.0, 100.0]}
MANIFEST = {"schema": "eyerender/head/1", **HEAD, "sha256": ["0" * 64]}


def _texture(path: Path) -> Any:
    from eyerender.region.head import _picture

    return _picture(path, path.stat().st_mtime_ns)


def _texture_seeds() -> list[bytes]:
    from tests.fuzz.reader import png_seeds

    return png_seeds()


NETWORK = (  # of one picture of 2 x 2 px; the ellipse is its mean times five ones
    b'\x08\x08:\xbf\x01\n,\n\x01i\x12\nconfidence"\nReduceMean*\x0f\n\x08keepdims\x18\x00\xa0\x01\x02'
    b'\n#\n\nconfidence\n\x01c\x12\rpupil_ellipse"\x03Mul\x12\x01g'
    b"*\x1f\x08\x01\x08\x05\x10\x01B\x01cJ\x14\x00\x00\x80?\x00\x00\x80?\x00\x00\x80?\x00\x00\x80?\x00\x00\x80?Z\x1b\n\x01i\x12\x16\n\x14\x08\x01\x12\x10\n\x02\x08\x01\n\x02\x08\x01\n\x02\x08\x02\n\x02\x08\x02"
    b"b\x15\n\rpupil_ellipse\x12\x04\n\x02\x08\x01b\x12\n\nconfidence\x12\x04\n\x02\x08\x01B\x04\n\x00\x10\x11r\x16\n\teyerender\x12\tnetwork/1"
)


def _network(path: Path) -> Any:
    from eyerender.apps.benchmark.network import load_network

    return load_network(str(path))


def _network_seeds() -> list[bytes]:
    return [NETWORK]


def _against(path: Path) -> Any:
    from eyerender.apps.benchmark.checks import compare_with, read_results
    from tests.support.fuzzing import strict_json

    found = compare_with(read_results(path), RESULTS, str(path))
    strict_json(found)
    return found


ANSWERS = [{"image": "a.png", "outcome": "right"}, {"image": "b.png", "outcome": "wrong"}]
RESULTS: dict[str, Any] = {
    "schema": "eyerender/bench/5",
    "extractors": [{"name": "x", "answers": ANSWERS}],
    "image_digests": {"a.png": "0", "b.png": "1"},
}


def _results_seeds() -> list[bytes]:
    from eyerender.apps.benchmark.checks import RESULTS_SCHEMA

    return _seeds({**RESULTS, "schema": RESULTS_SCHEMA})()


def _signs(path: Path) -> Any:
    """Ask every mark of a folder whether the folder is this package's own."""
    from eyerender.apps.study.images import _begun
    from eyerender.apps.study.run import _claimed
    from eyerender.folders.imagefolder import same_run
    from eyerender.folders.outfolder import MARKER, refuse_non_empty

    data = path.read_bytes()
    for name in (MARKER, "dataset.json", "run.json", "study.json", "shards/00000/done.json"):
        (path.parent / name).parent.mkdir(parents=True, exist_ok=True)
        (path.parent / name).write_bytes(data)
    same_run(path.parent, "x")
    _begun(path.parent, mock.Mock(digest="x"))
    with suppress_input():
        refuse_non_empty(path.parent, True)
    with _claimed(path.parent, {"study": 1}, False):
        pass


def _sweep_mark(path: Path) -> Any:
    from eyerender.apps.sweeps.run import _claim, _read

    _claim(path.parent, {"sweep": "x"}, False)
    return _read(path, 0)


def _sweep_seeds() -> list[bytes]:
    from eyerender.apps.sweeps.run import _KEYS, LAYOUT_SCHEMA

    return _seeds({"schema": LAYOUT_SCHEMA, "number": 0, "sweep": "x", **dict.fromkeys(_KEYS - {"schema", "number"})})()


def _rate(path: Path) -> Any:
    from eyerender.dataset import estimate

    with mock.patch.object(estimate, "_path", mock.Mock(return_value=path)):
        return estimate.last_rate(mock.Mock(), "llvm")


RATE = {"how": "run", "time": "2026-01-01T00:00:00Z", "backend": "llvm", "samples": 3, "start_seconds": 1.0}
RATE |= {"seconds": 1.0, "subject_seconds": 0.0, "images": 1.0, "bytes": 9.0}


def _verdict(path: Path) -> Any:
    from eyerender.backends.probe import _read_verdict

    return _read_verdict(path)


def _answers(path: Path) -> Any:
    from eyerender.apps.benchmark.asking import Answers

    known = Answers(path, "x")
    return known.get("x", 0)


def _answers_seeds() -> list[bytes]:
    from eyerender.apps.benchmark.asking import _SCHEMA

    first = json.dumps({"schema": _SCHEMA, "task": "x"})
    return [f"{first}\n{json.dumps(['x', 0, '{}', '{}', 0.1])}\n".encode()]


def _map_file(path: Path) -> Any:
    from eyerender.region.mapcache import _read

    return _read(path)


def _map_seeds() -> list[bytes]:
    from tests.fuzz.readers import READERS

    return READERS["cached-map"].seeds()


def _trace(path: Path) -> Any:
    from eyerender.scene.sequence.spec import Sequence

    names = {"azimuth_deg": "x", "elevation_deg": "y"}
    return Sequence.from_mapping({"gaze": {"file": path.name, "columns": names}}).resolved(path.parent)


def _stamps(path: Path) -> Any:
    from eyerender.scene.sequence.spec import Sequence

    found = Sequence.from_mapping({"timestamps": {"file": str(path)}}).timestamps
    assert found is not None
    return found.starts_s(), found.stored_s(np.zeros(1), np.zeros(1), np.zeros(1, dtype=int), np.zeros(1, dtype=int))


def _stamps_seeds() -> list[bytes]:
    file = BytesIO()
    np.save(file, np.array([1234.5, 1234.51, 1234.54]))
    return [file.getvalue()]


STUDY = {"schema": "eyerender/study/1", "settings": {"study": 1}}
SMALL: dict[str, Reader] = {
    "tolerances": Reader("a.yaml", _tolerances, lambda: [_TOLERANCES]),
    "unknowns": Reader("a.yaml", _unknowns, lambda: [b"gaze_deg: unknown\npupil_mm: 0.5\nslippage_mm: known\n"]),
    "population": Reader("a.yaml", _population, lambda: [b"population:\n  preset: adults\n", b"preset: myopes\n"]),
    "population-table": Reader("a.yaml", _population_table, _population_table_seeds),
    "columns": Reader("a.yaml", _columns, _seeds(COLUMNS)),
    "rig": Reader("a.yaml", _rig, _rig_seeds),
    "plan": Reader("a.yaml", _plan, _plan_seeds),
    "sweep": Reader(
        "a.yaml", _sweep, lambda: [b"format: 1\nscene: guestrin2006\nsweep:\n  resolution_scale: [1.0, 0.5]\n"]
    ),
    "named": Reader("a.json", _named, _seeds({"kind": "dataset", "file": "b.obj", "x": ["a.json", 1]})),
    "table-draw": Reader("a.csv", _table_draw, lambda: [b"a,b,w\n1,2,0.5\n3,4e-2,1\n"]),
    "topography-ply": Reader("a.ply", _topography_ply, _topography_ply_seeds),
    "topography-names": Reader("a.yaml", _topography_names, _seeds({"cornea": [{"shape": GRID}]})),
    "manifest": Reader("a.json", _manifest, _seeds(MANIFEST)),
    "texture": Reader("a.png", _texture, _texture_seeds),
    "results": Reader("a.json", _against, _results_seeds),
    "network": Reader("a.onnx", _network, _network_seeds),
    "signs": Reader("a.json", _signs, _seeds(STUDY, {"schema": "eyerender/folder/1", "files": ["a", "b/"]})),
    "sweep-mark": Reader("sweep.json", _sweep_mark, _sweep_seeds),
    "rate": Reader("a.json", _rate, _seeds({"format": "eyerender/rate/2", **RATE})),
    "verdict": Reader("a.json", _verdict, _seeds({"verdict": {"ok": True, "detail": "LLVM 19"}})),
    "answers": Reader("a.jsonl", _answers, _answers_seeds),
    "sequence-trace": Reader("a.csv", _trace, lambda: [b"time_s,x,y,torsion_deg\n0,1,2,0\n0.5,,nan,0\n1,-3,4e-1,1\n"]),
    "sequence-stamps": Reader("a.npy", _stamps, _stamps_seeds),
    "map-file": Reader("a.map", _map_file, _map_seeds),
}
