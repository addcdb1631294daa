"""Gaze estimators: fitted to observations of known targets, they estimate the gaze points of other observations.

    gaze = er.gaze.Regression("R3").fit(truth, rig).predict(found, rig)

Every estimator follows the protocol `GazeEstimator`, and so may a class of your own. The names in `__init__.pyi` load
their modules on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
