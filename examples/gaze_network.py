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
from typing import Any

import cv2
import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from own_labels import Label, labels, refuse
from torch import nn
from torch.nn import functional as F
from torch.utils.data import ConcatDataset, DataLoader

from eyerender.base.errors import InputError
from eyerender.dataset import find_dataset
from eyerender.rig.camera import PinholeCamera
from eyerender.torch import Augment, FolderDataset

SIZE = 128  # width and height of the pictures that the network sees, px
MAPS = 12  # heat maps, of which the first are those of POINTS
POINTS = ("pupil", "iris", "outer corner", "upper lid", "inner corner", "lower lid")
NAMES = ("pupil_ellipse", "confidence", "gaze", "pupil_mm", "lid_opening")
PARTS = ("image", "pupil", "iris", "lids", "gaze", "gaze_deg", "centres_mm", "pupil_mm", "lid_opening", "camera")
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
GRID = np.array([(x, y) for y in (-15, 0, 15) for x in (-20, 0, 20)], dtype=float)  # of the calibration, deg
Arrays = dict[str, torch.Tensor]
Floats = NDArray[np.float64]


def convolution(inputs: int, outputs: int, size: int = 3, stride: int = 1) -> nn.Module:
    """Create a convolution with a normalisation of its batch."""
    layer = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)
    return nn.Sequential(layer, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class GazeNetwork(nn.Module):
    """Heat maps of points of the eye, and what is read where they are.

    The input is (n, 1, SIZE, SIZE), the levels of a picture as shares of the full scale. The outputs are those of
    NAMES: the ellipse (n, 5) as x, y, a, b in px and the angle of a in rad from +x towards +y; the probability
    (n, 1) that at least a tenth of the pupil shows; the line of sight (n, 3), a unit vector in the frame of a camera
    that is turned to the pupil; the entrance pupil's diameter (n, 1), mm; the opening of the lids (n, 2), in mm and as
    a share of that at rest. `points` gives the places of the heat maps (n, MAPS, 2), from -1 to 1.
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Sequential(convolution(1, 16, 5, 2), convolution(16, 24, 3, 2), convolution(24, 32))
        self.second = convolution(32, 48, 3, 2)
        self.third = nn.Sequential(convolution(48, 48, 3, 2), convolution(48, 48))
        self.across = nn.ModuleList(nn.Conv2d(width, 32, 1) for width in (32, 48, 48))
        self.joined = convolution(32, 32)
        self.maps = nn.Conv2d(32, MAPS, 1)
        self.last = nn.Sequential(nn.Linear(2 * MAPS + 3 * 32 + 48, 64), nn.ReLU(inplace=True), nn.Linear(64, 11))
        self.last[2].bias.data = torch.tensor([2.0, 0, 0, 0, 0, -1, 0, 4, 9, 1, 3])  # an eye as most are
        axis = (torch.arange(SIZE // 4) + 0.5) * 8 / SIZE - 1
        self.register_buffer("grid", torch.stack([axis.repeat(SIZE // 4), axis.repeat_interleave(SIZE // 4)], dim=-1))

    def read(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the places of the heat maps (n, MAPS, 2), and the 11 numbers of the last layer."""
        fine = self.first((image - 0.4) / 0.25)
        middle = self.second(fine)
        coarse = self.third(middle)
        up = F.interpolate(self.across[2](coarse), scale_factor=2.0) + self.across[1](middle)
        merged = self.joined(F.interpolate(up, scale_factor=2.0) + self.across[0](fine))
        weights = self.maps(merged).flatten(2).softmax(-1)
        points = weights @ self.grid
        local = weights[:, :3] @ merged.flatten(2).transpose(1, 2)  # what is at the pupil, at the iris and elsewhere
        beside = points[:, 1:] - points[:, :1]
        seen = [points[:, :1].flatten(1), beside.flatten(1), local.flatten(1), coarse.mean((2, 3))]
        return points, self.last(torch.cat(seen, dim=1))

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Compute what NAMES lists."""
        points, found = self.read(image)
        centre = (points[:, 0] + 1) * SIZE / 2 - 0.5
        mean, even, odd = found[:, 0:1], found[:, 1:2], found[:, 2:3]
        spread = (even**2 + odd**2 + 1e-9).sqrt()
        angle = torch.atan(odd / (spread + even + 1e-9))  # half of that of (even, odd)
        ellipse = torch.cat([centre, (mean + spread).exp(), (mean - spread).exp(), angle], dim=1)
        gaze = found[:, 3:6] / (found[:, 3:6] ** 2).sum(1, keepdim=True).sqrt()
        return ellipse, found[:, 6:7].sigmoid(), gaze, found[:, 7:8], found[:, 8:10]


def turned(vectors: torch.Tensor, rays: torch.Tensor, back: bool = False) -> torch.Tensor:
    """Turn vectors (n, 3) by the smallest rotations that bring rays (n, 3), unit vectors, to the camera's axis.

    With `back`, turn the vectors by the opposite rotations.
    """
    x, y, z = rays.unbind(-1)
    axis = torch.stack([y, -x, torch.zeros_like(x)], dim=-1) * (-1 if back else 1)
    once = torch.linalg.cross(axis, vectors)
    return vectors + once + torch.linalg.cross(axis, once) / (1 + z)[:, None]


def read(folders: list[Path], split: str, augment: Augment | None = None, copies: int = 1) -> Arrays:
    """Read pictures with their labels, each `copies` times with other random changes; pictures are stored as bytes."""
    options: dict[str, Any] = {"parts": PARTS, "size": (SIZE, SIZE), "mirror_left": True, "augment": augment}
    data: Any = ConcatDataset([FolderDataset(folder, split=split, **options) for folder in folders])
    loader: DataLoader[Any] = DataLoader(data, batch_size=64)
    return joined([upright(with_targets(batch)) for _ in range(copies) for batch in loader])


def joined(batches: list[Arrays]) -> Arrays:
    """Join batches."""
    return {key: torch.cat([batch[key] for batch in batches]) for key in batches[0]}


def with_targets(batch: dict[str, Any]) -> Arrays:
    """Bring the labels of a batch to the form that the network gives them; unknown ones are nan."""
    valid, camera = batch["valid"], batch["camera"]
    marks = batch["lids"][:, [0, 0, 0, 1], [0, 8, 16, 8]]
    known = valid["lids"][:, [0, 0, 0, 1], [0, 8, 16, 8]]
    points = torch.cat([batch["pupil"][:, None, :2], batch["iris"][:, None, :2], marks], dim=1)
    known = torch.cat([valid["pupil"][:, None], valid["iris"][:, None], known], dim=1)
    seen, (a, b, angle) = valid["pupil"], batch["pupil"][:, 2:].unbind(-1)
    mean, spread = (a * b).log() / 2, (a / b).log() / 2
    shape = torch.stack([mean, spread * (2 * angle).cos(), spread * (2 * angle).sin()], dim=-1)
    rays = F.normalize(batch["centres_mm"][:, 2], dim=-1)

    def masked(values: torch.Tensor, flags: torch.Tensor) -> torch.Tensor:
        return values.float().where(flags.reshape(*flags.shape, *[1] * (values.ndim - flags.ndim)), torch.nan)

    return {
        "image": (batch["image"] * 255).round().byte(),
        "points": masked((points + 0.5) * 2 / SIZE - 1, known & (points.abs() < 2 * SIZE).all(-1)),
        "pupil": masked(batch["pupil"], seen),
        "shape": masked(shape, seen),
        "iris": masked(batch["iris"][:, 2:3].log(), valid["iris"][:, None]),
        "gaze": masked(turned(batch["gaze"], rays), valid["gaze"]),
        "camera_gaze": masked(batch["gaze"], valid["gaze"]),
        "gaze_deg": masked(batch["gaze_deg"], valid["gaze"]),
        "pupil_mm": masked(batch["pupil_mm"][:, :1], valid["pupil_mm"][:, :1]),
        "opening": masked(batch["lid_opening"], valid["lid_opening"]),
        "seen": seen.float()[:, None],
        "subject": batch["subject"],
        "left": batch["mirrored"],
        **{key: camera[key] for key in ("K", "R", "distortion", "fisheye", "mirrored")},
    }


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


def loss_of(network: GazeNetwork, batch: Arrays) -> torch.Tensor:
    """Sum the mean errors of all outputs over the labels that are known."""
    points, found = network.read(batch["image"].float() / 255)

    def error(mine: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
        known = true.isfinite()
        return ((mine - true.nan_to_num()).abs() * known).sum() / known.sum().clamp(min=1)

    gaze = F.normalize(found[:, 3:6], dim=-1)
    apart = (gaze - batch["gaze"].nan_to_num()).norm(dim=-1)[batch["gaze"][:, 0].isfinite()].mean().nan_to_num()
    return (
        4 * error(points[:, : len(POINTS)], batch["points"])
        + 4 * error(points[:, :1], batch["points"][:, :1])
        + 2 * error(found[:, :3], batch["shape"])
        + 4 * apart
        + error(found[:, 7:8], batch["pupil_mm"])
        + 0.1 * error(found[:, 8:9], batch["opening"][:, :1])
        + error(found[:, 9:10], batch["opening"][:, 1:])
        + error(found[:, 10:11], batch["iris"])  # gives the scale, and is no output
        + 0.2 * F.binary_cross_entropy_with_logits(found[:, 6:7], batch["seen"])
    )


def trained(data: Arrays, epochs: int, seed: int) -> GazeNetwork:
    """Train a network on pictures and labels."""
    torch.manual_seed(seed)
    network = GazeNetwork().to(memory_format=torch.channels_last)
    count, batch = len(data["image"]), 48
    optimiser = torch.optim.AdamW(network.parameters(), lr=4e-3, weight_decay=0.02)
    steps = epochs * max(count // batch, 1)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 4e-3, total_steps=steps)
    for epoch in range(epochs):
        network.train()
        total, parts = 0.0, torch.randperm(count).split(batch)[: max(count // batch, 1)]
        for rows in parts:
            loss = loss_of(network, {key: values[rows] for key, values in data.items()})
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 2.0)
            optimiser.step()
            schedule.step()
            total += loss.item()
        print(f"seed {seed}, epoch {epoch + 1:2d} of {epochs}: loss {total / len(parts):.4f}", flush=True)
    return network.eval()


def answers(network: nn.Module, data: Arrays) -> dict[str, Floats]:
    """Run a network on pictures: the outputs by name, and the line of sight in the camera's frame."""
    with torch.inference_mode():
        parts = [network(image.float() / 255) for image in data["image"].split(64)]
        found = dict(zip(NAMES, (torch.cat(part) for part in zip(*parts, strict=True)), strict=True))
        rays = rays_of(data, found["pupil_ellipse"][:, :2])
        found["camera_gaze"] = turned(found["gaze"], rays, back=True)
    return {name: values.double().numpy() for name, values in found.items()}


def rays_of(data: Arrays, pixels: torch.Tensor) -> torch.Tensor:
    """Compute unit vectors (n, 3) from cameras through pixels (n, 2) of their pictures, in the cameras' frames."""
    out = []
    for K, k, fisheye, pixel in zip(data["K"], data["distortion"], data["fisheye"], pixels, strict=True):
        camera = PinholeCamera.of(K, np.eye(3), np.zeros(3), (1, 1), k.numpy()[: 6 if fisheye else 8])
        out.append(camera.rays(pixel.double().numpy()))
    return torch.from_numpy(np.array(out)).float()


def angle_deg(a: Floats, b: Floats) -> Floats:
    """Compute the angles between vectors (..., 3), of which those of `a` have the length 1."""
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=-1) / 2, 0, 1)))


