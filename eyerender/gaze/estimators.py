"""The package's estimators by name.

To add one, write its class in a module of its own (see `builtin.BuiltIn`), name the class in `__init__.pyi`, and list
it here. Commands, their help and calibration files take it from this list.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from .builtin import BuiltIn


class Listed(NamedTuple):
    """An estimator's class among the public names of this package, and what it does and needs, for the help."""

    kind: str
    summary: str


ESTIMATORS: Mapping[str, Listed] = MappingProxyType(
    {
        "regression": Listed("Regression", "polynomials of the pupil-glint vector; one light"),
        "direction-regression": Listed(
            "DirectionRegression", "polynomials of a feature in pixels to directions; no screen needed"
        ),
        "homography": Listed("Homography", "normalisation by four lights"),
        "cross-ratio": Listed("CrossRatio", "four lights at the screen's corners and one at the camera"),
        "hennessey": Listed("Hennessey", "one camera, two lights"),
        "shih-wu-liu": Listed("ShihWuLiu", "two cameras, two lights"),
        "guestrin-eizenman": Listed("GuestrinEizenman", "one camera, two lights"),
        "maximum-likelihood": Listed(
            "MaximumLikelihood", "fits of a traced eye; any cameras and lights, rough positions of the eye"
        ),
    }
)


def estimator_class(name: str) -> type[BuiltIn]:
    """Return the class of an estimator of the list."""
    found: type[BuiltIn] = getattr(import_module(__package__), ESTIMATORS[name].kind)
    return found


def name_of(kind: type) -> str | None:
    """Return the name of a listed class; None for other classes, also for subclasses of listed ones."""
    return next((n for n, one in ESTIMATORS.items() if one.kind == kind.__name__ and estimator_class(n) is kind), None)
