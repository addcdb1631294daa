#!/usr/bin/env python3
"""
Do rendered eyes teach more than drawn blobs?
=============================================

This script trains the small U-Net of ``train_segmentation.py`` three times, with the same number of steps: on datasets
of people, on as many eyes drawn as plain ellipses, which know nothing of light, and on both. It tests the networks on
pictures that you have labelled::

    eyerender generate people_iris_camera --count 96 --subjects 32 --size 320x240 -o out/iris
    eyerender generate people_openeds --count 40 --subjects 20 --size 200x320 -o out/openeds
    eyerender generate people_pupil_core --count 48 --subjects 12 --size 200x200 -o out/core
    eyerender generate people_nvgaze --count 32 --subjects 8 --size 320x240 -o out/nvgaze
    python examples/own_labels.py out/* --test my_frames/ --ellipses my_frames/ellipses.csv

The table of ellipses has the columns ``file``, ``x_px``, ``y_px``, ``a_px``, ``b_px`` (semi-axes) and ``angle_deg``
(from x, which points right, to y, which points down), one labelled pupil per row. An optional column ``part`` says
``pupil`` or ``iris``. The script prints the mean intersection over union (IoU) of each part. Files that are named
``SOURCE__NAME.png`` are counted by their source. It needs PyTorch (the extra ``torch``). Your labels are used for the
test only.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import cv2
import numpy as np
import torch
from segment_recorded import HEIGHT, WIDTH, fit, levelled, placed, shrunk, varied
from torch.utils.data import ConcatDataset, DataLoader, default_collate
from train_segmentation import UNet, train

from eyerender.torch import FolderDataset

PART = {"sclera": 1, "iris": 2, "pupil": 3}
WIDTHS = {"iris": 1.6, "pupil": 4.0}  # height of the closer look, in diameters of the part
COLUMNS = ("file", "x_px", "y_px", "a_px", "b_px", "angle_deg")
Items = list[dict[str, torch.Tensor]]


def rendered(folders: list[Path]) -> Items:
    """Read all pictures and masks of the datasets."""
    read: Any = ConcatDataset([FolderDataset(f, parts=("image", "mask"), transform=shrunk) for f in folders])
    return [read[k] for k in range(len(read))]


def blob(rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """Draw one eye as ellipses of even grey with lids, glints and lashes, and its mask."""
    w, h = round(1.5 * WIDTH), round(1.5 * HEIGHT)
    radius = rng.uniform(0.10, 0.26) * w
    middle = np.array([w, h]) * (0.5 + rng.uniform(-0.15, 0.15, 2))
    tilt, aspect = rng.uniform(0, 180), rng.uniform(0.75, 1.0)
    image, mask = np.full((h, w), rng.uniform(0.3, 0.9)), np.zeros((h, w), np.uint8)
    opening = np.zeros((h, w), np.uint8)
    lids = radius * np.array([rng.uniform(1.8, 2.6), rng.uniform(0.5, 1.2)])
    cv2.ellipse(opening, (middle, 2 * lids, rng.uniform(-10, 10)), 1, -1)
    levels = {"sclera": rng.uniform(0.35, 0.6), "iris": rng.uniform(0.2, 0.5), "pupil": rng.uniform(0.0, 0.12)}
    sizes = {"sclera": 3 * radius, "iris": radius, "pupil": radius * rng.uniform(0.2, 0.65)}
    for name, size in sizes.items():
        inside = np.zeros((h, w), np.uint8)
        cv2.ellipse(inside, (middle, (2 * size, 2 * size * aspect), tilt), 1, -1)
        seen = (inside & opening) == 1
        image[seen], mask[seen] = levels[name], PART[name]
    for _ in range(rng.integers(1, 9)):
        at = middle + radius * rng.uniform(-0.7, 0.7, 2)
        cv2.circle(image, np.rint(at).astype(int).tolist(), int(rng.integers(1, 4)), 1.0, -1)
    for x in rng.uniform(-lids[0], lids[0], rng.integers(0, 50)):
        root = middle + np.array([x, -lids[1] * np.sqrt(1 - (x / lids[0]) ** 2)])
        tip = root + np.array([0.3 * x, rng.uniform(-0.5, 0.3) * radius])
        cv2.line(image, np.rint(root).astype(int).tolist(), np.rint(tip).astype(int).tolist(), 0.1, 1)
    image = cv2.GaussianBlur(image, (0, 0), 1.0)
    return {"image": torch.from_numpy(image).float()[None], "mask": torch.from_numpy(mask)}


def trained(items: Items, steps: int) -> UNet:
    """Train a network on pictures, which are changed at random each time."""
    torch.manual_seed(0)
    loader: DataLoader[Any] = DataLoader(
        items,  # type: ignore[arg-type]
        batch_size=min(12, len(items)),
        shuffle=True,
        drop_last=True,
        collate_fn=lambda batch: default_collate([varied(item) for item in batch]),
    )
    network = UNet().to(memory_format=torch.channels_last)  # faster on processors
    train(network, loader, max(steps // max(len(loader), 1), 1), rate=3e-3)
    return network.eval()


def refuse(reason: str) -> NoReturn:
    """End with one line and exit code 2."""
    print(f"error: {reason}", file=sys.stderr)
    raise SystemExit(2)


class Label(NamedTuple):
    """The labelled ellipse of a part: middle and semi-axes in px, angle in degrees."""

    file: str
    part: str
    x: float
    y: float
    a: float
    b: float
    angle: float


def labels(file: Path) -> list[Label]:
    """Read the table of ellipses; a table that does not fit ends the script."""
    try:
        with file.open(newline="", encoding="utf-8") as source:
            rows = list(csv.DictReader(source))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        refuse(f"{file}: cannot be read: {error}")
    out = []
    for number, row in enumerate(rows, 2):
        part = row.get("part") or "pupil"
        if missing := [name for name in COLUMNS if not row.get(name)]:
            refuse(f"{file}: line {number}: lacks {', '.join(missing)}")
        if part not in ("pupil", "iris"):
            refuse(f"{file}: line {number}: part must be pupil or iris, not {part!r}")
        try:
            out.append(Label(row["file"], part, *(float(row[name]) for name in COLUMNS[1:])))
        except ValueError as error:
            refuse(f"{file}: line {number}: {error}")
    return out or refuse(f"{file}: has no rows")


def largest(mask: np.ndarray) -> np.ndarray:
    """Return the convex hull of the largest piece of a mask (h, w) as a mask."""
    pieces = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    out = np.zeros(mask.shape, np.uint8)
    if pieces:
        cv2.fillConvexPoly(out, cv2.convexHull(max(pieces, key=cv2.contourArea)), 1)
    return out > 0


class View(NamedTuple):
    """What a canvas (height, width) shows of a picture: a scale, and its middle as (x, y) from -1 to 1."""

    scale: float
    middle: torch.Tensor
    canvas: tuple[int, int]


def region(network: UNet, picture: torch.Tensor, part: str, view: View) -> np.ndarray:
    """Find a part in a view of a picture (1, h, w), as a mask of the picture."""
    (h, w), (height, width) = picture.shape[-2:], view.canvas
    seen = levelled(placed(picture, view.scale, 0.0, view.middle, "bilinear", view.canvas))
    with torch.inference_mode():
        shares = network(seen[None])[0].softmax(0)
    share = shares[PART[part] : PART["pupil"] + 1].sum(0, keepdim=True)  # the pupil is a part of the iris
    back = -view.middle * view.scale * torch.tensor([w / width, h / height])
    return largest(placed(share, 1 / view.scale, 0.0, back, "bilinear", (h, w))[0].numpy() > 0.5)


def outline(network: UNet, picture: torch.Tensor, part: str) -> np.ndarray:
    """Find a part in a picture (1, h, w): look at the whole picture, and then closer at what was found."""
    scale, canvas = fit(picture)
    first = region(network, picture, part, View(scale, torch.zeros(2), canvas))
    if not first.any():
        return first
    y, x = np.nonzero(first)
    middle = torch.tensor([2 * (x.mean() + 0.5) / first.shape[1] - 1, 2 * (y.mean() + 0.5) / first.shape[0] - 1])
    closer = HEIGHT / (WIDTHS[part] * 2 * np.sqrt(len(x) / np.pi))
    view = View(min(max(closer, scale), max(2.0, scale)), middle.float(), (HEIGHT, WIDTH))
    second = region(network, picture, part, view)
    return second if second.any() else first


def overlap(network: UNet, picture: np.ndarray, label: Label) -> float:
    """Compute the IoU of the part that a network finds in a grey picture and the labelled ellipse."""
    true = np.zeros(picture.shape, np.uint8)
    cv2.ellipse(true, ((label.x, label.y), (2 * label.a, 2 * label.b), label.angle), 1, -1)
    mine, theirs = outline(network, torch.from_numpy(picture / 255).float()[None], label.part), true > 0
    return float((mine & theirs).sum() / max((mine | theirs).sum(), 1))


def main() -> int:
    """Train the networks and print how well each finds the labelled parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="datasets with masks")
    parser.add_argument("--test", type=Path, required=True, help="the folder of your pictures")
    parser.add_argument("--ellipses", type=Path, required=True, help="the table of your labels (CSV)")
    parser.add_argument("--steps", type=int, default=1200, help="batches of 12 pictures for each network")
    options = parser.parse_args()
    table = labels(options.ellipses)
    items, rng = rendered(options.folders), np.random.default_rng(1)
    blobs = [blob(rng) for _ in items]
    arms = {"rendered": items, "blobs": blobs, "both": items + blobs}
    networks = {name: trained(arm, options.steps) for name, arm in arms.items()}
    found: dict[tuple[str, str], list[list[float]]] = defaultdict(list)
    for label in table:
        picture = cv2.imread(str(options.test / label.file), cv2.IMREAD_GRAYSCALE)
        if picture is None:
            print(f"{label.file}: cannot be read", file=sys.stderr)
            continue
        source = label.file.split("__")[0] if "__" in label.file else "all"
        found[source, label.part].append([overlap(network, picture, label) for network in networks.values()])
    print(f"{len(items)} pictures rendered, as many blobs\n{'pictures':16s} part      n  " + "  ".join(networks))
    for (source, part), scores in sorted(found.items()):
        means = "  ".join(f"{m:8.3f}" for m in np.mean(scores, axis=0))
        print(f"{source:16s} {part:6s} {len(scores):4d}  {means}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
