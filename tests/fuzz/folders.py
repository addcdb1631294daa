"""Readers of one file in a folder of a dataset or of labelled images, with the files that must stand beside it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz.reader import Reader, beside_metadata, folder_seeds, suppress_input

SHAPE = (48, 64)


def png(path: Path) -> None:
    """Write a picture with a dark pupil."""
    from eyerender.folders.imagefile import write_png

    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.where(disc(), 20, 120).astype(np.uint8))


def disc() -> Any:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return np.hypot(x - 32, y - 24) < 12


def _jsons(*values: Any) -> Callable[[], list[bytes]]:
    return lambda: [json.dumps(value).encode() for value in values]


def _npy(*arrays: Any) -> list[bytes]:
    out = []
    for array in arrays:
        file = BytesIO()
        np.save(file, array)
        out.append(file.getvalue())
    return out


def _labelled(above: int) -> Callable[[Path], Any]:
    """Read the labelled folder that holds the file `above` levels up."""

    def read(path: Path) -> Any:
        from eyerender.apps.benchmark.folder import load_labelled

        return load_labelled(path.parents[above])

    return read


def _coco_seeds() -> list[bytes]:
    from eyerender.dataset.export.coco import run_lengths

    marks: list[dict[str, Any]] = [
        {"segmentation": [], "ellipse": [32.0, 24.0, 12.0, 12.0, 0.0]},
        {"segmentation": {"counts": run_lengths(disc()), "size": list(SHAPE)}},
        {"segmentation": [[20.0, 12.0, 44.0, 12.0, 44.0, 36.0, 20.0, 36.0]]},
    ]
    glint = {"id": 2, "image_id": 1, "category_id": 4, "keypoints": [30.5, 20.0, 2], "light": 0}
    image = {"id": 1, "file_name": "a.png", "width": SHAPE[1], "height": SHAPE[0], "subject": 7}
    categories = [{"id": 3, "name": "pupil"}, {"id": 4, "name": "glint"}]
    pupils = [{"id": 1, "image_id": 1, "category_id": 3, **mark} for mark in marks]
    return _jsons(*({"categories": categories, "images": [image], "annotations": [p, glint]} for p in pupils))()


def _beside_openeds(folder: Path) -> None:
    png(folder / "train" / "images" / "0.png")
    (folder / "train" / "labels").mkdir()
    np.save(folder / "train" / "labels" / "0.npy", np.where(disc(), 3, 2).astype(np.uint8))


def _beside_own(folder: Path) -> None:
    png(folder / "images" / "a.png")
    (folder / "labels.csv").write_bytes(OWN)


def _video(suffix: str) -> bytes:
    import tempfile

    import cv2

    with tempfile.TemporaryDirectory() as place:
        path = f"{place}/a{suffix}"
        code = cv2.VideoWriter.fourcc(*("MJPG" if suffix == ".avi" else "mp4v"))
        writer = cv2.VideoWriter(path, cv2.CAP_FFMPEG, code, 25.0, SHAPE[::-1])
        for level in (20, 200):
            writer.write(np.full((*SHAPE, 3), level, np.uint8))
        writer.release()
        return Path(path).read_bytes()


def _beside_video(video: str) -> Callable[[Path], None]:
    def beside(folder: Path) -> None:
        (folder / video).parent.mkdir(parents=True)
        (folder / video).write_bytes(_video(Path(video).suffix))

    return beside


def _read_video(path: Path) -> Any:
    from eyerender.folders.video import VideoReader

    return sum(frame.image.size for frame in VideoReader(path))


OWN = b"image,centre_x_px,centre_y_px,semi_axis_a_px,semi_axis_b_px,angle_deg,visible,subject\n"
OWN += b"a.png,32,24,12,11,5,0.9,s\n"
RIG = {"K": np.eye(3).tolist(), "R": np.eye(3).tolist(), "t_mm": [0, 0, 600], "lights_mm": [[9, 0, 0]]}
HINTS = {"schema": "eyerender/hints/1", "gamma": 2.2, "radius_px": [4, 40], "rig": {**RIG, "eye_mm": [0, 0, 0]}}


def _ideal_seeds() -> list[bytes]:
    pupil = {"status": "ok", "centre_px": [32, 24], "semi_axes_px": [12, 12], "angle_rad": 0.0}
    said = {"lid": False, "bit_depth": 8, "polarity": "dark", "noise_dn": 1.0, "blur_px": 1.0, "step_dn": 100.0}
    record = {"pupil": pupil, "glints": [{"light": 0, "xy_px": [30, 20], "status": "ok"}]}
    return _jsons({"file_name": "images/a.png", "records": [record], "parameters": said})()


def _beside_ideal(folder: Path) -> None:
    png(folder / "images" / "a.png")
    (folder / "dataset.json").write_text('{"schema": "eyerender/ideal-images/1"}', encoding="utf-8")


def _line(**more: Any) -> dict[str, Any]:
    line = json.loads(folder_seeds()[0])
    line |= {"subject": 0, "sample": 0, "split": "train", "mask_file_name": None, **more}
    return {**line, "parameters": {"scene_json": '{"a": 1.5}', "eye_json": "{}", "draws": {"a.b": 1.0}}}


def _packed_lines() -> tuple[bytes, list[int]]:
    from eyerender.folders.packed import MEMBERS, pack_lines

    lines = [_line(sample=k, split=("train", "test")[k], **{MEMBERS: {"file_name": [512, 70]}}) for k in (0, 1)]
    return pack_lines(lines)


def _index() -> Any:
    from eyerender.folders.packed import INDEX_TYPE

    block = _packed_lines()[1][0]
    return np.array([(0, 0, 0, 0, 0, block), (1, 0, 1, 0, 1, block)], INDEX_TYPE)


def _beside_packed(folder: Path) -> None:
    (folder / "shards" / "00000").mkdir(parents=True)
    (folder / "shards" / "00000" / "lines.jsonl.gz").write_bytes(_packed_lines()[0])
    (folder / "shards" / "00000" / "images.tar").write_bytes(bytes(1024))
    dataset = {"schema": "eyerender/dataset/2", "splits": ["train", "test"]}
    (folder / "dataset.json").write_text(json.dumps(dataset), encoding="utf-8")
    np.save(folder / "index.npy", _index())


def _beside_packed_run(folder: Path) -> None:
    _beside_packed(folder)
    (folder / "dataset.json").unlink()
    (folder / "run.json").write_text('{"schema": "eyerender/run/2"}', encoding="utf-8")


def _packed_done() -> dict[str, Any]:
    columns = {key: _index()[key].tolist() for key in ("sample", "subject", "split", "block")}
    return {"images": 2, "splits": ["train", "test"], "columns": columns}


def _images(above: int) -> Callable[[Path], Any]:
    """Read all lines and pictures of the image folder that holds the file `above` levels up."""

    def read(path: Path) -> Any:
        import warnings

        from eyerender.dataset.validation.lines import compare_lines
        from eyerender.dataset.validation.problems import FolderProblems
        from eyerender.folders.imagefolder import ImageFolder

        with warnings.catch_warnings(action="ignore"):
            folder = ImageFolder.load(path.parents[above])
        for entry in folder.entries[:20]:
            with suppress_input():
                entry.image()
            entry.labels  # noqa: B018
        folder.rows_of("train")
        with suppress_input():
            folder.samples()
        return compare_lines(folder, FolderProblems())

    return read


def _export(path: Path) -> Any:
    from eyerender.apps.benchmark.layouts import stated_gamma

    return stated_gamma(path.parent)


def _status(path: Path) -> Any:
    from eyerender.dataset.status import status
    from tests.support.fuzzing import strict_json

    found = status(path.parent)
    strict_json(found)
    return found


def _run_seeds() -> list[bytes]:
    return _jsons({"schema": "eyerender/run/1", "spec": _plan().to_mapping()["spec"]})()


def _beside_log(folder: Path) -> None:
    (folder / "run.json").write_bytes(_run_seeds()[0])


def _log_seeds() -> list[bytes]:
    event = {"time": "2026-01-01T00:00:00Z", "host": "h", "part": "1/1", "seconds": 1.0}
    more: list[dict[str, Any]] = [{"event": "start"}, {"event": "shard", "images": 5, "bytes": 9}, {"event": "retry"}]
    return [b"".join(json.dumps({**event, **one}).encode() + b"\n" for one in more)]


def _hashed(data: bytes) -> dict[str, Any]:
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


LINE = b'{"sample": 0, "file_name": "images/00000/00000000-right.png", "mask_file_name": null}\n'


def _made(digest: str, backend: str = "llvm") -> dict[str, Any]:
    """Content of a done.json, or of a checkpoint, for one picture."""
    from eyerender.dataset.done import cpu_family, run_versions
    from eyerender.dataset.environment import rounding

    done = {"schema": "eyerender/shard/1", "shard": 0, "samples": [0, 1], "chosen": None, "images": 1, "digest": digest}
    done |= {"images_saturated": 0, "versions": run_versions(), "backend": {"name": backend, "device": "x"}}
    done |= {
        "cpu": cpu_family(),
        "rounding": rounding(),
        "rejections": [],
        "given_up": [],
        "saturated": [],
        "seconds": 1.0,
    }
    return done | {
        "files": {"images/00000/00000000-right.png": _hashed(b"x"), "shards/00000/lines.jsonl": _hashed(LINE)}
    }


@cache
def _plan() -> Any:
    from tests.support.dataset_specs import plan

    return plan(count=10, shard_size=5, subjects=2)


def _checkpoint(path: Path) -> Any:
    from eyerender.dataset.partial import PartialShard

    with PartialShard(_plan(), {"name": "llvm", "device": "x"}, path.parents[1], 0) as shard:
        return shard.images


def _beside_checkpoint(folder: Path) -> None:
    stage = folder / ".partial-00000-0"
    for name, data in (("images/00000000-right.png", b"x"), ("shard/lines.jsonl", LINE)):
        (stage / name).parent.mkdir(parents=True)
        (stage / name).write_bytes(data)


def _made_packed() -> dict[str, Any]:
    lines, blocks = _packed_lines()
    files = {"shards/00000/images.tar": _hashed(bytes(1024)), "shards/00000/lines.jsonl.gz": _hashed(lines)}
    more = {"columns": {"block": blocks}, "splits": [], "counts": {}}
    return {**_made(_plan().digest), "schema": "eyerender/shard/2", "files": files, **more}


def _beside_packed_checkpoint(folder: Path) -> None:
    stage = folder / ".partial-00000-0" / "shard"
    stage.mkdir(parents=True)
    (stage / "images.tar").write_bytes(bytes(1024))
    (stage / "lines.jsonl.gz").write_bytes(_packed_lines()[0])


def _merge(path: Path) -> Any:
    from eyerender.dataset.merge import _take

    (path.parents[2] / "out").mkdir()
    return _take(path.parents[2] / "out", [path.parents[2]], _plan(), lambda *_: None)


def _beside_merge(folder: Path) -> None:
    for name, data in (("images/00000/00000000-right.png", b"x"), ("shards/00000/lines.jsonl", LINE)):
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_bytes(data)


def _beside_lines(folder: Path) -> None:
    beside_metadata(folder)
    (folder / "metadata.jsonl").write_bytes(b"\n".join(folder_seeds()))
    (folder / "shards" / "00000").mkdir(parents=True)
    (folder / "shards" / "00000" / "done.json").write_text("{}", encoding="utf-8")


FOLDERS: dict[str, Reader] = {
    "coco": Reader("annotations/instances_train.json", _labelled(1), _coco_seeds, lambda f: png(f / "train" / "a.png")),
    "openeds": Reader(
        "train/labels/0.npy",
        _labelled(2),
        lambda: _npy(np.where(disc(), 3, 2).astype(np.uint8), np.zeros(SHAPE, np.int32)),
        lambda f: png(f / "train" / "images" / "0.png"),
    ),
    "subjects": Reader(
        "files.csv", _labelled(0), lambda: [b"file,from,subject\ntrain/images/0.png,a.png,7\n"], _beside_openeds
    ),
    "excuse": Reader("a.txt", _labelled(0), lambda: [b"i n x y\n1 12 64 48\n"], lambda f: png(f / "a/0012.png")),
    "lpw": Reader("1/2.txt", _labelled(1), lambda: [b"32 24\n30.5 20\n"], _beside_video("1/2.avi")),
    "teyed": Reader(
        "ANNOTATIONS/a.mp4pupil_eli.txt",
        _labelled(1),
        lambda: [b"FRAME;ANGLE;CENTER X;CENTER Y;WIDTH;HEIGHT;\n1;10;32;24;20;18;\n2;0;0;0;-1;-1;\n"],
        _beside_video("VIDEOS/a.mp4"),
    ),
    "own-labels": Reader("labels.csv", _labelled(0), lambda: [OWN], lambda f: png(f / "images" / "a.png")),
    "own-glints": Reader("glints.csv", _labelled(0), lambda: [b"image,x_px,y_px,light\na.png,30,20,0\n"], _beside_own),
    "hints": Reader("hints.json", _labelled(0), _jsons(HINTS), _beside_own),
    "ideal": Reader("metadata.jsonl", _labelled(0), _ideal_seeds, _beside_ideal),
    "avi": Reader("a.avi", _read_video, lambda: [_video(".avi")]),
    "mp4": Reader("a.mp4", _read_video, lambda: [_video(".mp4")]),
    "packed-index": Reader("index.npy", _images(0), lambda: _npy(_index()), _beside_packed),
    "packed-lines": Reader("shards/00000/lines.jsonl.gz", _images(2), lambda: [_packed_lines()[0]], _beside_packed),
    "packed-dataset": Reader(
        "dataset.json",
        _images(0),
        _jsons({"schema": "eyerender/dataset/2", "splits": ["train", "test"]}),
        _beside_packed,
    ),
    "packed-done": Reader(
        "shards/00000/done.json", _images(2), lambda: _jsons(_packed_done())(), _beside_packed_run
    ),
    "shard-lines": Reader(
        "shards/00000/lines.jsonl", _images(2), lambda: [b"\n".join(folder_seeds())], _beside_lines
    ),
    "checkpoint": Reader(
        ".partial-00000-0/done.json", _checkpoint, lambda: _jsons(_made(_plan().digest))(), _beside_checkpoint
    ),
    "packed-checkpoint": Reader(
        ".partial-00000-0/done.json", _checkpoint, lambda: _jsons(_made_packed())(), _beside_packed_checkpoint
    ),
    "merge": Reader("shards/00000/done.json", _merge, lambda: _jsons(_made(_plan().digest))(), _beside_merge),
    "export": Reader("export.json", _export, _jsons({"image": {"gamma": 2.2}})),
    "status-run": Reader("run.json", _status, _run_seeds),
    "status-log": Reader("log.jsonl", _status, _log_seeds, _beside_log),
}  # fmt: skip
