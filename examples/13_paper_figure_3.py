"""
Figure 3 of the replicated paper
================================

The five eye models fixate the 135 targets of Blignaut (2014). The figure shows where a camera sees the pupil centre and
the glint. The one-surface model E1 turns about the centre of its cornea, so its glint does not move.
"""

import matplotlib.pyplot as plt

import eyerender as er

scene = er.load_scene("blignaut2014")
figure, (pupils, glints) = plt.subplots(1, 2, figsize=(9, 4))
for model in ("E1", "E2", "E3", "E4", "E5"):
    seen = er.trace(scene.with_({"eye.model": model}))
    right = seen.take(seen.index.eye == 0)
    pupils.plot(*right.pupil.centre_px.T, ".", ms=3, label=model)
    glints.plot(*right.glints.xy_px[:, 0].T, ".", ms=3, label=model)
for ax, title in ((pupils, "(a) pupil centre"), (glints, "(b) glint")):
    ax.set(title=title, xlabel="x (px)", ylabel="y (px)", aspect="equal")
    ax.invert_yaxis()
    ax.legend(markerscale=3)
figure.tight_layout()
plt.show()
