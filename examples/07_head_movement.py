"""
Moving the head
===============

A regression knows one head position. Cross ratios and homographies use several lights to follow the head, and a
model of the eye knows where the eye is.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

camera = er.Camera.looking_at((0, 0, 0), position_mm=(600, 0, -200), focal_length_px=4000, size_px=(1600, 1200))
corners = [(600, 200, 120), (600, -200, 120), (600, -200, -120), (600, 200, -120)]
lights = [er.Led(place) for place in [*corners, (600, 0, -200)]]  # the corners of the screen, and the camera
rig = er.Rig(cameras=[camera], lights=lights, screen=er.Screen((600, 0, 0), (400, 240)))
eye = er.Eye("E4", pupil_diameter_mm=4.0)

calibration = er.trace(er.Subject(eye).fixating(rig.screen.grid(3, 3), rig))
estimators = {
    "regression": er.gaze.Regression("R3"),
    "homography": er.gaze.Homography(),
    "cross ratio": er.gaze.CrossRatio(),
}
fitted = {name: estimator.fit(calibration, rig) for name, estimator in estimators.items()}

# %%
# The head moves sideways, and the estimators get no information about it.
offsets = np.arange(0, 60, 10)
figure, axes = plt.subplots(figsize=(5.5, 4))
for name, estimator in fitted.items():
    errors = []
    for offset in offsets:
        subject = er.Subject(eye, head_positions_mm=[(0, float(offset), 0)])
        seen = er.trace(subject.fixating(rig.screen.grid(4, 4), rig))
        found = estimator.predict(seen, rig)
        errors.append(np.degrees(np.nanmean(np.linalg.norm(found.point_mm - seen.index.target_mm, axis=1)) / 600))
    axes.plot(offsets, errors, "o-", label=name)
axes.set(xlabel="head moved sideways (mm)", ylabel="mean error (degrees)")
axes.legend()
plt.show()
