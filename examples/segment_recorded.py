#!/usr/bin/env python3
"""
Training for recorded images
============================

A network that is to see recorded eyes must not learn what is the same in all rendered ones: scale, brightness, blur and
noise. This script trains the U-Net of ``train_segmentation.py`` on one or more datasets, changes these at random, and
outlines sclera, iris and pupil in images of your own::

    eyerender generate people_pupil_core out/core
    eyerender generate people_nvgaze out/nvgaze
    python examples/segment_recorded.py out/core out/nvgaze --apply recorded/ --overlays out/overlays

It needs PyTorch (the extra ``torch``). Pictures are brought to 192 x 144 px.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch.nn import functional as F
from torch.utils.data import ConcatDataset, DataLoader, default_collate
from train_segmentation import PARTS, UNet, train

from eyerender.torch import FolderDataset

WIDTH, HEIGHT = 192, 144
COLOURS = {1: (255, 120, 0), 2: (0, 220, 0), 3: (0, 0, 255)}  # sclera, iris, pupil; blue first


def levelled(image: torch.Tensor) -> torch.Tensor:
    """Bring the 2nd and the 70th percentile of an image's levels to .35 and .75, whatever shines beside the eye."""
    low, high = torch.quantile(image.flatten()[::7], torch.tensor([0.02, 0.7])).tolist()
    return (0.35 + 0.4 * (image - low) / (high - low + 1e-3)).clamp(0.2, 1.4)


def placed(picture: torch.Tensor, turn: float, zoom: float, shift: torch.Tensor, mode: str) -> torch.Tensor:
    """Put a picture (1, h, w) on a canvas, turned (rad), zoomed and moved; what lies beside it is 0."""
    h, w = picture.shape[-2:]
    scale = zoom * min(WIDTH / w, HEIGHT / h)
    if scale < 1 and mode == "bilinear":  # no finer detail than the canvas shows
        size = (round(h * scale), round(w * scale))
        picture = F.interpolate(picture[None], size, mode="bilinear", antialias=True, align_corners=False)[0]
        h, w, scale = *size, 1.0
    cos, sin = np.cos(turn) / scale, np.sin(turn) / scale
    matrix = torch.tensor([[cos * WIDTH / w, -sin * HEIGHT / w, 0], [sin * WIDTH / h, cos * HEIGHT / h, 0]])
    matrix[:, 2] = shift
    grid = F.affine_grid(matrix[None].float(), [1, 1, HEIGHT, WIDTH], align_corners=False)
    return F.grid_sample(picture[None], grid, mode=mode, align_corners=False)[0]


def varied(item: dict[str, Any]) -> dict[str, Any]:
    """Change the place, the scale, the brightness, the contrast, the blur and the noise of an image at random."""
    turn, zoom = 0.17 * float(torch.randn(())), float(torch.exp(torch.empty(()).uniform_(-0.5, 0.5)))
    shift = torch.empty(2).uniform_(-0.4, 0.4)
    image = placed(item["image"], turn, zoom, shift, "bilinear")
    mask = placed(item["mask"][None].float(), turn, zoom, shift, "nearest")[0].long()
    if torch.rand(()) < 0.5:
        image, mask = image.flip(-1), mask.flip(-1)
    gamma, gain, sigma, noise = (torch.empty(4).uniform_(0, 1) * torch.tensor([0.5, 2, 2, 0.04])).tolist()
    image = (image ** (0.3 + gamma) * (0.6 + gain)).clamp(0, 1)
    if sigma > 1:
        k = torch.exp(-0.5 * (torch.arange(-6, 7) / (sigma - 0.5)) ** 2)
        image = F.conv2d(image[None], torch.outer(k, k)[None, None] / k.sum() ** 2, padding=6)[0]
    return {"image": levelled(image + noise * torch.randn_like(image)), "mask": mask}


def shrunk(item: dict[str, Any]) -> dict[str, Any]:
    """Bring an image and its mask to 1.5 times the width of the canvas."""
    size = (round(item["mask"].shape[0] * 1.5 * WIDTH / item["mask"].shape[1]), round(1.5 * WIDTH))
    image = F.interpolate(item["image"][None], size, mode="bilinear", antialias=True, align_corners=False)[0]
    return {"image": image, "mask": F.interpolate(item["mask"][None, None].float(), size)[0, 0].to(torch.uint8)}


def trained(folders: list[Path], epochs: int) -> UNet:
    """Train a network on all images of the folders."""
    read = ConcatDataset([FolderDataset(folder, parts=("image", "mask"), transform=shrunk) for folder in folders])
    loader = DataLoader(
        [read[k] for k in range(len(read))],
        batch_size=12,
        shuffle=True,
        drop_last=True,
        collate_fn=lambda batch: default_collate([varied(item) for item in batch]),
    )
    network = UNet()
    train(network, loader, epochs, change=None, rate=3e-3)  # the items are changed one by one
    return network.eval()


def outlined(network: UNet, recorded: np.ndarray) -> np.ndarray:
    """Draw the outlines of the parts that a network finds into a grey picture (h, w) of 8 bits."""
    picture = torch.from_numpy(recorded).float()[None] / 255
    canvas = placed(picture, 0.0, 1.0, torch.zeros(2), "bilinear")
    with torch.inference_mode():
        found = network(levelled(canvas)[None])[0].argmax(0).numpy()
    shown = cv2.cvtColor((canvas[0].numpy() * 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    shown = cv2.resize(shown, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    for part, colour in COLOURS.items():
        mask = cv2.resize((found == part).astype(np.uint8), None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST)
        cv2.drawContours(shown, cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0], -1, colour, 1)
    return shown


def main() -> int:
    """Train, and outline the parts of recorded images."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="datasets with masks")
    parser.add_argument("--epochs", type=int, default=60)
    parser.add_argument("--apply", type=Path, required=True, help="a folder of recorded PNG or JPEG images")
    parser.add_argument("--overlays", type=Path, required=True, help="the folder for the pictures with outlines")
    options = parser.parse_args()
    torch.manual_seed(0)
    network = trained(options.folders, options.epochs)
    options.overlays.mkdir(parents=True, exist_ok=True)
    for file in sorted(f for f in options.apply.iterdir() if f.suffix.lower() in (".png", ".jpg", ".jpeg")):
        recorded = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if recorded is None:
            print(f"{file}: cannot be read", file=sys.stderr)
            continue
        cv2.imwrite(str(options.overlays / f"{file.stem}.png"), outlined(network, recorded))
    print(f"outlines of {', '.join(PARTS[1:4])}: {options.overlays}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
