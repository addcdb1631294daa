"""The page of an inspection: faults, outliers, duplicates, splits, strata, distributions, differences."""

from __future__ import annotations

import html
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ...base.arrays import Bytes, Ints
from ...base.errors import WRONG, InputError
from ...dataset.export.encoding import Encoding, measured_gain
from ...folders.imagefolder import FILE_KEYS, ImageEntry
from ...report.overlay import picture
from ...report.page import Card, Content, Gallery, Key, Page, Section, Table, write_page
from ...report.style import ANALYTIC, IMAGE
from .comparing import Shift, only_in, shares
from .dependence import SUBJECTS, Dependence
from .faults import KINDS
from .figures import DRAW, LABEL, PERSON, PICTURE
from .found import Inspection, counts_of
from .planned import PlannedDraws
from .reading import Contents, spread
from .statistics import Distribution, binned
from .strata import strata

_WIDTH = 260  # of pictures on the page, px
_SAMPLED = 64  # pictures from which the gain is measured
_FAULTS, _PAIRS, _SHIFTS, _NAMED = 24, 8, 16, 40
_SMALL_REM, _HISTOGRAM_REM = 5.9, 9.4
_WHERE = {LABEL: "Labels", PICTURE: "Pictures", DRAW: "Draws", PERSON: "People"}
_MARKS = {"pupil": "#ff9f1c", "iris": "#56b4e9", "glints": "#7fdd4c"}
Picture = tuple[str, Sequence[str]]


def write(path: Path, found: Sequence[Inspection], moved: Sequence[Shift]) -> None:
    """Write the page of one dataset, or of two and their difference."""
    names = [one.contents.folder.path.resolve().name for one in found]
    several = len(found) > 1
    lead = [*map(_about, found), "Pictures are shown with one gain for the whole dataset and a gamma of 2.2."]
    cards: list[Card] = []
    sections = [_difference(found[0], found[1], moved)] if several else []
    for name, one in zip(names, found, strict=True):
        before = f"{name}: " if several else ""
        cards += _cards(one, before)
        sections += _dataset(one, before)
    write_page(path, Page(f"Dataset {' and '.join(names)}", lead, cards, sections))


def write_planned(path: Path, drawn: PlannedDraws) -> None:
    """Write the page of the draws of a plan."""
    subjects = set().union(*(own for _, own in drawn.splits.values()))
    lead = [f"{drawn.path}: {drawn.read} of its {drawn.images} samples were drawn. Nothing was rendered."]
    cards = [Card(str(drawn.read), "samples"), Card(str(len(subjects)), "subjects")]
    sections = {
        "Dependences": _dependences(drawn.dependences),
        "Splits": _splits(drawn.splits, {}),
        "Distributions": _distributions(drawn.distributions),
    }
    write_page(path, Page(f"Plan {drawn.path}", lead, cards, [Section(name, *c) for name, c in sections.items()]))


def _about(found: Inspection) -> str:
    folder, read = found.contents.folder, len(found.contents)
    images = len(folder.entries)
    text = f"all of its {images} images were read"
    if read < images:
        text = f"{read} of its {images} images were read, spread evenly over it"
    return f"{folder.path}: {text}{f'; {folder.unfinished}' if folder.unfinished else ''}."


def _cards(found: Inspection, before: str) -> list[Card]:
    subjects = set().union(*(own for _, own in found.splits.values()))
    shared = f"subjects, {len(found.shared) or 'none'} of them in two splits"
    numbers = (
        (sum(map(len, found.faults().values())), "faults"),
        (len(found.outliers), "outliers shown"),
        (f"{_equal(found)} + {len(found.near)}", "equal pictures + near-duplicates"),
        (len(subjects), shared),
    )
    return [Card(str(value), f"{before}{text}") for value, text in numbers]


def _equal(found: Inspection) -> int:
    return sum(len(group) - 1 for group in found.equal)


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

    def drawn(self, at: int, *, marked: bool = False) -> str:
        """Draw a picture, with its labels on it if they are asked for."""
        found = self._read(at)
        if found is None:
            return "no picture"
        entry, image, depth = found
        if image.dtype.kind == "u":
            codes = self._encoding.apply(image, depth, entry.gamma)
        else:
            codes = np.asarray(255 * image / max(float(image.max()), 1e-30), dtype=np.uint8)
        height, width = codes.shape
        over = _marks(entry, width / 60) if marked else ""
        return picture(_jpeg(codes), "jpeg", (width, height), over=over, title=entry.name)

    def tile(self, at: int, text: Iterable[str], *, marked: bool = False) -> Picture:
        """Draw a picture with its caption."""
        return self.drawn(at, marked=marked), list(text)


