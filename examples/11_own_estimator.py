"""
Your own gaze estimator
=======================

An estimator is a class with ``fit`` and ``predict``. Everything that takes an estimator takes it, also on the command
line: ``eyerender compare FOLDER --estimator mymodule:PupilOnly``.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er


class PupilOnly:
    """A plane fitted to the pupil's place in the image, without any glint."""

    def __init__(self, weights=None):
        self.weights = weights

    @staticmethod
    def _terms(observations):
        return np.column_stack([np.ones(len(observations)), observations.pupil.centre_px])

    def fit(self, observations, rig):
        weights = {}
        for eye in (0, 1):
            rows = (observations.index.eye == eye) & observations.pupil.ok
            if rows.any():
                terms = self._terms(observations)[rows]
                weights[eye] = np.linalg.lstsq(terms, observations.index.target_mm[rows], rcond=None)[0]
        return PupilOnly(weights)

    def predict(self, observations, rig):
        terms = self._terms(observations)
        points = [terms[i] @ self.weights[eye] for i, eye in enumerate(observations.index.eye)]
        return er.gaze.GazePoints.of(points)


scene = er.load_scene("blignaut2014")
truth = er.trace(scene)
estimators = {"pupil only": PupilOnly(), "pupil and glint (R3)": er.gaze.Regression("R3")}

# %%
# Each target is left out once and estimated from the others.
figure, axes = plt.subplots(figsize=(5.5, 3.5))
for name, estimator in estimators.items():
    errors = er.gaze.leave_one_target_out(estimator, truth, scene.rig)
    print(f"{name}: mean {errors.mean_deg:.3f}, largest {errors.max_deg:.3f} degrees")
    axes.bar(name, errors.mean_deg)
axes.set_ylabel("mean error (degrees)")
plt.show()
