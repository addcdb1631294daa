"""
Gaze error over the screen
==========================

A regression is fitted to nine targets and tried on a dense grid, first with exact features and then with features that
were recovered from rendered images.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

COLUMNS, ROWS = 7, 5  # small: 3, 2
SAMPLES = 8  # small: 1

camera = er.Camera.looking_at((0, 0, 0), position_mm=(600, 0, -200), focal_length_px=7000, size_px=(1280, 800))
rig = er.Rig(
    cameras=[camera],
    lights=[er.Led((600, 150, -200), intensity_mw_sr=150), er.Led((600, -150, -200), intensity_mw_sr=150)],
    screen=er.Screen((600, 0, 0), (500, 300)),
)
subject = er.Subject(er.Eye("E4", pupil_diameter_mm=4.0))

# %%
# The estimator learns from the analytic features of nine targets. R4 is the function with the most terms that 3 x 3
# targets determine: a cubic in x, as in R8, needs four columns of targets, and ``fit`` warns where they are too few.
calibration = er.trace(subject.fixating(rig.screen.grid(3, 3), rig))
estimator = er.gaze.Regression("R4").fit(calibration, rig)

# %%
# Both observers look at the same test frames.
frames = subject.fixating(rig.screen.grid(COLUMNS, ROWS), rig)
seen = {"analytic features": er.trace(frames), "features from images": er.detect(er.render(frames, spp=SAMPLES))}

figure, axes = plt.subplots(1, 2, figsize=(9, 3), sharey=True)
for ax, (name, observations) in zip(axes, seen.items(), strict=True):
    found = estimator.predict(observations, rig)
    target = frames.index.target_mm
    error = np.degrees(np.linalg.norm(found.point_mm - target, axis=1) / 600)
    print(f"{name}: mean error {np.nanmean(error):.2f} degrees")
    both = error.reshape(-1, 2).mean(axis=1)
    picture = ax.tricontourf(-target[::2, 1], target[::2, 2], np.nan_to_num(both), levels=8)
    ax.plot(-target[::2, 1], target[::2, 2], "w+", ms=4)
    ax.set(title=name, xlabel="to the right on the screen (mm)", aspect="equal")
    figure.colorbar(picture, ax=ax, label="error (degrees)", shrink=0.8)
axes[0].set_ylabel("up (mm)")
plt.show()
