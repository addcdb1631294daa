"""
A run on several machines
=========================

Every sample is a function of the spec and its number, so machines need not exchange anything. Each makes a part of the
shards in the same folder, and the last one assembles the dataset. On a cluster, ``scripts/tools/slurm_generate.sh``
starts ``eyerender generate SPEC DIR --shard K/N`` in each task of an array job.
"""

import hashlib
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import eyerender as er

COUNT = 8  # small: 2

folder = Path(tempfile.mkdtemp())


def digest(path):
    """A checksum of every image of a dataset."""
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted((path / "images").rglob("*.png"))}


# %%
# Two machines make half of the shards each, and one machine makes them all. The images are the same, byte for byte.
for part in (1, 2):
    er.generate("dataset_quick", folder / "parts", count=COUNT, workers=1, part=(part, 2))
er.generate("dataset_quick", folder / "whole", count=COUNT, workers=1)
print("the same images:", digest(folder / "parts") == digest(folder / "whole"))

# %%
image = next(iter(er.ImageFolder.load(folder / "parts"))).image()
plt.imshow(image, cmap="gray")
plt.axis("off")
plt.show()
