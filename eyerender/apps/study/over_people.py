"""Results over drawn people, whose unit is the person: mean, spread and percentiles, beside an experiment's.

With m_p the mean error of person p over the fixations: the mean of all m_p with its 95 % interval (Student's t), their
standard deviation, and their percentiles. U50E95 is the median, and U95E95 the 95th percentile, of the people's own
95th percentiles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, cast

import numpy as np

from ...base.arrays import Floats, Indices
from ...design.crowd import users_of
from ...eye.model import EyeModel, Stop
from ...gaze.budget import mean_interval
from ...report.page import Section, table_of
from ...scene import Frames, Scene
from ...scene.observation import Index
from .results import Finding, known_mean

Groups = Mapping[tuple[str, str], Mapping[str, Floats]]
"""(protocol, observer) -> name of a condition -> errors (n,) deg of a person."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """Result of an experiment: its mean, and the 95 % interval where the values of its participants were published."""

    mean_deg: float
    low_deg: float | None = None
    high_deg: float | None = None

    @classmethod
    def of(cls, values: Floats) -> Experiment:
        """Compute mean and interval from the values (n,) of its people."""
        return cls(**dict(zip(("mean_deg", "low_deg", "high_deg"), mean_interval(values), strict=True)))


def people_rows(groups: Mapping[str, Groups], measured: Mapping[str, Experiment]) -> list[dict[str, Any]]:
    """Summarise the errors of people: one row for each protocol, observer and condition.

    Args:
        groups: name of a person -> errors.
        measured: end of a condition, after the last comma or `on` -> what the experiment found.
    """
    by: dict[tuple[str, str, str], dict[str, Floats]] = {}
    for who, found in groups.items():
        for key, errors in found.items():
            for name, one in errors.items():
                by.setdefault((*key, name), {})[who] = one
    rows = []
    for (protocol, observer, name), of in by.items():
        means = {who: mean for who, one in of.items() if (mean := known_mean(one)) is not None}
        row: dict[str, Any] = {"protocol": protocol, "observer": observer, "condition": name, "people": len(of)}
        row |= {"missing": len(of) - len(means), **summary(np.array(list(means.values())))}
        every = list(of.values())
        if len({len(one) for one in every}) == 1 and len(every[0]) > 1:
            row |= {key: users_of(np.stack(every))[key] for key in ("U50E95", "U95E95")}
        exact = {who: known_mean(one) for who, one in by.get((protocol, "analytic", name), {}).items()}
        added = [mean - start for who, mean in means.items() if (start := exact.get(who)) is not None]
        if observer != "analytic" and added:
            row |= {f"added_{key}": value for key, value in summary(np.array(added)).items() if key[0] != "p"}
        told = measured.get(name.rpartition(", ")[2].rpartition(" on ")[2])
        if told is not None:
            row |= {"measured_deg": told.mean_deg, "measured_low_deg": told.low_deg, "measured_high_deg": told.high_deg}
            if told.low_deg is not None and told.high_deg is not None:
                row["verdict"] = "compatible" if told.low_deg <= (row["mean_deg"] or 0.0) <= told.high_deg else "not"
        rows.append(row)
    return rows


def summary(values: Floats) -> dict[str, float | None]:
    """Summarise values (p,) of people: mean with its 95 % interval, SD, and 5th, 50th and 95th percentile."""
    names = ("mean_deg", "low_deg", "high_deg", "sd_deg", "p5_deg", "p50_deg", "p95_deg")
    if len(values) < 2:
        return dict.fromkeys(names) | ({"mean_deg": float(values[0])} if len(values) else {})
    spread = (values.std(ddof=1), *np.percentile(values, (5, 50, 95)))
    return dict(zip(names, map(float, (*mean_interval(values), *spread)), strict=True))


def interval(values: Floats, name: str) -> dict[str, float | None]:
    """Return mean, lower and upper end of the interval of people's values (p,), as columns of a table."""
    found = summary(values)
    return {f"{name}_{end}": found[f"{end}_deg"] for end in ("mean", "low", "high")}


def listed(name: str, rows: Sequence[Mapping[str, Any]]) -> Section:
    """Make a section of a table of records: one column per key, without lists."""
    keys = dict.fromkeys(key for row in rows for key, value in row.items() if not isinstance(value, list))
    columns: dict[str, Any] = {key.replace("_", " "): partial(_get, key) for key in keys}
    return Section(name.replace("_", " ").capitalize(), table_of(rows, columns, folded=len(rows) > 60))


def _get(key: str, row: Mapping[str, Any]) -> Any:
    return row.get(key)


def line_of(row: Mapping[str, Any]) -> str:
    """Format a record for the terminal."""
    cells = (f"{key} {value:.3g}" if isinstance(value, float) else str(value) for key, value in row.items()
             if value is not None and not isinstance(value, list))  # fmt: skip
    return ", ".join(cells)


def differs(id: str, key: tuple[str, str], rule: str, values: Floats, expected: str) -> Finding:
    """Test that the mean of paired differences (p,) of people is positive: the lower end of its interval is > 0."""
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return Finding(id, *key, rule, None, "> 0", None, "fewer than two people", expected)
    mean, low, high = mean_interval(values)
    detail = f"{len(values)} people, mean {mean:.4f}, 95 % interval {low:.4f} to {high:.4f}"
    return Finding.of(id, key, f"{rule}: lower end of the 95 % interval", low, "> 0", detail, expected)


def resampled(values: Floats, of: Callable[[Floats], float], seed: int = 0, draws: int = 400) -> tuple[float, float]:
    """Compute the 95 % interval of a statistic of people's values (p, ...) by drawing people with replacement."""
    people = np.random.default_rng(seed).integers(len(values), size=(draws, len(values)))
    low, high = np.percentile([of(values[some]) for some in people], (2.5, 97.5))
    return float(low), float(high)


@dataclass(frozen=True, slots=True)
class OtherEyes:
    """A scene for ray optics whose eyes are changed, or have a separate stop in each row."""

    scene: Scene
    change: Callable[[EyeModel], EyeModel] = field(default=lambda eye: eye)
    stops: Stop | None = None

    @classmethod
    def frames(cls, frames: Frames, *args: Any) -> Frames:
        """Let the scene of frames be such a scene."""
        return Frames(cast(Scene, cls(frames.scene, *args)), frames.index, frames.pose)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.scene, name)

    def eyes_of(self, index: Index) -> tuple[list[EyeModel], Indices]:
        """Return the changed eyes."""
        eyes, which = self.scene.eyes_of(index)
        return [self.change(eye) for eye in eyes], which

    def stops_of(self, index: Index) -> Stop | None:
        """Return the stop of each row."""
        return self.stops
