"""
Scenes of your own code
=======================

A dataset spec draws independent values. Where that is not enough, a function gives the scene of each sample, or a loop
hands over one scene after the other. Both get shards, labels, checks and resuming. See :doc:`/datasets`.
"""

import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

COUNT = 24  # small: 4

folder = Path(tempfile.mkdtemp())

# %%
# The function depends on the seed and the number of the sample alone, and on the subject's number if it takes it. Here,
# somebody reads: three lines of eight fixations each, which scatter a little. It stands in a file of its own, because
# worker processes import it.
(folder / "reading.py").write_text(
    """
import random

import eyerender as er


def scene(seed, i, subject):
    rng, whose = random.Random(f"{seed} {i}"), random.Random(f"{seed} subject {subject}")
    line, word = divmod(i % 24, 8)
    azimuth, elevation = -14 + 4 * word + rng.gauss(0, 0.4), 6 - 6 * line + rng.gauss(0, 0.3)
    reader = {"gaze_deg": (azimuth, elevation), "pupil_diameter_mm": whose.uniform(3, 5)}
    changes = {"image.window_px": [200, 160], "image.spp": 4}
    return er.load_scene("head_mounted").with_(changes, **reader), {"word": word, "line": line}
"""
)
sys.path.insert(0, str(folder))
er.generate(scenes="reading:scene", path=folder / "reading", count=COUNT, seed=7, workers=1)
print("valid:", er.validate(folder / "reading")["ok"])

# %%
# In a loop, a scene may depend on those before it. Here, the headset slips down in a random walk. After an
# interruption, a writer with the same arguments goes on with the samples that are missing.
slip_mm = np.cumsum(np.abs(np.random.default_rng(3).normal(0, 0.15, COUNT)))
base = er.load_scene("head_mounted").with_({"image.window_px": [200, 160], "image.spp": 4}, gaze_deg=(0, 0))
with er.DatasetWriter(folder / "slipping", COUNT, name="slipping") as writer:
    for i in writer.missing():
        mount = {"translation_mm": [0.0, 0.0, -float(slip_mm[i])]}
        writer.add(i, base.with_({"rig.mount": mount}), subject=0, draws={"slip_mm": float(slip_mm[i])})

# %%
# The labels follow: fixations in lines, and a pupil that moves up in the picture.
figure, axes = plt.subplots(1, 3, figsize=(10, 3))
read, slipping = (list(er.ImageFolder.load(folder / name)) for name in ("reading", "slipping"))
axes[0].imshow(read[0].image(), cmap="gray")
axes[0].axis("off")
poses = [entry.line["records"][0]["pose"] for entry in read]
axes[1].plot([pose["azimuth_deg"] for pose in poses], [pose["elevation_deg"] for pose in poses], "o-")
axes[1].set(xlabel="azimuth (deg)", ylabel="elevation (deg)")
heights = [entry.labels["pupil"]["amodal"]["centre_px"][1] for entry in slipping]
axes[2].plot(slip_mm, heights, ".")
axes[2].set(xlabel="slippage (mm)", ylabel="pupil centre (px)")
figure.tight_layout()
plt.show()
