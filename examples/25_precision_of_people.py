"""
Accuracy and precision of people
================================

From drawn people to the figures that a laboratory states of its tracker: accuracy, RMS-S2S, SD, their ratio, BCEA. The
ratio tells whether samples are independent or filtered. See :doc:`/own_data`.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

PEOPLE, SAMPLES = 12, 200  # small: 3, 50
rig = er.load_scene("eyelink_desktop").spec.rig
targets = np.array([[700.0, y, z] for z in (-90, 20, 130) for y in (-180, 0, 180)])
people = er.Population("adults").draw(PEOPLE, seed=1)

# %%
# Everyone calibrates on nine targets, then looks at them again while the features have noise, white or filtered.
found = {np.sqrt(2): [], 0.6: []}
for row in range(PEOPLE):
    frames = people.subject(row, eyes=["right"]).fixating(targets, rig)
    exact = er.trace(frames)
    estimator = er.gaze.Regression("R3", normalised=False).fit(exact, rig)
    for ratio, rows in found.items():
        many = exact.take(np.tile(np.arange(len(exact)), SAMPLES))
        noisy = [many.take(slice(k, None, len(exact))).with_noise(0.05, seed=k, s2s_over_sd=ratio) for k in range(9)]
        samples = np.stack([estimator.predict(one, rig).point_mm for one in noisy], axis=1)
        eye = exact.index.eye_position_mm + exact.index.head_mm
        rows.append(er.gaze.quality(samples, exact.index.target_mm, eye))

# %%
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
for name, axis in zip(("sd_deg", "rms_s2s_deg", "s2s_over_sd"), axes, strict=True):
    values = [[float(np.median(getattr(one, name))) for one in rows] for rows in found.values()]
    axis.boxplot(values, tick_labels=["white", "filtered"])
    axis.set(title=name, ylim=(0, None))
plt.show()
