"""
The eye behind a recording
==========================

A recording of a calibration shows more than gaze: the curvature of the cornea, the depth of the pupil and the visual
axis. ``er.fit_eye`` looks for the eye that explains the features best, and says how well each number is known.
``eyerender fit-eye`` does the same with a file. See :doc:`/rig_design`.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

# %%
# Somebody whose cornea is flatter than that of the model E2 looks at targets. The features have noise.
person = er.load_eye("E2").to_mapping()
for surface in person["cornea"]:
    surface["shape"]["radius_mm"] *= 1.04
scene = er.Scene.of(er.load_scene("guestrin2006").spec, eye=er.EyeSpec.from_mapping(person))
exact = er.trace(scene.frames())
rng = np.random.default_rng(3)
glints = exact.glints.xy_px + 0.02 * rng.standard_normal(exact.glints.xy_px.shape)
outline = exact.pupil.points_px
# The noise of an outline is stated for 1 px of its length.
spacing_px = np.linalg.norm(outline - np.roll(outline, 1, axis=1), axis=2).mean()
points = outline + 0.05 / np.sqrt(spacing_px) * rng.standard_normal(outline.shape)
seen = replace(exact, glints=replace(exact.glints, xy_px=glints), pupil=replace(exact.pupil, points_px=points))

# %%
# The fit starts from E2 and knows how much adults differ.
noise = er.design.FeatureNoise.of(0.05, 0.02, rig=scene.rig)
fit = er.fit_eye(seen, scene.rig, er.Unknowns.population(), prior="E2", noise=noise)[0]
found = fit.to_mapping()
for name, value in found["person"].items():
    if value["learned"]:
        print(f"{name}: {value['change']:+.3f} +- {value['deviation']:.3f}")

# %%
# Its lines of sight, beside the targets. The fitted eye can be saved as a file and rendered.
truth = seen.index.target_mm[fit.rows[np.unique(fit.instant, return_index=True)[1]]]
wanted = truth - fit.origin_mm
wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
error_deg = np.degrees(np.arccos(np.clip(np.sum(fit.direction * wanted, axis=1), -1, 1)))
print(f"error of gaze: {np.median(error_deg):.3f} deg (median)")

figure, ax = plt.subplots(figsize=(5, 4))
spots = ax.scatter(truth[:, 1], truth[:, 2], c=error_deg)
ax.set(xlabel="y (mm)", ylabel="z (mm)", title="error of gaze at the targets", aspect="equal")
figure.colorbar(spots, label="deg")
figure.tight_layout()
plt.show()
