"""
Extracting your own images
==========================

The extractor needs only an array. Here the array comes from the renderer; read yours with any image library.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

SAMPLES = 8  # small: 1

scene = er.load_scene("headset")
frames = scene.frames()
array = er.render(frames[0], spp=SAMPLES).counts

# %%
# The result has the pupil's ellipse with its covariance and a confidence, and the glints. A missing feature has a
# reason.
found = er.extract(array, bit_depth=scene.spec.sensor.bit_depth)
print("pupil:", found.pupil.ellipse if found.pupil.ok else found.pupil.reason)
print("confidence:", found.pupil.confidence)
print("glints:", [np.round(glint.xy_px, 2).tolist() for glint in found.glints if glint.xy_px is not None])

# %%
figure, axes = plt.subplots(figsize=(6, 4.5))
axes.imshow(array, cmap="gray")
if found.pupil.ellipse is not None:
    t = np.linspace(0, 2 * np.pi, 200)
    (a, b), angle = found.pupil.ellipse.semi_axes_px, found.pupil.ellipse.angle_rad
    x, y = a * np.cos(t), b * np.sin(t)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    axes.plot(*(turn @ [x, y] + np.array(found.pupil.ellipse.centre_px)[:, None]), color="tab:orange", lw=1)
for glint in found.glints:
    axes.plot(*glint.xy_px, "+", color="tab:cyan")
axes.axis("off")
plt.show()
