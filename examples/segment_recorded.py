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

from eyerender.torch import Augment, FolderDataset

WIDTH, HEIGHT = 192, 144
AUGMENT = Augment(
    scale=(0.55, 1.65),
    shift=0.2,
    roll_deg=17.0,
    exposure=(0.6, 2.6),
    gamma=(0.35, 1.1),
    erase_size=(0.05, 0.5),
    blur_px=(0.0, 1.7),
    noise=(0.0, 0.04),
)
COLOURS = {1: (255, 120, 0), 2: (0, 220, 0), 3: (0, 0, 255)}  # sclera, iris, pupil; blue first


def levelled(image: torch.Tensor) -> torch.Tensor:
    """Bring the 2nd and the 70th percentile of an image's levels to .35 and .75, whatever shines beside the eye."""
    low, high = torch.quantile(image.flatten()[::7], torch.tensor([0.02, 0.7])).tolist()
    return (0.35 + 0.4 * (image - low) / (high - low + 1e-3)).clamp(0.2, 1.4)


def placed(
    picture: torch.Tensor, scale: float, turn: float, shift: torch.Tensor, mode: str, canvas: tuple[int, int]
) -> torch.Tensor:
    """Put a picture (1, h, w) on a canvas (height, width), scaled, turned (rad) and moved; what lies beside it is 0."""
    (h, w), (height, width) = picture.shape[-2:], canvas
    if scale < 1 and mode == "bilinear":  # no finer detail than the canvas shows
        size = (round(h * scale), round(w * scale))
        picture = F.interpolate(picture[None], size, mode="bilinear", antialias=True, align_corners=False)[0]
        h, w, scale = *size, 1.0
    cos, sin = np.cos(turn) / scale, np.sin(turn) / scale
    matrix = torch.tensor([[cos * width / w, -sin * height / w, 0], [sin * width / h, cos * height / h, 0]])
    matrix[:, 2] = shift
    grid = F.affine_grid(matrix[None].float(), [1, 1, height, width], align_corners=False)
    return F.grid_sample(picture[None], grid, mode=mode, align_corners=False)[0]


def fit(picture: torch.Tensor) -> tuple[float, tuple[int, int]]:
    """Compute the scale at which a canvas shows a whole picture (1, h, w); the canvas is upright if the picture is."""
    h, w = picture.shape[-2:]
    canvas = (WIDTH, HEIGHT) if h > w else (HEIGHT, WIDTH)
    return min(canvas[0] / h, canvas[1] / w), canvas


def blurred(image: torch.Tensor, sigma: float) -> torch.Tensor:
    """Blur an image (1, h, w) with a Gaussian of a standard deviation in px."""
    k = torch.exp(-0.5 * (torch.arange(-6, 7) / sigma) ** 2)
    return F.conv2d(image[None], torch.outer(k, k)[None, None] / k.sum() ** 2, padding=6)[0]


def between(low: float, high: float) -> float:
    """Draw an even random number."""
    return float(torch.empty(()).uniform_(low, high))


def sharpened(image: torch.Tensor) -> torch.Tensor:
    """Sharpen some images (1, h, w) with an unsharp mask, as some cameras do, and change brightness and contrast."""
    if between(0, 1) < 0.3:
        image = (image + between(0, 3) * (image - blurred(image, between(0.6, 1.5)))).clamp(0, 1)
    return levelled(image) * between(0.85, 1.15) + between(-0.08, 0.08)


def varied(item: dict[str, Any]) -> dict[str, Any]:
    """Change the place, the scale and the exposure of an image at random, and cover a part of some images."""
    changed = AUGMENT(item, (WIDTH, HEIGHT))
    return {**changed, "image": sharpened(changed["image"])}


def shrunk(item: dict[str, Any]) -> dict[str, Any]:
    """Bring an image and its mask to 1.5 times the width and height of a canvas of the same area."""
    h, w = item["mask"].shape
    factor = 1.5 * float(np.sqrt(WIDTH * HEIGHT / (h * w)))
    size = (round(factor * h), round(factor * w))
    image = F.interpolate(item["image"][None], size, mode="bilinear", antialias=True, align_corners=False)[0]
    return {
        "image": image,
        "mask": F.interpolate(item["mask"][None, None].float(), size, mode="nearest-exact")[0, 0].to(torch.uint8),
    }


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
    train(network, loader, epochs, rate=3e-3)
    return network.eval()


def outlined(network: UNet, recorded: np.ndarray) -> np.ndarray:
    """Draw the outlines of the parts that a network finds into a grey picture (h, w) of 8 bits."""
    picture = torch.from_numpy(recorded).float()[None] / 255
    scale, size = fit(picture)
    canvas = placed(picture, scale, 0.0, torch.zeros(2), "bilinear", size)
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
