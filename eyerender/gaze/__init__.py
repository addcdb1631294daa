"""Gaze estimators: fitted to observations of known targets, they estimate the gaze points of other observations.

    gaze = er.gaze.Regression("R3").fit(truth, rig).predict(found, rig)

Every estimator implements the protocol `GazeEstimator`; a class of your own may do so too. The names in `__init__.pyi`
load their modules on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
