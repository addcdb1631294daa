"""The waterfall from a published reading to the corrected one, for studies whose software departs from its text."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

from ...analytic.observer import trace
from ...rig.rig import RigGeometry
from ...scene import Scene
from ...scene.observation import Observations
from .results import Departure, WaterfallStep

Measure = Callable[[Observations, RigGeometry, frozenset[str]], dict[str, float | None]]


def waterfall(
    eye: str,  # the eye model
    departures: Sequence[Departure],  # all departures, in their order
    scene: Callable[[str, Collection[str]], Scene],  # builds the scene of an eye with some departures
    of_scene: Collection[str],  # the departures that change the scene, so that others share its observations
    measure: Measure,  # computes the errors (deg) by name from observations, rig and departures
) -> list[WaterfallStep]:
    """Correct departures one after the other; also correct each of them alone."""
    seen: dict[frozenset[str], tuple[Scene, Observations]] = {}

    def measured(some: frozenset[str]) -> dict[str, Any]:
        key = some & frozenset(of_scene)
        if key not in seen:
            own = scene(eye, key)
            seen[key] = own, trace(own)
        return measure(seen[key][1], seen[key][0].rig, some)

    left = frozenset(one.id for one in departures)
    every, start = left, measured(left)
    steps = [WaterfallStep(eye, "published", start, start)]
    for departure in departures:
        left = left - {departure.id}
        steps.append(WaterfallStep(eye, departure.id, measured(left), measured(every - {departure.id})))
    return steps
