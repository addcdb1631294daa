"""How much memory large folders take: the peak of a process of its own, above that of one that only imports."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eyerender.analytic.observer import trace
from eyerender.dataset.plan import Plan
from eyerender.dataset.spec import DatasetSpec
from eyerender.folders.imagefile import write_png
from eyerender.folders.imagefolder import write_dataset
from eyerender.folders.outfolder import staged
from eyerender.optics.ellipse import Ellipse, signed_distance
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec

pytestmark = [
    pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="tells peaks of memory in /proc only"),
    pytest.mark.packaging,
]
WIDTH, HEIGHT = 96, 72
SCENE = {
    "format": 2,
    "name": "grid",
    "eye": {"model": "E2"},
    "subject": {"eyes": ["right", "left"]},
    "rig": {
        "cameras": [
            {
                "position_mm": [615.0, 0.0, -150.5],
                "look_at_mm": [0.0, 0.0, 0.0],
                "focal_length_px": 2400.0,
                "resolution_px": [640, 480],
            }
        ],
        "lights": [
            {"position_mm": [615.0, y, 0.0], "radius_mm": 2.5, "intensity_mw_sr": 100.0} for y in (208.5, -208.5)
        ],
        "screen": {"centre_mm": [650.0, 0.0, 0.0], "size_mm": [377.0, 301.0]},
    },
    "targets": {"grid": [3, 3]},
    "image": {"window_px": [WIDTH, HEIGHT]},
    "sensor": {"f_number": 2.8, "exposure_ms": 15.0, "pixel_pitch_um": 7.5, "full_well_e": 20000.0, "bit_depth": 8},
}


# Not `getrusage`, whose peak a process inherits from the one that started it.
PEAK = """def peak():
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) / 1024 for line in file if line.startswith("VmHWM"))
"""


def grown(code):
    """MiB that a process grows by while it runs `code`, after the imports that stand before its blank line."""
    imports, work = code.split("\n\n", 1)
    text = f"{PEAK}\n{imports}\nbefore = peak()\n{work}\nprint(peak() - before)"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def folder_of(path, count):
    """A folder of `count` images, two a frame, of a scene of nine targets.

    Every tenth frame shows pupils and glints where the scene has them; the others are even, which saves the time of
    extracting their features.
    """
    spec = SceneSpec.from_mapping(SCENE)
    lines = []
    with staged(path) as stage:
        (stage / "images").mkdir()
        write_png(stage / "images" / "even.png", np.full((HEIGHT, WIDTH), 90, np.uint8))
        for k, record in enumerate(trace(Scene.of(spec)).records()):
            x, y = (round(v) for v in record["pupil"]["centre_px"])
            window = {"x0": x - WIDTH // 2, "y0": y - HEIGHT // 2, "width": WIDTH, "height": HEIGHT}
            write_png(stage / "images" / f"{k}.png", drawn(record, window))
            lines.append({"file_name": "", "window_px": window, "bit_depth": 8, "records": [record]})
            lines[-1]["parameters"] = {"scene_json": json.dumps(spec.to_mapping())}
        write_dataset(stage, lines, spec=spec.to_mapping(), digest="d")
    with open(path / "metadata.jsonl", "w", encoding="utf-8") as file:
        for k in range(count):
            frame, which = k // 2, k % len(lines)
            line: dict[str, Any] = {**lines[which], "file_name": f"images/{'even' if frame % 10 else which}.png"}
            line["records"][0] |= {"frame": frame, "instant": frame}
            file.write(json.dumps({"schema": "eyerender/image/5", **line}) + "\n")
    return path


def drawn(record, window):
    """A picture of a record's pupil and glints, grey levels by the share of a pixel that each covers."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    place = np.stack([u + window["x0"], v + window["y0"]], axis=-1)
    pupil = record["pupil"]
    ellipse = Ellipse(np.array(pupil["centre_px"]), np.array(pupil["semi_axes_px"]), pupil["angle_rad"])
    image = 90 - 70 * np.clip(0.5 - signed_distance(ellipse, place), 0, 1)
    for glint in record["glints"]:
        distance = np.linalg.norm(place - np.array(glint["xy_px"]), axis=-1)
        image = np.maximum(image, 250 * np.exp(-0.5 * (distance / 1.2) ** 2))
    noise = np.random.default_rng(record["frame"]).normal(0, 1, image.shape)
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)


def rows_of(path, count):
    """A folder of `count` lines of one template, none of whose images is there."""
    with staged(path) as stage:
        line: dict[str, Any] = {
            "file_name": "images/0000000.png",
            "mask_file_name": "masks/0000000.png",
            "records": [],
            "split": "a",
        }
        line["window_px"] = {"x0": 0, "y0": 0, "width": WIDTH, "height": HEIGHT}
        write_dataset(stage, [line], spec={}, digest="d")
    template = (path / "metadata.jsonl").read_text()
    with open(path / "metadata.jsonl", "w", encoding="utf-8") as file:
        for start in range(0, count, 10_000):
            file.writelines(template.replace("0000000", f"{k:07d}") for k in range(start, min(start + 10_000, count)))
    return path