def direction(degrees: Floats) -> Floats:
    """Compute unit vectors (n, 3) from azimuth and elevation (n, 2) in degrees."""
    azimuth, elevation = np.radians(degrees).T
    x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    return np.stack([x, y, np.sin(elevation)], axis=-1)


def calibrated(found: Floats, true: Floats, rows: NDArray[np.int64]) -> Floats:
    """Correct directions (n, 3) of one eye by an affine map of angles, fitted to some rows.

    The map is drawn to a mere offset, as if each of four points more confirmed that angles need no stretching.
    """
    middle = true[rows].mean(axis=0)
    frame = np.linalg.svd(np.outer(middle, middle))[0]  # its first axis is the middle, or its opposite
    frame[:, 0] = middle / np.linalg.norm(middle)
    mine, theirs = (vectors @ frame[:, 1:] for vectors in (found, true))
    about, most = mine[rows].mean(axis=0), 4 * 0.25**2
    own = mine[rows] - about
    wanted = theirs[rows] - theirs[rows].mean(axis=0) - own
    stretch = np.linalg.solve(own.T @ own + most * np.eye(2), own.T @ wanted)
    flat = (mine - about) @ (np.eye(2) + stretch) + theirs[rows].mean(axis=0)
    ahead = np.sqrt(np.clip(1 - (flat**2).sum(axis=1), 0, None))
    out = flat @ frame[:, 1:].T + ahead[:, None] * frame[:, 0]
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def nine(degrees: Floats) -> NDArray[np.int64]:
    """Choose the rows of azimuth and elevation (n, 2) nearest to the points of GRID; none if they are too few."""
    left, chosen = np.flatnonzero(np.isfinite(degrees[:, 0])), []
    for point in GRID if len(left) > len(GRID) else ():
        chosen.append(left[np.argmin(((degrees[left] - point) ** 2).sum(axis=1))])
        left = left[left != chosen[-1]]
    return np.array(chosen, dtype=int)


def gaze_errors(found: dict[str, Floats], data: Arrays) -> tuple[Floats, Floats]:
    """Compute the errors (n,) of the line of sight in degrees, before and after the calibration of each eye.

    They are nan where the gaze is unknown, and for the frames of the calibration.
    """
    mine, true, degrees = found["camera_gaze"], *(data[key].double().numpy() for key in ("camera_gaze", "gaze_deg"))
    before, after = (np.full(len(true), np.nan) for _ in range(2))
    eyes = 2 * data["subject"] + data["left"]
    for eye in eyes.unique():
        rows = np.flatnonzero(eyes == eye)
        used = nine(degrees[rows])
        rest = np.setdiff1d(np.arange(len(rows)), used)
        before[rows[rest]] = angle_deg(mine[rows], true[rows])[rest]
        if len(used):
            after[rows[rest]] = angle_deg(calibrated(mine[rows], true[rows], used), true[rows])[rest]
    return before, after


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
        data = read(options.folders, "train", AUGMENT, options.copies)
        tests = {folder: read([folder], "test") for folder in options.test}
        table = labels(options.ellipses) if options.pictures else []
    except InputError as error:
        refuse(str(error))
    networks = [trained(data, options.epochs, seed) for seed in range(options.seeds)]
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
