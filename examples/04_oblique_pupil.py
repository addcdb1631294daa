"""
The pupil seen from the side
============================

From the side a flat disc would look like an ellipse whose axes have the ratio cos(angle). A pupil behind a cornea looks
rounder, because the cornea bends light around its edge.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

angles = np.arange(0, 75, 5)
rig = er.Rig(
    cameras=[er.Camera.looking_at((0, 0, 0), position_mm=(600, 0, 0), focal_length_px=8000, size_px=(900, 900))],
    lights=[er.Led((600, 0, 100))],
)
figure, axes = plt.subplots(figsize=(5.5, 4))
for model in ("E1", "E3", "E5"):
    eye = er.Eye(model, pupil_diameter_mm=4.0)
    frames = er.Subject.one_eye(eye).looking([(-a, 0) for a in angles], rig)
    seen = er.trace(frames)
    a, b = seen.pupil.semi_axes_px.T
    axes.plot(angles, b / a, label=model)
    # What is not seen has a status with a reason instead of a number.
    for angle, ok, reason in zip(angles, seen.pupil.ok, seen.pupil.reason, strict=True):
        if not ok:
            print(model, angle, "degrees:", reason)
axes.plot(angles, np.cos(np.radians(angles)), "k--", label="flat disc, cos(angle)")
axes.set(xlabel="rotation of the eye (degrees)", ylabel="minor axis : major axis")
axes.legend()
plt.show()
