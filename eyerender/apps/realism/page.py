"""The page of `realism`: the table, the spread of every statistic, and montages at equal scale and contrast."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ...base.arrays import Bytes
from ...folders.imagefile import png_bytes
from ...report.overlay import picture
from ...report.page import Card, Figure, Page, Section, Table, write_page
from ...report.style import ANALYTIC, IMAGE, figure, svg
from .figures import FIGURES
from .folder import FolderFigures
from .separability import Separability

_COLUMNS, _TILES, _GAP = 4, 24, 6


def write(
    path: Path,
    found: Sequence[FolderFigures],
    ratios: Mapping[str, float | None] | None,
    test: Mapping[str, Separability | None] | None = None,
) -> None:
    """Write the HTML page that compares the folders."""
    title = "How real the pictures look" if len(found) == 1 else f"{len(found)} folders of pictures compared"
    sections = [Section("Figures", _spread(found) if len(found) == 2 else None, _table(found, ratios))]
    if test is not None:
        sections.append(_separability(found, test))
    sections += [Section(f"Pictures of {f.path}", _about(f), _montage(f)) for f in found]
    skipped = [[f.path, s.name, s.reason] for f in found for s in f.skipped[:50]]
    if skipped:
        table = Table(
            header=("folder", "image", "reason"),
            rows=skipped,
            caption="Images that were not measured",
            wide=(2,),
            folded=True,
        )
        sections.append(Section("Not measured", table))
    cards = [Card(f"{len(f.rows)} of {f.images}", f"images of {f.path} measured") for f in found]
    lead = [
        "All figures but noise and clipped pixels are measured in pictures resized so that the iris' radius R is 50 "
        "px; levels are linear, 0 to 255. The values are medians over the images, with the middle half of them in "
        "brackets. eyerender's page on realism defines each figure.",
        *(_encoding(f) for f in found),
    ]
    write_page(path, Page(title, lead, cards, sections))


def _encoding(f: FolderFigures) -> str:
    known = f"{f.path}: gamma {f.gamma:g} ({f.gamma_from}), pupil and iris from: {f.landmarks}."
    if f.gamma_from == "assumed":
        known += " A gamma-encoded source shifts all ratios towards 1; state its gamma where it is known."
    return known


def _about(f: FolderFigures) -> str:
    return (
        "The pictures are shown at equal scale about the iris, with the 98th percentile of each at one grey level and "
        f"linear levels. Shown are {min(len(f.tiles), _TILES)} of {len(f.tiles)}, evenly chosen."
    )


def text(value: float | None) -> str:
    """Format a statistic with three significant digits."""
    return "-" if value is None else f"{value:.3g}"


def _table(found: Sequence[FolderFigures], ratios: Mapping[str, float | None] | None) -> Table:
    header = ["figure", *(f.path for f in found), *(["ratio"] if ratios is not None else []), "definition"]
    rows = []
    for name, meaning in FIGURES.items():
        row = [name, *(_cell(f, name) for f in found)]
        if ratios is not None:
            row.append(text(ratios[name]))
        rows.append([*row, meaning])
    return Table(header, rows, wide=(len(header) - 1,))


def _cell(f: FolderFigures, name: str) -> str:
    values = f.values(name)
    if not values:
        return "-"
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    return f"{text(middle)} [{text(low)}, {text(high)}], n {len(values)}"


def _separability(found: Sequence[FolderFigures], test: Mapping[str, Separability | None]) -> Section:
    """Describe how well a classifier tells the folders apart, with the most revealing patches."""
    rows, figures = [], []
    for kind, result in test.items():
        if result is None:
            rows.append([kind, "-", "-", "too few images"])
            continue
        low, high = result.interval
        rows.append([kind, f"{result.auc:.2f}", f"{low:.2f} to {high:.2f}", "{} and {}".format(*result.images)])
        for f, shown in zip(found, result.revealing, strict=True):
            figures.append(_enlarged(montage(shown, len(shown)), f"{kind}: most typical of {f.path}"))
    table = Table(("patch", "area under the ROC curve", "90 % interval", "images"), rows)
    text = (
        "A classifier was trained on patches of some images and asked to which folder those of other images belong; .5 "
        "is chance, 1 is certainty. All patches have equal scale, blur, compression and noise. Read it beside the "
        "same test of two folders of real frames of different cameras. The patches shown reveal their folder most."
    )
    return Section("Can they be told apart?", text, *figures, table)


def _spread(found: Sequence[FolderFigures]) -> Figure | None:
    """Plot the middle half of the images of both folders, relative to the median of the second."""
    names = [n for n in FIGURES if all(f.values(n) for f in found) and (found[1].median(n) or 0) > 0]
    if not names:
        return None
    with figure(8.4, 0.34 * len(names) + 1.2) as (fig, ax):
        for k, (f, colour) in enumerate(zip(found, (IMAGE, ANALYTIC), strict=True)):
            for row, name in enumerate(names):
                base = found[1].median(name) or 1.0
                low, middle, high = np.maximum(np.quantile(f.values(name), (0.25, 0.5, 0.75)) / base, 0.02)
                y = row - 0.14 + 0.28 * k
                ax.plot([low, high], [y, y], color=colour, lw=3, solid_capstyle="butt")
                label = f.path if row == 0 else None
                ax.plot([middle], [y], "o", color=colour, ms=5, mec="white", mew=0.5, label=label)
        ax.axvline(1, color="#888888", lw=0.8)
        ax.set(xscale="log", ylim=(len(names) - 0.5, -0.5), xlabel=f"value over the median of {found[1].path}")
        ax.set_yticks(range(len(names)), names)
        fig.legend(loc="outside upper center", ncols=2, frameon=False)
        return Figure(svg(fig), "Medians (dots) and the middle half of the images (bars).")


def _montage(f: FolderFigures) -> Figure | None:
    if not f.tiles:
        return None
    count = min(len(f.tiles), _TILES)
    sheet = montage([f.tiles[k * len(f.tiles) // count] for k in range(count)])
    return _enlarged(sheet, f.path, 1)


def _enlarged(sheet: Bytes, caption: str, times: int = 3) -> Figure:
    height, width = sheet.shape
    return Figure(picture(png_bytes(sheet), "png", (width, height), width=times * width, title=caption), caption)


def montage(tiles: Sequence[Bytes], columns: int = _COLUMNS) -> Bytes:
    """Arrange tiles of equal size in rows."""
    height, width = tiles[0].shape
    columns = min(columns, len(tiles))
    rows = -(-len(tiles) // columns)
    shape = (rows * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP)
    sheet = np.full(shape, 255, dtype=np.uint8)
    for k, tile in enumerate(tiles):
        y, x = k // columns * (height + _GAP), k % columns * (width + _GAP)
        sheet[y : y + height, x : x + width] = tile
    return sheet
