"""
How many calibration targets?
=============================

More targets allow richer functions, and richer functions need more targets. Noise of half a pixel on all features shows
what is lost when a function has too many terms for its targets.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

REPEATS = 20  # small: 2

camera = er.Camera.looking_at((0, 0, 0), position_mm=(600, 0, -200), focal_length_px=7000, size_px=(1280, 800))
rig = er.Rig(
    cameras=[camera],
    lights=[er.Led((600, 150, -200)), er.Led((600, -150, -200))],
    screen=er.Screen((600, 0, 0), (500, 300)),
)
subject = er.Subject(er.Eye("E4", pupil_diameter_mm=4.0))
random = np.random.default_rng(1)


def noisy(observations, sd_px=0.5):
    """The same observations with noise on pupil centres and glints."""
    centre = observations.pupil.centre_px + random.normal(0, sd_px, observations.pupil.centre_px.shape)
    glints = observations.glints.xy_px + random.normal(0, sd_px, observations.glints.xy_px.shape)
    return replace(
        observations,
        pupil=replace(observations.pupil, centre_px=centre),
        glints=replace(observations.glints, xy_px=glints),
    )


test = er.trace(subject.fixating(rig.screen.grid(8, 5), rig))
figure, axes = plt.subplots(figsize=(5.5, 4))
for function in ("R1", "R3", "R5", "R8"):
    errors = []
    sides = (4, 5) if function == "R8" else (3, 4, 5)  # three columns do not determine R8's cubic in x
    for side in sides:
        calibration = er.trace(subject.fixating(rig.screen.grid(side, side), rig))
        mean = []
        for _ in range(REPEATS):
            fitted = er.gaze.Regression(function).fit(noisy(calibration), rig)
            found = fitted.predict(noisy(test), rig)
            mean.append(np.nanmean(np.linalg.norm(found.point_mm - test.index.target_mm, axis=1)))
        errors.append(np.degrees(np.mean(mean) / 600))
    axes.plot(np.square(sides), errors, "o-", label=function)
axes.set(xlabel="calibration targets", ylabel="mean error (degrees)", xticks=[9, 16, 25])
axes.legend()
plt.show()
