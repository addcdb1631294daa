"""Readers of files that other people made, for fuzzing: `python -m tests.fuzz.readers SECONDS SEED [NAME...]`.

A reader takes the path of a file. Its seeds are whole files, which are mutated. A case must end in success or with an
`EyerenderError` of one line, within limits of memory and time (`tests/support/fuzzing.py`). Run as a program, this
module fuzzes each reader for some seconds of processor time, prints the number of cases and every failure, and with
`--guided FOLDER` lets atheris (libFuzzer) mutate one reader's files, which keeps inputs that reach new code.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from tests.fuzz.folders import FOLDERS
from tests.fuzz.reader import Reader, beside_metadata, folder_seeds, png_seeds, record_seeds, suppress_input
from tests.fuzz.small import SMALL
from tests.support.fuzzing import mutated, proper

ROOT = Path(__file__).resolve().parents[2]
LONGEST_BYTES = 8192
BIOMETRY = (
    b"format: 3\nname: a\nbiometry: {k1_d: 43, k1_axis_deg: 20, k2_d: 44.5, acd_mm: 3.4, lens_mm: 4, axial_mm: 24, "
    b"wtw_mm: 12}\nfovea: {field_deg: [5, 1]}\n"
)


def _scene(path: Path) -> Any:
    from eyerender.scene.spec import SceneSpec

    return SceneSpec.load(path)


def _dataset(path: Path) -> Any:
    from eyerender.dataset.spec import DatasetSpec

    return DatasetSpec.load(path)


def _eye(path: Path) -> Any:
    from eyerender.eye.catalogue import load_eye

    return load_eye(path)


def _shipped(kind: str) -> list[bytes]:
    from eyerender.dataset.spec import shipped_datasets
    from eyerender.eye.catalogue import FOLDER
    from eyerender.scene import shipped_scenes

    paths = {"scene": shipped_scenes().values(), "dataset": shipped_datasets().values(), "eye": FOLDER.glob("*.yaml")}
    found = [path.read_bytes() for path in paths[kind]]
    return sorted((data for data in found if len(data) < LONGEST_BYTES), key=len)[:6]


def _records(path: Path) -> Any:
    from eyerender.gaze.records import load_observations

    return load_observations(path, "guestrin2006")


def _table(path: Path) -> Any:
    from eyerender.gaze.records import load_observations

    columns = {"format": 1, "pupil": ["x", "y"], "glints": [["gx", "gy"], None]}
    return load_observations(path, "guestrin2006", columns=columns)


def _folder(path: Path) -> Any:
    from eyerender.folders.imagefolder import ImageFolder

    folder = ImageFolder.load(path.parent)
    for entry in folder:
        with suppress_input():
            entry.mask()
        entry.labels  # noqa: B018
    return folder.truth()


def _image(path: Path) -> Any:
    from eyerender.folders.imagefile import read_any_image

    return read_any_image(path)


def _map(path: Path) -> Any:
    from eyerender.rendering.transport.environmentmap import read_map

    return read_map(path)


def _npy_seeds() -> list[bytes]:
    out = []
    for data in (np.ones((4, 8)), np.ones((4, 8, 3), np.float32)):
        file = BytesIO()
        np.save(file, data)
        out.append(file.getvalue())
    return out


def _hdr_seeds() -> list[bytes]:
    return [b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n" + bytes(range(128))]


def _pfm_seeds() -> list[bytes]:
    return [b"Pf\n8 4\n-1.0\n" + np.ones(32, np.float32).tobytes()]


def _exr_seeds() -> list[bytes]:
    import tempfile

    from eyerender.backends.choose import choose_backend

    choose_backend("llvm")
    from eyerender.rendering.scene.exr import write_exr

    with tempfile.TemporaryDirectory() as folder:
        write_exr(Path(folder) / "a.exr", np.ones((4, 8), np.float32))
        return [(Path(folder) / "a.exr").read_bytes()]


def _opencv(path: Path) -> Any:
    from eyerender.rig.opencv import read_opencv

    return read_opencv(path)


def _matrix(rows: int, columns: int, values: list[float]) -> str:
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {values}\n"


def _opencv_yaml_seeds() -> list[bytes]:
    camera = _matrix(3, 3, [800.0, 0.0, 320.0, 0.0, 800.0, 240.0, 0.0, 0.0, 1.0])
    text = f"image_width: 640\nimage_height: 480\ncamera_matrix: {camera}"
    return [f"%YAML:1.0\n---\n{text}distortion_coefficients: {_matrix(1, 5, [0.1, 0.0, 0.0, 0.0, 0.0])}".encode()]


def _opencv_npz_seeds() -> list[bytes]:
    file = BytesIO()
    np.savez(file, mtx=np.diag([800.0, 800.0, 1.0]), dist=np.zeros((1, 5)), ret=0.3, imageSize=[640, 480])
    return [file.getvalue()]


def _opencv_xml_seeds() -> list[bytes]:
    matrix = '<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt><data>800. 0. 320. 0. 800. '
    size = "<image_width>640</image_width><image_height>480</image_height>"
    text = f'<?xml version="1.0"?><opencv_storage>{size}{matrix}240. 0. 0. 1.</data></camera_matrix></opencv_storage>'
    return [text.encode()]


def _unit(path: Path) -> Any:
    from eyerender.rig.rig import Rig

    placed = {"calibration": {"file": str(path)}, "lights": [{"position_mm": [30, 0, 0]}]}
    return Rig.from_mapping(placed).build()


def _unit_seeds() -> list[bytes]:
    pose = {"R": np.eye(3).tolist(), "t": [0.0, 0.0, 40.0]}
    camera = {"name": "a", "K": [[300, 0, 200], [0, 300, 200], [0, 0, 1]], "image_size": [400, 400], **pose}
    device = {"cameras": [{**camera, "distortion": {"model": "fisheye", "k": [0.1, 0, 0, 0]}, "eyes": ["left"]}]}
    lens = {"ModelType": "CALIBRATION_LensDistortionModelRational6KT"}
    lens |= {"ModelParameters": [0.5, 0.5, 0.6, 0.6, *[0.1] * 6, 0, 0, 0, 0, 1.7]}  # type: ignore[dict-item]
    rt = {"Rotation": np.eye(3).ravel().tolist(), "Translation": [0, 0, 0.04]}
    windows = {"Intrinsics": lens, "Rt": rt, "SensorWidth": 400, "SensorHeight": 400, "Location": "HT0"}
    both = device | {"leds": [[30, 0, 0], {"position_mm": [30, 9, 0], "aim_mm": [0, 0, 0]}]}
    return [json.dumps(one).encode() for one in (both, {"CalibrationInformation": {"Cameras": [windows]}})]


def _topography(layout: str) -> Callable[[Path], Any]:
    def read(path: Path) -> Any:
        from eyerender.eye.parts import TopographySpec
        from eyerender.eye.topography import read_topography

        axes = {"x": "nasal", "y": "up", "z": "in", "unit": "mm"}
        return read_topography(TopographySpec.from_mapping({"path": path.name, "layout": layout, **axes}), path.parent)

    return read


def _points() -> list[tuple[float, float, float]]:
    at = np.linspace(-4, 4, 17)
    return [(x, y, 7.8 - float(np.sqrt(7.8**2 - x * x - y * y))) for x in at for y in at]


def _points_seeds() -> list[bytes]:
    return [("\n".join(f"{x:.2f},{y:.2f},{z:.3f}" for x, y, z in _points())).encode()]


def _matrix_seeds() -> list[bytes]:
    at = np.linspace(-4, 4, 17)
    rows = [[7.8 - float(np.sqrt(7.8**2 - x * x - y * y)) for x in at] for y in at]
    head = "," + ",".join(f"{x:.2f}" for x in at)
    lines = [f"{y:.2f}," + ",".join(f"{z:.3f}" for z in row) for y, row in zip(at, rows, strict=True)]
    return ["\n".join([head, *lines]).encode()]


def _head(path: Path) -> Any:
    from eyerender.region.head import load_head
    from eyerender.region.headspec import Head

    data = {"file": path.name, "unit": "mm", "licence": "none", "right_eye": [75.0, 75.0, 100.0]}
    return load_head(Head.from_mapping(data).resolved(path.parent))


def _mesh(kind: str) -> Callable[[], list[bytes]]:
    def seeds() -> list[bytes]:
        import trimesh

        box = trimesh.creation.box(extents=(150.0, 150.0, 200.0))
        data = box.export(file_type=kind)
        data = data.encode() if isinstance(data, str) else data
        return [data, box.export(file_type="ply", encoding="ascii")] if kind == "ply" else [data]

    return seeds


def _synteyes(path: Path) -> Any:
    from eyerender.population.synteyes import SyntEyes

    return SyntEyes.load(path)


def _synteyes_seeds() -> list[bytes]:
    from eyerender.population.synteyes import _LENS_TERMS, _SHAPES

    arrays = {name: np.ones(shape) for name, shape in _SHAPES.items()} | {_LENS_TERMS: np.ones(10)}
    arrays["weights_orig"] = np.array([0.5, 0.5]).reshape(_SHAPES["weights_orig"])
    file = BytesIO()
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    return [file.getvalue()]


def _estimator(path: Path) -> Any:
    from eyerender.gaze.store import load_calibration

    return load_calibration(path)


def _estimator_seeds() -> list[bytes]:
    from tests.fuzz.test_records import calibration

    return [json.dumps(calibration(name)).encode() for name in ("regression", "homography")]


def _cached_map(path: Path) -> Any:
    from eyerender.region.mapcache import _decoded

    return _decoded(path.read_bytes())


def _cached_map_seeds() -> list[bytes]:
    from eyerender.region.mapcache import SCHEMA

    data = np.ones((4, 4), np.float32)
    header = {"schema": SCHEMA, "dtype": "float32", "shape": [4, 4], "crc32": zlib.crc32(data.data)}
    return [json.dumps(header).encode() + b"\n" + data.tobytes()]


def _done(path: Path) -> Any:
    from eyerender.dataset.shard import verify

    place = path.parent / "shards" / "00000"
    place.mkdir(parents=True, exist_ok=True)
    (place / "done.json").write_bytes(path.read_bytes())
    return list(verify(path.parent, 0))


def _done_seeds() -> list[bytes]:
    files = {"shards/00000/lines.jsonl": {"bytes": 0, "sha256": "0"}}
    done = {"schema": "eyerender/shard/1", "shard": 0, "samples": [0, 1], "images": 1, "images_saturated": 0}
    more = {
        "digest": "",
        "versions": {},
        "backend": {"name": "llvm", "device": "cpu"},
        "cpu": "",
        "rejections": [],
        "given_up": [],
    }
    return [json.dumps({**done, **more, "files": files}).encode()]


def _run_file(path: Path) -> Any:
    from eyerender.dataset.assemble import verify_dataset
    from eyerender.dataset.runfile import refuse_taken

    refuse_taken(path.parent)
    (path.parent / "dataset.json").write_bytes(path.read_bytes())
    return list(verify_dataset(path.parent))


def _run_file_seeds() -> list[bytes]:
    spec = {"count": 1, "shard_size": 1}
    both = {"digest": "x", "spec": spec, "files": {}, "versions": {}}
    sums = {"metadata.jsonl": {"bytes": 0, "sha256": ""}}
    return [
        json.dumps({"schema": "eyerender/run/1", **both}).encode(),
        json.dumps({"schema": "eyerender/dataset/1", **both, "checksums": sums}).encode(),
    ]


def _benchmark(path: Path) -> Any:
    from eyerender.apps.benchmark.folder import load_labelled

    return load_labelled(path.parent)


def _study(path: Path) -> Any:
    from eyerender.apps.study.images import read_images

    return read_images(path.parent)


READERS: dict[str, Reader] = {
    "scene": Reader("a.yaml", _scene, lambda: _shipped("scene")),
    "dataset": Reader("a.yaml", _dataset, lambda: _shipped("dataset")),
    "eye": Reader("a.yaml", _eye, lambda: [BIOMETRY, *_shipped("eye")]),
    "records": Reader("a.json", _records, record_seeds),
    "table": Reader("a.csv", _table, lambda: [b"x,y,gx,gy\n320.5,240,300,200\n1,2,,nan\n"]),
    "folder": Reader("metadata.jsonl", _folder, folder_seeds, beside_metadata),
    "benchmark": Reader("metadata.jsonl", _benchmark, folder_seeds, beside_metadata),
    "study": Reader("metadata.jsonl", _study, folder_seeds, beside_metadata),
    "png": Reader("a.png", _image, png_seeds),
    "exr": Reader("a.exr", _map, _exr_seeds),
    "hdr": Reader("a.hdr", _map, _hdr_seeds),
    "pfm": Reader("a.pfm", _map, _pfm_seeds),
    "npy": Reader("a.npy", _map, _npy_seeds),
    "opencv-yaml": Reader("a.yaml", _opencv, _opencv_yaml_seeds),
    "opencv-xml": Reader("a.xml", _opencv, _opencv_xml_seeds),
    "opencv-npz": Reader("a.npz", _opencv, _opencv_npz_seeds),
    "unit": Reader("a.json", _unit, _unit_seeds),
    "topography-points": Reader("a.csv", _topography("points"), _points_seeds),
    "topography-matrix": Reader("a.csv", _topography("matrix"), _matrix_seeds),
    "ply": Reader("a.ply", _head, _mesh("ply")),
    "obj": Reader("a.obj", _head, _mesh("obj")),
    "synteyes": Reader("a.npz", _synteyes, _synteyes_seeds),
    "estimator": Reader("a.json", _estimator, _estimator_seeds),
    "cached-map": Reader("a.map", _cached_map, _cached_map_seeds),
    "shard": Reader("a.json", _done, _done_seeds),
    "run": Reader("run.json", _run_file, _run_file_seeds),
    **FOLDERS,
    **SMALL,
}


def _compiled() -> list[str]:
    """Return the modules with functions that numba compiles, which it cannot if they are instrumented."""
    package = ROOT / "eyerender"
    sources = [*package.glob("extraction/**/*.py"), *package.glob("optics/*.py"), *package.glob("*/*kernels.py")]
    return [".".join(source.relative_to(ROOT).with_suffix("").parts) for source in sources]


def fuzz(name: str, seconds: float, seed: int, folder: Path) -> tuple[int, list[str]]:
    """Read mutated files for some seconds of processor time: the number of cases, and each failure with its input."""
    rng, reader = Random(f"{name} {seed}"), READERS[name]
    seeds, failures, count, end = reader.seeds(), dict[str, str](), 0, time.process_time() + seconds
    while time.process_time() < end and len(failures) < 5:
        data, count = mutated(rng.choice(seeds), rng)[:LONGEST_BYTES], count + 1
        try:
            proper(lambda data=data: reader.case(data, folder / "case"))  # type: ignore[misc]
        except Exception as error:
            at = traceback.extract_tb(error.__traceback__)[-1]
            failures.setdefault(f"{at.filename}:{at.lineno}", f"{at.filename}:{at.lineno}: {error!r}: {data!r}"[:2000])
    return count, list(failures.values())


def guided(name: str, seconds: float, seed: int, folder: Path) -> None:
    """Fuzz one reader with the coverage of its code as the guide; a failure ends the process and leaves its input."""
    import atheris

    reader = READERS[name]
    with atheris.instrument_imports(include=["eyerender"], exclude=_compiled()):
        seeds = reader.seeds()
        for data in seeds:  # imports what the reader needs, so that it is instrumented
            proper(lambda data=data: reader.case(data, folder / "case"))  # type: ignore[misc]
    (folder / "corpus").mkdir()
    for k, data in enumerate(seeds):
        (folder / "corpus" / str(k)).write_bytes(data)
    options = {"seed": seed, "max_len": str(LONGEST_BYTES), "len_control": "0", "artifact_prefix": f"{folder}/"}
    options |= {"rss_limit_mb": "0", "malloc_limit_mb": "0", "timeout": "60"}
    runs, end = itertools.count(), time.monotonic() + seconds

    def one(data: bytes) -> None:
        count = next(runs)
        if time.monotonic() > end:
            print(f"{count} runs", flush=True)
            os._exit(0)  # libFuzzer's own end does not join the threads of Mitsuba
        proper(lambda: reader.case(data, folder / "case"))

    atheris.Setup(["fuzz", *(f"-{key}={value}" for key, value in options.items()), str(folder / "corpus")], one)
    atheris.Fuzz()


def main() -> None:
    """Fuzz the readers that the command line names, or all."""
    parser = argparse.ArgumentParser()
    parser.add_argument("seconds", type=float)
    parser.add_argument("seed", type=int)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--guided", type=Path)
    given = parser.parse_args()
    if given.guided is not None:
        return guided(given.names[0], given.seconds, given.seed, given.guided)
    total = 0
    for name in given.names or READERS:
        with tempfile.TemporaryDirectory() as folder:
            count, failures = fuzz(name, given.seconds, given.seed, Path(folder))
        total += count
        print(name, count, *failures, sep="\n  ", flush=True)
    print(f"{total} cases", flush=True)
    return None


if __name__ == "__main__":
    main()