def _jpeg(codes: Bytes) -> bytes:
    small = Image.fromarray(codes)
    if small.width > _WIDTH:
        small = small.resize((_WIDTH, max(1, round(small.height * _WIDTH / small.width))), Image.Resampling.BOX)
    file = io.BytesIO()
    small.save(file, "JPEG", quality=80)
    return file.getvalue()


def _marks(entry: ImageEntry, radius: float) -> str:
    """Draw outlines of pupil and iris and the visible glints, in pixels of the picture; pixel i covers [i, i + 1)."""
    x0, y0 = entry.window[:2]
    found = []
    try:
        for part in ("iris", "pupil"):
            outline = entry.labels[part]["amodal"]
            (x, y), (a, b) = outline["centre_px"], outline["semi_axes_px"]
            x, y, turn = x - x0 + 0.5, y - y0 + 0.5, float(np.degrees(outline["angle_rad"]))
            found.append(
                f'<ellipse stroke="{_MARKS[part]}" cx="{x:.1f}" cy="{y:.1f}" rx="{a:.1f}" ry="{b:.1f}" '
                f'transform="rotate({turn:.1f} {x:.1f} {y:.1f})" {_LINE}/>'
            )
        for glint in entry.labels["glints"]:
            if glint["visible"]:
                x, y = glint["xy_px"]
                x, y = x - x0 + 0.5, y - y0 + 0.5
                found.append(
                    f'<circle stroke="{_MARKS["glints"]}" cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" {_LINE}/>'
                )
    except (*WRONG, InputError):
        pass  # what there is of the labels is drawn
    return "".join(found)


_LINE = 'fill="none" vector-effect="non-scaling-stroke" stroke-width="1.3px"'


def _dataset(found: Inspection, before: str) -> list[Section]:
    """Return the sections of one dataset."""
    contents, pictures = found.contents, _Pictures(found.contents)
    sections: dict[str, Sequence[Content]] = {
        "Contents": _contents(found),
        "Faults": _faults(found, pictures),
        "Shares": [
            Table(
                ("quantity", "shares of the images"), [(k, _listed(own)) for k, own in found.shares.items()], wide=(1,)
            )
        ],
        "Dependences": _dependences(found.dependences),
        "Missing labels": _missing(found),
        "Worst pictures": _worst(found, pictures),
        "Outliers": _outliers(found, pictures),
        "Near-duplicates": _duplicates(found, pictures),
        "Splits": _splits(found.splits, found.shared),
        "Contact sheet": [
            Gallery(
                [pictures.tile(at, [_short(contents, at)]) for at in part.shown],
                f"{name}: {part.name} ({part.images} images)" if len(parts) > 1 else name,
                _SMALL_REM,
            )
            for name, parts in strata(contents)
            for part in parts
        ],
        "Distributions": _distributions(found.distributions),
    }
    return [Section(before + heading, *content) for heading, content in sections.items()]


def _contents(found: Inspection) -> list[Content]:
    """Tell what a dataset consists of: licence, kinds of pictures, and how many images each group has."""
    c, spec = found.contents, found.contents.folder.dataset.get("spec")
    entry = next((c.entry(at) for at in range(len(c)) if c.names[at]), None)
    rows = [("licence", str((spec if isinstance(spec, dict) else {}).get("licence") or "none is stated"))]
    if entry is not None:
        kinds = [key.removesuffix("_file_name") for key in FILE_KEYS[1:] if entry.line.get(key) is not None]
        rows += [("labels as pictures", ", ".join(kinds) or "none"), ("bits", str(entry.line.get("bit_depth")))]
    sizes = [c.columns.get(f"{LABEL}window {name} (px)", np.zeros(0)) for name in ("width", "height")]
    rows.append(
        ("sizes", ", ".join(f"{w:.0f} x {h:.0f} px" for w, h in sorted(set(zip(*sizes, strict=False)))[:_NAMED]))
    )
    for name, values in c.groups.items():
        counts = list(counts_of(values).items())
        more = f" and {len(counts) - _NAMED} more" if len(counts) > _NAMED else ""
        rows.append((name, ", ".join(f"{value or '-'}: {n}" for value, n in counts[:_NAMED]) + more))
    return [Table(("what", "images that were read"), rows, wide=(1,))]


def _worst(found: Inspection, pictures: _Pictures) -> list[Content]:
    if not found.worst:
        return ["No picture has such figures."]
    tiles = [pictures.tile(w.at, [found.name(w.at), f"{w.figure}: {w.value:.3g}"]) for w in found.worst]
    return [
        "The worst pictures by simple figures. They may be meant: look whether you want to train on them.",
        Gallery(tiles),
    ]


