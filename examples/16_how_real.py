"""
Comparing rendered pictures with other frames
=============================================

How real do pictures look? This example compares the figures of two rendered scenes. Replace the second folder by frames
of your own camera.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import eyerender as er
from eyerender.apps.realism import measure_folder

SAMPLES = 8  # small: 1

folder = Path(tempfile.mkdtemp())
for name in ("headset", "desktop_tracker"):
    scene = er.load_scene(name, spp=SAMPLES)
    er.render_folder(scene, folder / name)

# %%
# Each figure is the median over the images of a folder. `gamma` states the encoding of frames that are not linear.
found = {name: measure_folder(folder / name, gamma=1.0) for name in ("headset", "desktop_tracker")}
for figure in ("pupil : iris", "iris : sclera", "limbal ring : mid iris", "pupil edge (R)", "noise (codes)"):
    print(f"{figure:24}", *(f"{name} {f.median(figure):.3f}" for name, f in found.items()), sep="  ")

# %%
# The pictures at equal scale: the iris has the same size in all of them.
drawing, axes = plt.subplots(2, 3, figsize=(9, 5))
for row, f in zip(axes, found.values(), strict=True):
    for ax, tile in zip(row, f.tiles, strict=False):
        ax.imshow(tile, cmap="gray", vmin=0, vmax=255)
        ax.axis("off")
plt.show()
