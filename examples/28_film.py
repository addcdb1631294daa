"""
A film of a person, and a rolling shutter
=========================================

A drawn person looks around and blinks before a headset's camera at 60 Hz; then the same eye in the middle of a saccade,
with a shutter that exposes all rows at once, and one that exposes them in turn. See :doc:`/sequences`.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

FRAMES, SPP = 24, 4  # small: 6, 1

# %%
# A shipped dataset of clips; each sample is one frame of a clip. Here is a clip of our own: two targets, one blink.
plain = er.sample("dataset_sequence", 0).scene
motion = {
    "duration_s": FRAMES / 60,
    "gaze": {"targets": [[1400, 0, 0], [1400, 350, -150]], "fixation_ms": 180, "fixation_spread": 0},
    "lids": {"blinks_per_minute": 0, "at_s": [0.08]},
}
scene = plain.with_({"sequence": motion, "image.spp": SPP})
frames = scene.frames()
right = frames.take(frames.index.eye == 0)
film = [image.counts for image in er.render_windows(right)]

# %%
# Every frame has its time and what the eye does.
columns = min(8, FRAMES)
figure, axes = plt.subplots(
    -(-FRAMES // columns), columns, figsize=(12, 1.9 * -(-FRAMES // columns)), layout="constrained"
)
for axis, counts, at, words in zip(axes.flat, film, right.index.time_s, right.index.events, strict=True):
    axis.imshow(counts, cmap="gray", vmin=0, vmax=255)
    axis.set_title(f"{1e3 * at:.0f} ms {words.split('+')[-1]}", fontsize=7)
    axis.axis("off")
plt.show()

# %%
# In a saccade of 500 deg/s, a rolling shutter of 30 us per row shears the eye, because each row shows it later than the
# one above. Labels follow: every point of the outline is that of its own row's time.
turn = {"time_s": [-0.05, 0.05], "azimuth_deg": [-25, 25], "elevation_deg": [0, 0]}
fast = {"sequence": {"duration_s": 0.02, "gaze": turn, "lids": {"blinks_per_minute": 0}}, "image.spp": SPP}
fast |= {"sensor.exposure_ms": 0.5, "sensor.noise": False}
pictures, outlines = [], []
for shutter in ("global", {"rolling": {"row_us": 30.0}}):
    one = plain.with_({**fast, "rig.cameras.0.shutter": shutter, "rig.cameras.1.shutter": shutter}).frames()[:1]
    pictures += [image.irradiance for image in er.render_windows(one)]
    outlines.append(er.trace(one).pupil.points_px[0])

# %%
figure, axes = plt.subplots(1, 2, figsize=(7, 5.4), layout="constrained")
for axis, picture, outline, name in zip(axes, pictures, outlines, ("global", "rolling"), strict=True):
    axis.imshow(picture, cmap="gray", vmax=np.percentile(picture, 99.5))
    axis.plot(*outline.T, color="#E69F00", lw=1)
    axis.set(title=f"{name} shutter", xticks=[], yticks=[])
plt.show()
