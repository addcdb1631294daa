"""
The four Purkinje images
========================

Every surface of the eye mirrors the lamp: the front and the back of the cornea, and the front and the back of the lens.
The first image is the glint. The third moves against the others when the eye turns. The first and the fourth move by
different amounts, which dual-Purkinje trackers use.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

rig = er.Rig(
    cameras=[er.Camera.looking_at((0, 0, 0), position_mm=(500, 0, 0), focal_length_px=9000, size_px=(640, 480))],
    lights=[er.Led((500, 0, 120))],
)
angles = np.linspace(-6, 6, 25)
eye = er.Eye("E4", pupil_diameter_mm=7.0)
frames = er.Subject.one_eye(eye).looking([(a, 0) for a in angles], rig)
_, features = er.AnalyticObserver().observe_in_detail(frames, purkinje=(1, 2, 3, 4))

figure, axes = plt.subplots(figsize=(5.5, 4))
for k in range(4):
    axes.plot(angles, features.glints_px[:, 0, k, 0], label=f"image {k + 1}")
axes.set(xlabel="azimuth of the eye (degrees)", ylabel="x in the picture (px)")
axes.legend()
plt.show()
