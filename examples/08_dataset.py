"""
A dataset
=========

A dataset spec says which values are random, and how often they are drawn. The run writes labelled images in shards,
resumes after an interruption, and gives the same images on every machine.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import eyerender as er

COUNT = 12  # small: 2

out = Path(tempfile.mkdtemp()) / "dataset"
er.generate("dataset_region", out, count=COUNT, workers=1)

# %%
# Validation computes labels again from the parameters and compares them with the files.
report = er.validate(out)
print("valid:", report["ok"])

# %%
# The folder is read image by image, so it may hold millions of images.
folder = er.ImageFolder.load(out)
shown = [entry for _, entry in zip(range(12), folder, strict=False)]
figure, axes = plt.subplots(3, 4, figsize=(9, 5.5))
for ax in axes.flat:
    ax.axis("off")
for ax, entry in zip(axes.flat, shown, strict=False):
    ax.imshow(entry.image(), cmap="gray")
    pupil = entry.labels["pupil"]
    ax.set_title(f"pupil visible {pupil['visible_fraction'] or 0:.0%}", fontsize=8)
plt.show()

# %%
# Other tools read the exported formats.
er.export(out, "coco", out.parent / "coco")
print(sorted(p.name for p in (out.parent / "coco").iterdir()))
