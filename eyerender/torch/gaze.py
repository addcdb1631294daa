"""A small network for gaze: its layers, what it learns from a folder, its training, and its errors.

`examples/gaze_network.py` trains it for any headset and writes it as an ONNX file; the study of appearance trains it on
the pictures of each eye model. Left eyes are mirrored, so that all pictures show right eyes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F
from torch.utils.data import ConcatDataset, DataLoader

from ..base.arrays import Floats, Ints
from ..base.progress import Say
from ..rig.camera import PinholeCamera
from . import Augment, FolderDataset

MAPS = 12  # heat maps, of which the first are those of POINTS
POINTS = ("pupil", "iris", "outer corner", "upper lid", "inner corner", "lower lid")
NAMES = ("pupil_ellipse", "confidence", "gaze", "pupil_mm", "lid_opening")
PARTS = ("image", "pupil", "iris", "lids", "gaze", "gaze_deg", "centres_mm", "pupil_mm", "lid_opening", "camera")
GRID = np.array([(x, y) for y in (-15, 0, 15) for x in (-20, 0, 20)], dtype=float)  # of the calibration, deg
Arrays = dict[str, torch.Tensor]


def convolution(inputs: int, outputs: int, size: int = 3, stride: int = 1) -> nn.Module:
    """Create a convolution with a normalisation of its batch."""
    layer = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)
    return nn.Sequential(layer, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class GazeNetwork(nn.Module):
    """Heat maps of points of the eye, and what is read where they are.

    The input is (n, 1, size, size), the levels of a picture as shares of the full scale. The outputs are those of
    NAMES: the ellipse (n, 5) as x, y, a, b in px and the angle of a in rad from +x towards +y; the probability
    (n, 1) that at least a tenth of the pupil shows; the line of sight (n, 3), a unit vector in the frame of a camera
    that is turned to the pupil; the entrance pupil's diameter (n, 1), mm; the opening of the lids (n, 2), in mm and as
    a share of that at rest. `points` gives the places of the heat maps (n, MAPS, 2), from -1 to 1.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self.size = size  # a multiple of 16, px
        self.first = nn.Sequential(convolution(1, 16, 5, 2), convolution(16, 24, 3, 2), convolution(24, 32))
        self.second = convolution(32, 48, 3, 2)
        self.third = nn.Sequential(convolution(48, 48, 3, 2), convolution(48, 48))
        self.across = nn.ModuleList(nn.Conv2d(width, 32, 1) for width in (32, 48, 48))
        self.joined = convolution(32, 32)
        self.maps = nn.Conv2d(32, MAPS, 1)
        self.last = nn.Sequential(nn.Linear(2 * MAPS + 3 * 32 + 48, 64), nn.ReLU(inplace=True), nn.Linear(64, 11))
        self.last[2].bias.data = torch.tensor([2.0, 0, 0, 0, 0, -1, 0, 4, 9, 1, 3])  # an eye as most are
        axis = (torch.arange(size // 4) + 0.5) * 8 / size - 1
        self.register_buffer("grid", torch.stack([axis.repeat(size // 4), axis.repeat_interleave(size // 4)], dim=-1))

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
        centre = (points[:, 0] + 1) * self.size / 2 - 0.5
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


def read(folders: Sequence[Path], split: str, *, size: int, augment: Augment | None = None, copies: int = 1) -> Arrays:
    """Read pictures with their labels, each `copies` times with other random changes; pictures are stored as bytes."""
    options: dict[str, Any] = {"parts": PARTS, "size": (size, size), "mirror_left": True, "augment": augment}
    data: Any = ConcatDataset([FolderDataset(folder, split=split, **options) for folder in folders])
    loader: DataLoader[Any] = DataLoader(data, batch_size=64)
    return joined([with_targets(batch) for _ in range(copies) for batch in loader])


def joined(batches: Sequence[Arrays]) -> Arrays:
    """Join batches."""
    return {key: torch.cat([batch[key] for batch in batches]) for key in batches[0]}


def with_targets(batch: dict[str, Any]) -> Arrays:
    """Bring the labels of a batch to the form that the network gives them; unknown ones are nan."""
    valid, camera, size = batch["valid"], batch["camera"], batch["image"].shape[-1]
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
        "points": masked((points + 0.5) * 2 / size - 1, known & (points.abs() < 2 * size).all(-1)),
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


def trained(data: Arrays, epochs: int, seed: int, say: Say | None = None) -> GazeNetwork:
    """Train a network on pictures and labels; its first weights and the order of the pictures follow from the seed."""
    torch.manual_seed(seed)
    network: GazeNetwork = GazeNetwork(data["image"].shape[-1]).to(memory_format=torch.channels_last)
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
        if say is not None:
            say(f"seed {seed}, epoch {epoch + 1:2d} of {epochs}: loss {total / len(parts):.4f}")
    network.eval()
    return network


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
    half = np.linalg.norm(a - b, axis=-1) / 2
    return np.asarray(np.degrees(2 * np.arcsin(np.clip(half, 0, 1))))


def calibrated(found: Floats, true: Floats, rows: Ints) -> Floats:
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
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def nine(degrees: Floats) -> Ints:
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
