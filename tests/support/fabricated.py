"""Large datasets out of a small one: many rows of 16 x 16 px, which nobody rendered."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from eyerender.folders.imagefile import read_image, write_png

SHARD = 100
FRAMES = 50  # a subject
SPLITS = ("train", "train", "validation", "test")


def fabricate(folder: Path, source: Path, rows: int) -> None:
    """A finished dataset of `rows` images, each with the labels of the first image of `source` and numbers of its own.

    The images of a shard are hard links to one file, and so are its masks.
    """
    model = json.loads((source / "metadata.jsonl").read_text(encoding="utf-8").splitlines()[0])
    image, mask = (read_image(source / model[key])[0][28:44, 40:56] for key in ("file_name", "mask_file_name"))
    model["window_px"] = {"x0": 0, "y0": 0, "width": 16, "height": 16}
    model["parameters"] |= {"scene": "{}", "eye": "{}"}  # the longest texts
    model["records"][0]["pupil"]["points_px"] = []
    done = json.loads((source / "shards" / "00000" / "done.json").read_text(encoding="utf-8"))
    sums, total = hashlib.sha256(), 0
    with open(_made(folder / "metadata.jsonl"), "wb") as metadata:
        for shard, first in enumerate(range(0, rows, SHARD)):
            count = min(SHARD, rows - first)
            lines, files = [], {}
            for sample in range(first, first + count):
                subject = sample // FRAMES
                names = {f"{key}file_name": f"{kind}/{shard:05d}/{sample:08d}-right.png" for key, kind in _KINDS}
                own = {"sample": sample, "subject": subject, "sequence_index": sample % FRAMES}
                lines.append(json.dumps({**model, **names, **own, "split": SPLITS[subject % len(SPLITS)]}))
                for name, pixels in zip(names.values(), (image, mask), strict=True):
                    if sample == first:
                        write_png(_made(folder / name), np.ascontiguousarray(pixels))
                        files[name] = _sum(folder / name)
                    else:
                        before = name.replace(f"{sample:08d}", f"{first:08d}")
                        os.link(folder / before, folder / name)
                        files[name] = files[before]
            text = "".join(line + "\n" for line in lines).encode()
            place = f"shards/{shard:05d}/lines.jsonl"
            _made(folder / place).write_bytes(text)
            files[place] = _sum(folder / place)
            finished = {"shard": shard, "samples": [first, first + count], "images": count, "files": files}
            (folder / "shards" / f"{shard:05d}" / "done.json").write_text(json.dumps({**done, **finished}))
            metadata.write(text)
            sums.update(text)
            total += len(text)
    dataset = json.loads((source / "dataset.json").read_text(encoding="utf-8"))
    dataset["spec"] |= {"count": rows, "shard_size": SHARD, "subjects": -(-rows // FRAMES)}
    dataset["checksums"] = {"metadata.jsonl": {"bytes": total, "sha256": sums.hexdigest()}}
    (folder / "dataset.json").write_text(json.dumps(dataset))


def peak_bytes(code: str, *argv: str) -> int:
    """The most memory that a Python process of its own held while it ran `code`, with `argv` in sys.argv[1:]."""
    told = "\nprint(next(line for line in open('/proc/self/status') if line.startswith('VmHWM')).split()[1])"
    command = [sys.executable, "-c", code + told, *argv]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return 1024 * int(done.stdout.splitlines()[-1])


_KINDS = (("", "images"), ("mask_", "masks"))


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _sum(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
