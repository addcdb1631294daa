"""Gaze estimators: fitted to observations of known targets, they estimate the gaze points of other observations.

    gaze = er.gaze.Regression("R3").fit(truth, rig).predict(found, rig)

Every estimator follows the protocol `GazeEstimator`, and so may a class of your own. The names below load their modules
on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .columns import CsvColumns
    from .crossratio import CrossRatio
    from .estimate import (
        GazeEstimator,
        GazePoints,
        GazeRays,
        StoredEstimator,
        angular_error_deg,
        binocular_average,
    )
    from .guestrin import GuestrinEizenman
    from .hennessey import Hennessey
    from .homography import Homography
    from .parameters import EyeParameters, ParameterBounds
    from .recalibration import Recalibration
    from .records import load_observations, load_rig
    from .regression import Regression
    from .store import load_estimator, save_estimator
    from .table import observations_from_csv
    from .twocamera import ShihWuLiu
    from .validation import GazeErrors, gaze_errors, leave_one_target_out

_HOMES = {
    "CrossRatio": "crossratio",
    "CsvColumns": "columns",
    "EyeParameters": "parameters",
    "GazeErrors": "validation",
    "GazeEstimator": "estimate",
    "GazePoints": "estimate",
    "GazeRays": "estimate",
    "GuestrinEizenman": "guestrin",
    "Hennessey": "hennessey",
    "Homography": "homography",
    "ParameterBounds": "parameters",
    "Recalibration": "recalibration",
    "Regression": "regression",
    "ShihWuLiu": "twocamera",
    "StoredEstimator": "estimate",
    "angular_error_deg": "estimate",
    "binocular_average": "estimate",
    "gaze_errors": "validation",
    "leave_one_target_out": "validation",
    "load_estimator": "store",
    "load_observations": "records",
    "load_rig": "records",
    "observations_from_csv": "table",
    "save_estimator": "store",
}

__all__ = [
    "CrossRatio",
    "CsvColumns",
    "EyeParameters",
    "GazeErrors",
    "GazeEstimator",
    "GazePoints",
    "GazeRays",
    "GuestrinEizenman",
    "Hennessey",
    "Homography",
    "ParameterBounds",
    "Recalibration",
    "Regression",
    "ShihWuLiu",
    "StoredEstimator",
    "angular_error_deg",
    "binocular_average",
    "gaze_errors",
    "leave_one_target_out",
    "load_estimator",
    "load_observations",
    "load_rig",
    "observations_from_csv",
    "save_estimator",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f".{_HOMES[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