def dataset_of(path, count, size):
    """A dataset of `count` samples in shards of `size`: a plan, and lines without labels or pictures."""
    scene = {key: value for key, value in SCENE.items() if key not in ("format", "name")} | {
        "targets": {"grid": [1, 1]}
    }
    spec = {"format": 3, "kind": "dataset", "name": "many", "count": count, "shard_size": size, "subjects": count // 10}
    spec |= {"scene": scene | {"subject": {"eyes": ["right"]}}, "splits": {"train": 0.8, "test": 0.2}}
    plan = Plan.of(DatasetSpec.from_mapping(spec))
    (record,) = trace(plan.draw(0).build(), boundary_points=6).records()
    sums = {"bytes": 1, "sha256": ""}
    done: dict[str, Any] = {
        "schema": "eyerender/shard/1",
        "digest": plan.digest,
        "versions": {},
        "cpu": "",
        "rejections": [],
    }
    done |= {"backend": {"name": "", "device": ""}, "given_up": [], "images_saturated": 0}
    path.mkdir()
    with open(path / "metadata.jsonl", "w", encoding="utf-8") as metadata:
        for shard in range(count // size):
            folder = path / "shards" / f"{shard:05d}"
            folder.mkdir(parents=True)
            with open(folder / "lines.jsonl", "w", encoding="utf-8") as lines:
                for sample in range(shard * size, (shard + 1) * size):
                    subject, sequence = plan.subject_of(sample)
                    name = f"{shard:05d}/{sample:08d}-right.png"
                    line: dict[str, Any] = {
                        "schema": "eyerender/image/5",
                        "file_name": f"images/{name}",
                        "mask_file_name": f"masks/{name}",
                    }
                    line |= {"sample": sample, "subject": subject, "split": plan.split_of(subject), "labels": {}}
                    line |= {"sequence_index": sequence, "records": [record | {"frame": sample}]}
                    line |= {"window_px": {"x0": 0, "y0": 0, "width": WIDTH, "height": HEIGHT}, "bit_depth": 8}
                    text = json.dumps(line) + "\n"
                    lines.write(text)
                    metadata.write(text)
            files = {f"shards/{shard:05d}/lines.jsonl": sums} | {
                f"images/{shard:05d}/{k}.png": sums for k in range(size)
            }
            here = {"shard": shard, "samples": [shard * size, (shard + 1) * size], "images": size, "files": files}
            (folder / "done.json").write_text(json.dumps(done | here))
    dataset = {"schema": "eyerender/dataset/1", "kind": "dataset", "digest": plan.digest, **plan.to_mapping()}
    (path / "dataset.json").write_text(json.dumps(dataset))
    return path


ITERATE = """from eyerender.folders.imagefolder import ImageFolder

folder = ImageFolder.load({path!r})
assert sum(1 for entry in folder.entries if entry.window[2]) == {count}
assert folder.entries[-1].name == "images/{last:07d}.png"
"""
VALIDATE = """import eyerender as er
er.trace(er.load_scene("quickstart"))  # loads the compiled ray optics, whose size does not depend on the folder
from eyerender.dataset.validate import validate

report = validate({path!r}, quick=True)
assert report["problem_count"] > {count}
assert len(report["problems"]) == 50
"""
COMPARE = """from eyerender.apps.quickstart import compare_folder

result = compare_folder({path!r})
assert len(result.truth) == {count}
assert abs(result.features.pupil_found.mean() - 0.1) < 0.02
assert result.gaze_found.ok.sum() > {count} / 25
assert result.gaze_truth.ok.all()
"""


@pytest.mark.parametrize(
    ("count", "most"), [(30_000, 16), pytest.param(1_000_000, 300, marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_going_through_a_folder_holds_no_lines(tmp_path, count, most):
    path = rows_of(tmp_path / "folder", count)
    found = grown(ITERATE.format(path=str(path), count=count, last=count - 1))
    print(f"{count} rows: {found:.0f} MiB")
    assert found < most


@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    ("count", "most"), [(6_000, 40), pytest.param(1_000_000, 300, marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_validating_a_folder_holds_no_lines(tmp_path, count, most):
    """Every line has something wrong, and every file is missing: that takes no more than if all were well."""
    path = dataset_of(tmp_path / "folder", count, count // 20)
    found = grown(VALIDATE.format(path=str(path), count=count))
    print(f"{count} rows: {found:.0f} MiB")
    assert found < most


@pytest.mark.slow
def test_comparing_twenty_thousand_images_holds_compact_arrays(tmp_path):
    path = folder_of(tmp_path / "folder", 20_000)
    found = grown(COMPARE.format(path=str(path), count=20_000))
    print(f"20,000 images: {found:.0f} MiB")
    assert found < 300
