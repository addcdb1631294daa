#!/usr/bin/env python3
"""
Training a network
==================

This script trains a small U-Net to find the pupil and the iris in rendered eyes, and tests it on subjects that it has
not seen::

    eyerender generate dataset_region out/region
    python examples/train_segmentation.py out/region

The network is trained on the split `train` and tested on `test`, whose subjects are others. The script prints the mean
intersection over union (IoU) of each part, and its exit code is 1 if that of the pupil or the iris is below .9. It
needs PyTorch (the extra `torch`). A processor with two cores takes a few minutes.
"""

from __future__ import annotations

import argparse
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F
from torch.utils.data import DataLoader

from eyerender.torch import Augment, FolderDataset

PARTS = ("background", "sclera", "iris", "pupil", "frame")
MUST = 0.9
SIZE = (256, 160)  # of the pictures in training
AUGMENT = Augment(
    crop=(0.6, 0.8),
    shift=0.0,
    scale=(0.9, 1.1),
    roll_deg=5.0,
    exposure=(0.45, 1.8),
    gamma=(1.0, 1.0),
    erase=0,
    blur_px=(0.0, 0.0),
    noise=(0.0, 0.0),
    compression=0.0,
)


def seen(item: dict[str, Any]) -> dict[str, Any]:
    """Replace linear counts, of which a pupil has about 1 %, by a picture with a gamma of 2.2."""
    return {**item, "image": item["image"] ** (1 / 2.2)}


def block(inputs: int, outputs: int) -> nn.Module:
    """Two convolutions."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
        nn.Conv2d(outputs, outputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class UNet(nn.Module):
    """A U-Net (Ronneberger, Fischer and Brox 2015) that works at half the resolution of its input.

    The input is (n, 1, h, w), the output (n, 4, h, w); h and w must be multiples of 16.
    """

    def __init__(self, width: int = 12, levels: int = 4) -> None:
        super().__init__()
        widths = [width * 2**k for k in range(levels)]
        self.first = nn.Conv2d(1, width, 4, stride=2, padding=1)
        self.down = nn.ModuleList(block(a, b) for a, b in zip([width, *widths], widths, strict=False))
        self.up = nn.ModuleList(nn.ConvTranspose2d(b, a, 2, stride=2) for a, b in pairwise(widths))
        self.join = nn.ModuleList(block(2 * a, a) for a in widths[:-1])
        self.last = nn.ConvTranspose2d(width, len(PARTS), 2, stride=2)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Compute the logits of the parts at each pixel."""
        x, kept = self.first((image - 0.6) / 0.25), []
        for k, down in enumerate(self.down):
            x = down(F.max_pool2d(x, 2) if k else x)
            kept.append(x)
        for up, join, skip in reversed(list(zip(self.up, self.join, kept, strict=False))):
            x = join(torch.cat([up(x), skip], dim=1))
        found: torch.Tensor = self.last(x)
        return found


def loss_of(logits: torch.Tensor, masks: torch.Tensor) -> torch.Tensor:
    """Cross entropy plus soft Dice loss, which gives small parts the weight of large ones."""
    found, true = logits.softmax(1), F.one_hot(masks, len(PARTS)).movedim(-1, 1)
    both, all_ = (found * true).sum((0, 2, 3)), (found + true).sum((0, 2, 3))
    return F.cross_entropy(logits, masks) + 1 - ((2 * both + 1) / (all_ + 1)).mean()


def train(network: nn.Module, loader: DataLoader[Any], epochs: int, rate: float = 4e-3) -> None:
    """Train a network on batches, and print its loss after each epoch."""
    optimiser = torch.optim.AdamW(network.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=epochs * len(loader))
    for epoch in range(epochs):
        network.train()
        total = 0.0
        for batch in loader:
            loss = loss_of(network(batch["image"]), batch["mask"])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            total += loss.item()
        print(f"epoch {epoch + 1:2d} of {epochs}: loss {total / len(loader):.4f}", flush=True)


def mean_iou(network: nn.Module, loader: DataLoader[Any]) -> torch.Tensor:
    """Mean over the images of the intersection over union of each part, (4,); images without a part do not count."""
    network.eval()
    rows = []
    for batch in loader:
        with torch.inference_mode():
            found = network(batch["image"]).argmax(1)
        for mine, mask in zip(found, batch["mask"], strict=True):
            both = torch.stack([((mine == k) & (mask == k)).sum() for k in range(len(PARTS))])
            either = torch.stack([((mine == k) | (mask == k)).sum() for k in range(len(PARTS))])
            rows.append(torch.where(either > 0, both / either, torch.nan))
    return torch.stack(rows).nanmean(dim=0)


def main() -> int:
    """Train, test and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a dataset with the splits train and test")
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("--workers", type=int, default=0, help="processes that read the images")
    parser.add_argument("--save", type=Path, help="write the trained weights to this file")
    options = parser.parse_args()
    torch.manual_seed(0)
    start = time.monotonic()
    changes = {"train": {"size": SIZE, "augment": AUGMENT}, "test": {}}
    loaders = {
        split: DataLoader(
            FolderDataset(options.folder, split=split, transform=seen, **how),
            batch_size=4,
            shuffle=split == "train",
            num_workers=options.workers,
        )
        for split, how in changes.items()
    }
    network = UNet()
    train(network, loaders["train"], options.epochs)
    iou = mean_iou(network, loaders["test"])
    print(f"{len(loaders['train'].dataset)} images for training, {time.monotonic() - start:.0f} s")
    shown = [f"{n} {v:.3f}" for n, v in zip(PARTS, iou.tolist(), strict=True) if v == v]  # nan: in no image
    print("mean IoU of unseen subjects: " + ", ".join(shown))
    if options.save is not None:
        torch.save(network.state_dict(), options.save)
    short = [n for n, v in zip(PARTS[2:4], iou[2:4].tolist(), strict=True) if not v >= MUST]
    if short:
        print(f"below {MUST}: {', '.join(short)}; more images or epochs help (--epochs)", file=sys.stderr)
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
