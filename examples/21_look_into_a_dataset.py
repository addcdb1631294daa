"""
Looking into a dataset
======================

Before a network is trained on a dataset, somebody should look into it. An inspection says what the dataset contains,
which images are wrong or unusual, and how it differs from another one. ``eyerender inspect`` writes it as a page. See
:doc:`/datasets`.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er
from eyerender.apps.inspection import inspect

COUNT = 40  # small: 12

folder = Path(tempfile.mkdtemp())
er.generate("dataset_quick", folder / "first", count=COUNT, workers=1)
er.generate("dataset_quick", folder / "second", count=COUNT, seed=2, workers=1)

# %%
# One of the pictures is spoilt: an image of another sample takes its place.
names = [entry.name for entry in er.ImageFolder.load(folder / "first")]
(folder / "first" / names[3]).write_bytes((folder / "first" / names[7]).read_bytes())

# %%
# The inspection finds it.
found = inspect(folder / "first", folder / "second", output=folder / "page.html")
for kind, faults in found["datasets"][0]["faults"].items():
    print(f"{kind}: {faults['count']}, for example {faults['images'][0]['image']}: {faults['images'][0]['detail']}")

# %%
# It also compares the distributions of all labels and draws. Here both datasets have the same spec, so their distances
# should be below those of chance.
beyond = [s["column"] for s in found["difference"]["columns"] if s["distance"] > s["chance"]]
print(f"{len(beyond)} of {len(found['difference']['columns'])} numbers differ by more than chance")

figure, axes = plt.subplots(1, 3, figsize=(9, 3))
for ax, name in zip(axes, ("label gaze yaw (deg)", "label pupil radius (px)", "picture mean level"), strict=True):
    for k, dataset in enumerate(found["datasets"]):
        column = dataset["columns"][name]
        edges, counts = np.array(column["edges"]), np.array(column["counts"])
        ax.stairs(counts, edges, label=("first", "second")[k], fill=k == 0, alpha=0.6)
    ax.set(xlabel=name)
axes[0].set(ylabel="images")
axes[0].legend()
figure.tight_layout()
plt.show()