def _faults(found: Inspection, pictures: _Pictures) -> list[Content]:
    faults = found.faults()
    if not faults:
        return ["None was found."]
    listed = [(kind, found.name(at), detail) for kind, own in faults.items() for at, detail in own[:100]]
    return [
        Table(("fault", "images", "meaning"), [(k, str(len(own)), KINDS[k]) for k, own in faults.items()], wide=(2,)),
        "Labels on the pictures:",
        Key([(colour, part) for part, colour in _MARKS.items()]),
        Gallery(_fault_tiles(found, faults, pictures)),
        Table(("fault", "image", "what was found"), listed, "List of faults, up to 100 of each kind", (1, 2), True),
    ]


def _listed(shares: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {share:.1%}" for name, share in shares.items())


def _dependences(found: Sequence[Dependence] | None) -> list[Content]:
    if found is None:
        return [f"Not tested, which needs {SUBJECTS} subjects."]
    rows = [(a, b, f"{rho:+.2f}", f"{p:.1e}", "yes" if ok else "no") for a, b, rho, p, ok in found]
    count = sum(not own.declared for own in found)
    text = f"{count or 'No'} pairs of draws and labels depend on each other without being declared to."
    header = ("number", "number", "rank correlation", "p of the page", "declared")
    return [text, Table(header, rows, "Pairs that depend on each other", wide=(0, 1), folded=True) if rows else None]


def _missing(found: Inspection) -> list[Content]:
    rows = [
        (", ".join(names), f"{share:.1%}", cause or "-", f"{rho:+.2f}") for names, share, cause, rho in found.missing
    ]
    if not rows:
        return ["No label is missing in more than 2 % of the images."]
    return [Table(("labels", "missing in", "depends most on", "rank correlation"), rows, wide=(0, 2))]


def _fault_tiles(found: Inspection, faults: Mapping[str, list[tuple[int, str]]], pictures: _Pictures) -> list[Picture]:
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


def _outliers(found: Inspection, pictures: _Pictures) -> list[Content]:
    if not found.outliers:
        return ["No image is unusual."]
    tiles = []
    for o in found.outliers:
        lines = [found.name(o.at), *(f"{r.column}: {r.value:.4g}; {r.usual}" for r in o.reasons)]
        tiles.append(pictures.tile(o.at, lines, marked=True))
    return [
        "The images with the most unusual numbers. A number is unusual alone if it is far from the middle 98 % of its "
        "column, or together with the other numbers of its image if these suggest another value. Outliers of a sound "
        "dataset are rare, not wrong.",
        Gallery(tiles),
    ]


def _duplicates(found: Inspection, pictures: _Pictures) -> list[Content]:
    splits = found.contents.groups.get("split")
    listed = [(group[0], group[1], f"{len(group)} equal") for group in found.equal[:_PAIRS]]
    listed += [(p.first, p.second, f"correlation {p.correlation:.5f}") for p in found.near[:_PAIRS]]
    pairs = []
    for first, second, text in listed:
        names = [found.name(at) + ("" if splits is None else f" ({splits[at]})") for at in (first, second)]
        pairs.append((pictures.drawn(first) + pictures.drawn(second), [text, *names]))
    return [
        f"{_equal(found)} pictures have the same pixels as an earlier one, and {len(found.near)} pairs differ by "
        "little more than noise or brightness.",
        Gallery(pairs, width_rem=22.0),
    ]


def _short(contents: Contents, at: int) -> str:
    return f"subject {contents.subjects[at]}" if contents.subjects[at] >= 0 else contents.names[at]


def _splits(splits: Mapping[str, tuple[int, set[int]]], shared: Mapping[int, Sequence[str]]) -> list[Content]:
    total = sum(n for n, _ in splits.values())
    rows = []
    for name, (images, subjects) in splits.items():
        per = f"{images / len(subjects):.1f}" if subjects else "-"
        rows.append((name or "-", str(images), f"{images / total:.1%}", str(len(subjects)), per))
    listed = [(str(subject), ", ".join(names)) for subject, names in list(shared.items())[:50]]
    count = f"{len(shared)} subjects are" if shared else "No subject is"
    return [
        Table(("split", "images", "share", "subjects", "images per subject"), rows),
        f"{count} in more than one split.",
        Table(("subject", "splits"), listed) if listed else None,
    ]


def _distributions(distributions: Mapping[str, Distribution]) -> list[Content]:
    """Show histograms by where their numbers are from."""
    out: list[Content] = [
        "Under each histogram: the 1 % quantile, the median and the 99 % quantile. The first and the last bar hold all "
        "beyond."
    ]
    for start, heading in _WHERE.items():
        own = [d for name, d in distributions.items() if name.startswith(start) and len(d.counts)]
        if own:
            drawn = [_histogram(d, d.column.removeprefix(start)) for d in own]
            out.append(Gallery(drawn, heading, _HISTOGRAM_REM))
    constant = [(d.column, f"{d.quantiles[0]:.6g}") for d in distributions.values() if not len(d.counts)]
    if constant:
        out.append(Table(("number", "value"), constant, "Numbers that are the same in all images", folded=True))
    return out


def _histogram(d: Distribution, name: str) -> Picture:
    q = d.quantiles
    lines = [name, f"{q[1]:.4g} … {q[3]:.4g} … {q[5]:.4g}", f"min {q[0]:.4g}, max {q[6]:.4g}"]
    return _bars(name, [d.counts], [ANALYTIC]), lines


def _bars(name: str, parts: Sequence[Ints], colours: Sequence[str]) -> str:
    """Draw histograms of the same bins over each other; the highest bar of all has full height."""
    top = max(max(int(counts.max(initial=0)) for counts in parts), 1)
    paths = []
    for counts, colour in zip(parts, colours, strict=True):
        step = 100 / len(counts)
        points = (
            f"L{k * step:.2f} {40 - h:.2f}L{(k + 1) * step:.2f} {40 - h:.2f}" for k, h in enumerate(39 * counts / top)
        )
        paths.append(f'<path fill="{colour}" fill-opacity=".65" d="M0 40{"".join(points)}L100 40Z"/>')
    return (
        '<svg viewBox="0 0 100 40" preserveAspectRatio="none" role="img" xmlns="http://www.w3.org/2000/svg">'
        f"<title>histogram of {html.escape(name)}</title>{''.join(paths)}</svg>"
    )


def _difference(first: Inspection, second: Inspection, moved: Sequence[Shift]) -> Section:
    """Compare two datasets."""
    a, b = first.contents, second.contents
    beyond = [shift for shift in moved if shift.distance > shift.chance]
    rows = [
        (
            s.column, f"{s.distance:.3f}", f"{s.chance:.3f}", *(f"{m:.4g}" for m in s.medians),
            "{} and {}".format(*s.counts),
        )
        for s in moved
    ]  # fmt: skip
    groups = [
        (name, f"{distance:.3f}", value, f"{one:.1%}", f"{other:.1%}")
        for name, distance, parts in shares(a, b)
        for value, one, other in parts
    ]
    header = ("number", "distance", "by chance", "median, first", "median, second", "counted")
    content: list[Content] = [
        f"{len(beyond)} of {len(moved)} numbers differ by more than chance. The distance of Kolmogorov and Smirnov is "
        "the largest difference of the two cumulative distributions, from 0 to 1. Two samples of one distribution "
        'exceed the distance "by chance" in one case of twenty. Whole subjects are compared, because images of one '
        "subject resemble each other; images are, where a dataset has less than two subjects."
    ]
    if beyond:
        content += [
            Key([(IMAGE, str(a.folder.path)), (ANALYTIC, str(b.folder.path))]),
            "The first and the last bar hold all beyond.",
            Gallery([_both(first, second, shift) for shift in beyond[:_SHIFTS]], width_rem=_HISTOGRAM_REM),
        ]
    content += [
        Table(header, rows, "All numbers that both have", wide=(0,), folded=len(rows) > 20),
        Table(
            ("group", "distance", "value", "first", "second"),
            groups[:100],
            "Shares of groups; the distance is half the sum of the differences",
        ),
    ]
    for own, other in ((a, b), (b, a)):
        names = only_in(own, other)
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        if names:
            content.append(f"Only in {own.folder.path}: {', '.join(names[:_NAMED])}{more}.")
    return Section("Difference of the two", *content)


def _both(first: Inspection, second: Inspection, shift: Shift) -> Picture:
    """Draw histograms of a column in both datasets, with the bins of both."""
    values = [one.contents.columns[shift.column].astype(float) for one in (first, second)]
    values = [v[np.isfinite(v)] for v in values]
    low, high = np.quantile(np.concatenate([np.quantile(v, (0.002, 0.998)) for v in values]), (0, 1))
    edges = np.linspace(low, high if high > low else low + 1, 31)
    # Shares, so that the areas of two datasets of different sizes are equal.
    bars = [np.round(1e6 * binned(v, edges) / len(v)).astype(np.int64) for v in values]
    lines = [shift.column, f"{edges[0]:.4g} … {edges[-1]:.4g}", f"distance {shift.distance:.3f}"]
    return _bars(shift.column, bars, [IMAGE, ANALYTIC]), lines
