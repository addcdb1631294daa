"""The page of an inspection: faults, outliers, duplicates, splits, strata, distributions, correlations, differences."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ...base.arrays import Bytes, Ints
from ...base.errors import InputError
from ...dataset.export.encoding import Encoding, measured_gain
from ...dataset.validation.problems import WRONG
from ...folders.imagefolder import ImageEntry
from ...report.page import write_template
from ...report.style import ANALYTIC, IMAGE, figure, svg
from .comparing import Shift, only_in, shares
from .faults import KINDS
from .figures import DRAW, LABEL, PERSON, PICTURE
from .found import Inspection
from .reading import Contents, spread
from .statistics import Distribution, binned
from .strata import strata

_WIDTH = 260  # of pictures on the page, px
_SAMPLED = 64  # pictures from which the gain is measured
_FAULTS, _PAIRS, _SHIFTS, _CORRELATED = 24, 8, 16, 36
_WHERE = {LABEL: "Labels", PICTURE: "Pictures", DRAW: "Draws", PERSON: "People"}
PageValues = dict[str, Any]


def write(path: Path, found: Sequence[Inspection], moved: Sequence[Shift]) -> None:
    """Write the page of one dataset, or of two and their difference."""
    first, *others = found
    values = {
        "title": f"Dataset {first.contents.folder.path.resolve().name}"
        + "".join(f" and {o.contents.folder.path.resolve().name}" for o in others),
        "datasets": [_dataset(one, several=bool(others)) for one in found],
        "difference": _difference(first, others[0], moved) if others else None,
        "colours": (IMAGE, ANALYTIC),
    }
    write_template(path, "inspection.html.j2", values, package="eyerender.apps.inspection")


class _Pictures:
    """Pictures of a dataset for people: one gain, gamma 2.2, small JPEG files inside the page."""

    def __init__(self, contents: Contents) -> None:
        self._contents = contents
        self._encoding = Encoding(8, "gamma", self._gain(), "measured")

    def _gain(self) -> float:
        def images() -> Iterator[tuple[Any, int, float]]:
            for at in spread(len(self._contents), _SAMPLED).tolist():
                found = self._read(at)
                if found is not None and found[1].dtype.kind == "u":
                    yield found[1], found[2], found[0].gamma

        listed = list(images())
        return measured_gain(listed) if listed else 1.0

    def _read(self, at: int) -> tuple[ImageEntry, Any, int] | None:
        try:
            entry = self._contents.entry(at)
            found = entry.picture("file_name")
        except InputError:
            return None
        assert found is not None
        return entry, found[0], int(entry.line.get("bit_depth") or found[1])

    def tile(self, at: int, text: Iterable[str], *, marked: bool = False) -> PageValues:
        """PageValues of a picture on the page: its data, size, caption, and the labels to draw on it."""
        tile: PageValues = {"text": list(text), "data": None, "marks": [], "size": (4, 3)}
        found = self._read(at)
        if found is None:
            return tile
        entry, image, depth = found
        if image.dtype.kind == "u":
            codes = self._encoding.apply(image, depth, entry.gamma)
        else:
            codes = np.asarray(255 * image / max(float(image.max()), 1e-30), dtype=np.uint8)
        tile["size"] = codes.shape[::-1]
        tile["data"] = _jpeg(codes)
        tile["marks"] = _marks(entry) if marked else []
        return tile


def _jpeg(codes: Bytes) -> str:
    picture = Image.fromarray(codes)
    if picture.width > _WIDTH:
        height = max(1, round(picture.height * _WIDTH / picture.width))
        picture = picture.resize((_WIDTH, height), Image.Resampling.BOX)
    file = io.BytesIO()
    picture.save(file, "JPEG", quality=80)
    return base64.b64encode(file.getvalue()).decode()


def _marks(entry: ImageEntry) -> list[PageValues]:
    """Outlines of pupil and iris and the visible glints, in pixels of the picture; pixel i covers [i, i + 1)."""
    x0, y0 = entry.window[:2]
    found: list[PageValues] = []
    try:
        for part in ("iris", "pupil"):
            outline = entry.labels[part]["amodal"]
            (x, y), (a, b) = outline["centre_px"], outline["semi_axes_px"]
            turn = float(np.degrees(outline["angle_rad"]))
            found.append({"kind": part, "x": x - x0 + 0.5, "y": y - y0 + 0.5, "a": a, "b": b, "turn": turn})
        for glint in entry.labels["glints"]:
            if glint["visible"]:
                x, y = glint["xy_px"]
                found.append({"kind": "glint", "x": x - x0 + 0.5, "y": y - y0 + 0.5})
    except (*WRONG, InputError):
        pass  # what there is of the labels is drawn
    return found


def _dataset(found: Inspection, *, several: bool) -> PageValues:
    contents, pictures = found.contents, _Pictures(found.contents)
    faults = found.faults()
    return {
        "before": f"{contents.folder.path.resolve().name}: " if several else "",
        "path": str(contents.folder.path),
        "unfinished": contents.folder.unfinished,
        "read": len(contents),
        "images": len(contents.folder.entries),
        "subjects": len(set().union(*(own for _, own in found.splits.values()))) if found.splits else 0,
        "fault_count": sum(map(len, faults.values())),
        "fault_rows": [[kind, str(len(own)), KINDS[kind]] for kind, own in faults.items()],
        "fault_tiles": _fault_tiles(found, faults, pictures),
        "fault_lines": [[kind, found.name(at), detail] for kind, own in faults.items() for at, detail in own[:100]],
        "outliers": [
            pictures.tile(
                o.at, [found.name(o.at), *(f"{r.column}: {r.value:.4g}; {r.usual}" for r in o.reasons)], marked=True
            )
            for o in found.outliers
        ],
        "equal": [_pair(found, pictures, group[0], group[1], f"{len(group)} equal") for group in found.equal[:_PAIRS]],
        "equal_count": sum(len(group) - 1 for group in found.equal),
        "near": [
            _pair(found, pictures, p.first, p.second, f"correlation {p.correlation:.5f}") for p in found.near[:_PAIRS]
        ],
        "near_count": len(found.near),
        "split_rows": _split_rows(found),
        "shared": [[str(subject), ", ".join(names)] for subject, names in list(found.shared.items())[:50]],
        "shared_count": len(found.shared),
        "strata": [
            (name, [(part, [pictures.tile(at, [_short(contents, at)]) for at in part.shown]) for part in parts])
            for name, parts in strata(contents)
        ],
        "histograms": _histograms(found.distributions),
        "constant": [[d.column, f"{d.quantiles[0]:.6g}"] for d in found.distributions.values() if not len(d.counts)],
        "correlation_figure": _correlation_figure(found),
        "correlation_rows": [[a, b, f"{rho:+.2f}"] for a, b, rho in found.strongest],
    }


def _fault_tiles(
    found: Inspection, faults: Mapping[str, list[tuple[int, str]]], pictures: _Pictures
) -> list[PageValues]:
    """Pictures with faults: one of each kind, then a second one, and so on; each image once."""
    shown: dict[int, list[str]] = {}
    for turn in range(max(map(len, faults.values()), default=0)):
        for own in faults.values():
            if turn < len(own) and len(shown) < _FAULTS:
                shown.setdefault(own[turn][0], [])
        if len(shown) >= _FAULTS:
            break
    for at, texts in shown.items():
        texts += [f"{fault.kind}: {fault.detail}" for fault in found.contents.faults[at]]
    return [pictures.tile(at, [found.name(at), *texts], marked=True) for at, texts in shown.items()]


def _pair(found: Inspection, pictures: _Pictures, first: int, second: int, text: str) -> PageValues:
    splits = found.contents.groups.get("split")
    names = [found.name(at) + ("" if splits is None else f" ({splits[at]})") for at in (first, second)]
    return {"text": text, "tiles": [pictures.tile(at, [n]) for at, n in zip((first, second), names, strict=True)]}


def _short(contents: Contents, at: int) -> str:
    return f"subject {contents.subjects[at]}" if contents.subjects[at] >= 0 else contents.names[at]


def _split_rows(found: Inspection) -> list[list[str]]:
    total = sum(n for n, _ in found.splits.values())
    rows = []
    for name, (images, subjects) in found.splits.items():
        per = f"{images / len(subjects):.1f}" if subjects else "-"
        rows.append([name or "-", str(images), f"{images / total:.1%}", str(len(subjects)), per])
    return rows


def _histograms(distributions: Mapping[str, Distribution]) -> list[tuple[str, list[PageValues]]]:
    """Histograms by where their numbers are from."""
    found = []
    for start, heading in _WHERE.items():
        own = [d for name, d in distributions.items() if name.startswith(start) and len(d.counts)]
        if own:
            found.append((heading, [_histogram(d, d.column.removeprefix(start)) for d in own]))
    return found


def _histogram(d: Distribution, name: str) -> PageValues:
    q = d.quantiles
    text = f"{q[1]:.4g} … {q[3]:.4g} … {q[5]:.4g}"
    more = [f"{word} {value:.4g}" for word, value in (("min", q[0]), ("max", q[6]))]
    return {"name": name, "bars": [_bars(d.counts)], "text": text, "more": ", ".join(more)}


def _bars(counts: Ints) -> str:
    """Path of the bars of a histogram in a box of 100 x 40."""
    heights = 39 * counts / max(int(counts.max(initial=0)), 1)
    step = 100 / len(counts)
    points = (f"L{k * step:.2f} {40 - h:.2f}L{(k + 1) * step:.2f} {40 - h:.2f}" for k, h in enumerate(heights))
    return f"M0 40{''.join(points)}L100 40Z"


def _correlation_figure(found: Inspection) -> str | None:
    """Draw the rank correlations of the columns that depend most on others."""
    names, matrix = found.correlated
    if len(names) < 2:
        return None
    others = np.abs(np.nan_to_num(matrix)) - np.eye(len(names))
    chosen = np.sort(np.argsort(-others.max(axis=1), kind="stable")[:_CORRELATED])
    size = 3.4 + 0.19 * len(chosen)
    with figure(size + 2.2, size) as (fig, ax):
        drawn = ax.imshow(matrix[np.ix_(chosen, chosen)], cmap="RdBu_r", vmin=-1, vmax=1)
        labels = [names[k] for k in chosen]
        ax.set_xticks(range(len(chosen)), labels, rotation=90, fontsize=8)
        ax.set_yticks(range(len(chosen)), labels, fontsize=8)
        ax.grid(visible=False)
        fig.colorbar(drawn, ax=ax, shrink=0.5, label="rank correlation")
        return svg(fig)


def _difference(first: Inspection, second: Inspection, moved: Sequence[Shift]) -> PageValues:
    """PageValues of the section on two datasets."""
    a, b = first.contents, second.contents
    beyond = [shift for shift in moved if shift.distance > shift.chance]
    rows = [
        [
            s.column,
            f"{s.distance:.3f}",
            f"{s.chance:.3f}",
            *(f"{m:.4g}" for m in s.medians),
            "{} and {}".format(*s.counts),
        ]
        for s in moved
    ]
    groups = [
        [name, f"{distance:.3f}", value, f"{one:.1%}", f"{other:.1%}"]
        for name, distance, parts in shares(a, b)
        for value, one, other in parts
    ]
    return {
        "names": [str(a.folder.path), str(b.folder.path)],
        "compared": len(moved),
        "beyond": len(beyond),
        "rows": rows,
        "groups": groups[:100],
        "histograms": [_both(first, second, shift) for shift in beyond[:_SHIFTS]],
        "only": [(only_in(a, b), str(a.folder.path)), (only_in(b, a), str(b.folder.path))],
    }


def _both(first: Inspection, second: Inspection, shift: Shift) -> PageValues:
    """Histograms of a column in both datasets, with the bins of both."""
    values = [one.contents.columns[shift.column].astype(float) for one in (first, second)]
    values = [v[np.isfinite(v)] for v in values]
    low, high = np.quantile(np.concatenate([np.quantile(v, (0.002, 0.998)) for v in values]), (0, 1))
    edges = np.linspace(low, high if high > low else low + 1, 31)
    # Shares, so that the areas of two datasets of different sizes are equal.
    bars = [binned(v, edges) / len(v) for v in values]
    top = max(float(part.max()) for part in bars)
    paths = [_bars(np.round(1e6 * part / top).astype(np.int64)) if top else "" for part in bars]
    return {
        "name": shift.column,
        "bars": paths,
        "text": f"{edges[0]:.4g} … {edges[-1]:.4g}",
        "more": f"distance {shift.distance:.3f}",
    }
