#!/usr/bin/env python3
"""
From a recipe to a running network
==================================

This script trains a small network on rendered eyes and writes it as an ONNX file. From one grey picture the network
finds the pupil's ellipse, the line of sight, the openness of the lids, the pupil's diameter, and a confidence::

    small="--size 128x128 --spp 4"
    eyerender generate people_two_cameras -o out/two --subjects 400 --count 400 --seed 61 --splits train=1 $small
    eyerender generate people_any_headset -o out/any --subjects 600 --count 600 --seed 71 --splits train=1 $small
    eyerender generate people_two_cameras -o out/people --subjects 20 --count 400 --seed 64 --splits test=1 $small
    eyerender generate people_any_headset -o out/rigs --subjects 10 --count 200 --seed 72 --splits test=1 $small
    python examples/gaze_network.py --write-moved moved.yaml
    eyerender generate moved.yaml -o out/moved --subjects 10 --count 200 --seed 63 --splits test=1 $small
    python examples/gaze_network.py out/two out/any --test out/people out/rigs out/moved --onnx gaze.onnx

The network is trained on the split ``train`` of the first folders and tested on the split ``test`` of the others, whose
people and rigs it has not seen. The script prints the errors with 95 % intervals, which come from drawing the people
anew, before and after a calibration from nine frames of each eye. With ``--pictures FOLDER --ellipses TABLE`` it also
compares the pupil with labels of your own, in a table as ``own_labels.py`` takes it. It needs the extra ``torch``.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from own_labels import Label, labels, refuse

from eyerender.base.errors import InputError
from eyerender.dataset import find_dataset
from eyerender.torch import Augment
from eyerender.torch.gaze import GRID, NAMES, Arrays, GazeNetwork, angle_deg, answers, gaze_errors, read, trained

SIZE = 128  # width and height of the pictures that the network sees, px
AUGMENT = Augment(flip=0.0, scale=(0.7, 1.5), roll_deg=20.0)
MOVED = {  # people_two_cameras in another headset: the camera 3 mm and 5 deg aside, another lens, exposure and lamps
    "position_mm: [{var: forward}, ": "position_mm: [{var: forward + 2.1}, ",
    "{var: -below}]": "{var: -below - 2.1}]",
    "look_at_mm: [-4, -31.5, 0]": "look_at_mm: [-4, -31.5, 2.5]",
    "look_at_mm: [-4, 31.5, 0]": "look_at_mm: [-4, 31.5, 2.5]",
    "low: 140, high: 195": "low: 110, high: 135",
    "exposure_ms: 2\n": "exposure_ms: 1.2\n",
    "position_mm: [17, ": "position_mm: [14, ",
}
Floats = NDArray[np.float64]


def upright(data: Arrays) -> Arrays:
    """Turn pictures as an owner of a headset would: not mirrored, and by quarters so that the upper lid is above.

    Distortion is taken to be radial, as that of the recipes is.
    """
    rows = data["mirrored"]
    data["image"][rows] = data["image"][rows].flip(-1)
    data["points"][rows, :, 0] *= -1
    data["shape"][rows, 2] *= -1
    data["gaze"][rows, 0] *= -1
    data["camera_gaze"][rows, 0] *= -1
    data["pupil"][rows, 0] = SIZE - 1 - data["pupil"][rows, 0]
    data["K"][rows, 0, 2] = SIZE - 1 - data["K"][rows, 0, 2]
    x, y = data["R"][:, :2, 2].unbind(-1)  # of the upward direction, in the picture
    quarters = torch.where(x.abs() > y.abs(), 2 - x.sign(), 1 + y.sign())
    for least in (1, 2, 3):
        rows = quarters >= least
        data["image"][rows] = data["image"][rows].rot90(1, (-2, -1))
        data["shape"][rows, 1:] *= -1
        for key in ("points", "gaze", "camera_gaze"):
            data[key][rows] = quarter(data[key][rows])
        data["R"][rows] = quarter(data["R"][rows].mT).mT
        data["K"][rows, :2, 2] = quarter(data["K"][rows, :2, 2] - (SIZE - 1) / 2) + (SIZE - 1) / 2
        data["K"][rows, :2, :2] = data["K"][rows, :2, :2].flip(-1, -2)
        data["pupil"][rows, :2] = quarter(data["pupil"][rows, :2] - (SIZE - 1) / 2) + (SIZE - 1) / 2
    return data


def quarter(vectors: torch.Tensor) -> torch.Tensor:
    """Turn vectors (..., 2) or (..., 3) by a quarter in the plane of the picture, counter-clockwise on the screen."""
    return torch.stack([vectors[..., 1], -vectors[..., 0], *vectors[..., 2:].unbind(-1)], dim=-1)


def direction(degrees: Floats) -> Floats:
    """Compute unit vectors (n, 3) from azimuth and elevation (n, 2) in degrees."""
    azimuth, elevation = np.radians(degrees).T
    x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    return np.stack([x, y, np.sin(elevation)], axis=-1)


def errors_of(found: dict[str, Floats], data: Arrays) -> dict[str, Floats]:
    """Compute the errors (n,) of each quantity, and those of its mean; nan where the label is unknown."""
    true = {key: data[key].double().numpy() for key in ("gaze_deg", "pupil_mm", "opening", "pupil", "seen")}
    straight = direction(true["gaze_deg"])
    before, after = gaze_errors(found, data)
    return {
        "gaze, deg": before,
        "gaze after nine points, deg": after,
        "  of the mean, deg": angle_deg(straight, np.nanmean(straight, axis=0)),
        "pupil diameter, mm": np.abs(found["pupil_mm"] - true["pupil_mm"])[:, 0],
        "  of the mean, mm": np.abs(true["pupil_mm"] - np.nanmean(true["pupil_mm"]))[:, 0],
        "lid opening, share": np.abs(found["lid_opening"] - true["opening"])[:, 1],
        "  of the mean, share": np.abs(true["opening"] - np.nanmean(true["opening"], axis=0))[:, 1],
        "lid opening, mm": np.abs(found["lid_opening"] - true["opening"])[:, 0],
        "  of the mean, in mm": np.abs(true["opening"] - np.nanmean(true["opening"], axis=0))[:, 0],
        "pupil centre, px": np.linalg.norm(found["pupil_ellipse"][:, :2] - true["pupil"][:, :2], axis=1),
        "wrongly confident or not": ((found["confidence"] > 0.5) != (true["seen"] > 0.5)).astype(float)[:, 0],
    }


def interval(values: Floats, people: NDArray[np.int64]) -> tuple[float, float, float]:
    """Compute the mean of values (n,), and its 95 % interval when the people are drawn anew."""
    rng, known = np.random.default_rng(0), np.isfinite(values)
    each = [values[known & (people == person)] for person in np.unique(people[known])]
    if not each:
        return np.nan, np.nan, np.nan
    sums = np.array([[one.sum(), len(one)] for one in each])
    drawn = sums[rng.integers(len(sums), size=(2000, len(sums)))].sum(axis=1)
    low, high = np.percentile(drawn[:, 0] / drawn[:, 1], (2.5, 97.5))
    return float(values[known].mean()), float(low), float(high)


def report(name: str, networks: list[GazeNetwork], data: Arrays) -> None:
    """Print the mean errors on one folder: the mean over all networks, its interval, and that of each network."""
    each = [errors_of(answers(network, data), data) for network in networks]
    people = data["subject"].numpy()
    print(f"{name}: {len(people)} pictures of {len(np.unique(people))} people, {len(networks)} networks")
    for key in each[0]:
        mean, low, high = interval(np.mean([one[key] for one in each], axis=0), people)
        if np.isnan(mean):
            print(f"  {key:27s} none: no picture has it, or no eye has over {len(GRID)} with a known gaze")
            continue
        seeds = " ".join(f"{interval(one[key], people)[0]:.3f}" for one in each)
        print(f"  {key:27s} {mean:7.3f}  ({low:.3f} to {high:.3f})  each: {seeds}")


def export(network: GazeNetwork, path: Path) -> None:
    """Write the network as an ONNX file that `eyerender bench-extractors --extractor onnx:FILE` takes.

    Raises:
        RuntimeError: the file's outputs differ from the network's by more than 1e-4.
    """
    network = network.to(memory_format=torch.contiguous_format).eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's successor needs another package
        torch.onnx.export(
            network, (torch.rand(1, 1, SIZE, SIZE),), path, dynamo=False, opset_version=17,
            input_names=["image"], output_names=list(NAMES), dynamic_axes={n: {0: "n"} for n in ("image", *NAMES)},
        )  # fmt: skip
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {"eyerender": "network/1", "licence": "MIT"})
    onnx.save(model, path)
    worst = difference(network, path)
    if not worst <= 1e-4:
        raise RuntimeError(f"{path} differs from the network by {worst:.2g}")
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB, outputs within {worst:.1g} of the network's")


def difference(network: GazeNetwork, path: Path) -> float:
    """Compute the largest difference between the outputs of a network and of its ONNX file, over eight pictures."""
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    image = torch.rand(8, 1, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    theirs = session.run(list(NAMES), {"image": image.numpy()})
    with torch.inference_mode():
        mine = network(image)
    return max(float(np.abs(a.numpy() - b).max()) for a, b in zip(mine, theirs, strict=True))


def compare_pictures(networks: list[GazeNetwork], folder: Path, table: list[Label]) -> None:
    """Print how well the pupil is found in labelled pictures, by the source that their names state."""
    scores: dict[str, list[tuple[float, float]]] = {}
    for label in table:
        picture = cv2.imread(str(folder / label.file), cv2.IMREAD_GRAYSCALE)
        if picture is None:
            print(f"{label.file}: cannot be read", file=sys.stderr)
        if picture is None or label.part != "pupil":
            continue
        for network in networks:
            x, y, a, b, angle = pupil_in(network, picture)
            true, mine = (np.zeros(picture.shape, np.uint8) for _ in range(2))
            cv2.ellipse(true, ((label.x, label.y), (2 * label.a, 2 * label.b), label.angle), 1, -1)
            cv2.ellipse(mine, ((x, y), (2 * a, 2 * b), np.degrees(angle)), 1, -1)
            apart = np.hypot(x - label.x, y - label.y) / np.sqrt(label.a * label.b)
            scores.setdefault(label.file.split("__")[0], []).append(
                (apart, float((true & mine).sum() / max((true | mine).sum(), 1)))
            )
    print("pupil in labelled pictures: source, number, median error of the centre in radii, median IoU")
    for source, found in sorted(scores.items()):
        apart, overlap = np.median(np.array(found), axis=0)
        print(f"  {source:16s} {len(found) // len(networks):4d} {apart:7.3f} {overlap:7.3f}")


def pupil_in(network: GazeNetwork, picture: NDArray[np.uint8]) -> Floats:
    """Find the pupil (x, y, a, b, angle) in a grey picture, which is fitted into that of the network."""
    scale = SIZE / max(picture.shape)
    (w, h), canvas = (max(round(n * scale), 1) for n in picture.shape[::-1]), np.zeros((SIZE, SIZE), np.float32)
    left, top = (SIZE - w) // 2, (SIZE - h) // 2
    canvas[top : top + h, left : left + w] = cv2.resize(picture, (w, h), interpolation=cv2.INTER_AREA) / 255
    with torch.inference_mode():
        x, y, a, b, angle = network(torch.from_numpy(canvas)[None, None])[0][0].double().tolist()
    return np.array([(x - left + 0.5) / scale - 0.5, (y - top + 0.5) / scale - 0.5, a / scale, b / scale, angle])


def write_moved(path: Path) -> None:
    """Write the dataset spec of a headset that the network does not know."""
    text = find_dataset("people_two_cameras").read_text(encoding="utf-8")
    for old, new in MOVED.items():
        if old not in text:
            raise RuntimeError(f"the recipe has no {old!r}")
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")


def say(line: str) -> None:
    """Print a line at once."""
    print(line, flush=True)


def main() -> int:
    """Train, test, report and export."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*", help="datasets for training")
    parser.add_argument("--write-moved", type=Path, help="only write the dataset spec of another headset to this file")
    parser.add_argument("--test", type=Path, nargs="*", default=[], help="datasets of other people and rigs")
    parser.add_argument("--onnx", type=Path, help="write the first network to this file")
    parser.add_argument("--seeds", type=int, default=1, help="number of networks, which start from other weights")
    parser.add_argument("--epochs", type=int, default=5, help="passes over all changed pictures")
    parser.add_argument("--copies", type=int, default=12, help="random changes of each picture")
    parser.add_argument("--pictures", type=Path, help="the folder of labelled pictures of your own")
    parser.add_argument("--ellipses", type=Path, help="the table of their labels (CSV)")
    options = parser.parse_args()
    if options.write_moved is not None:
        write_moved(options.write_moved)
        return 0
    if not options.folders:
        refuse("name a dataset for training")
    torch.manual_seed(0)
    start, cpu = time.monotonic(), time.process_time()
    try:
        data = upright(read(options.folders, "train", size=SIZE, augment=AUGMENT, copies=options.copies))
        tests = {folder: upright(read([folder], "test", size=SIZE)) for folder in options.test}
        table = labels(options.ellipses) if options.pictures else []
    except InputError as error:
        refuse(str(error))
    networks = [trained(data, options.epochs, seed, say) for seed in range(options.seeds)]
    print(f"{len(data['image'])} changed pictures; {sum(p.numel() for p in networks[0].parameters())} weights; "
          f"{time.monotonic() - start:.0f} s, {time.process_time() - cpu:.0f} s of processor time")  # fmt: skip
    if options.onnx is not None:
        export(networks[0], options.onnx)
    for folder, own in tests.items():
        report(folder.name, networks, own)
    if table:
        compare_pictures(networks, options.pictures, table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
