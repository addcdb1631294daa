"""Faults that are planted into a sound dataset, each of which an inspection must find where it was planted."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eyerender.apps.inspection import inspect
from eyerender.folders.imagefile import read_image, write_png
from tests.support.drawn_dataset import draw

ROWS = 400


class Planter:
    """Changes files and lines of a dataset, each fault in images of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.lines: list[Any] = [json.loads(line) for line in (folder / "metadata.jsonl").read_text().splitlines()]
        self.planted: dict[str, tuple[str, str]] = {}

    def picture(self, row: int, kind: str = "images") -> Path:
        return self.folder / kind / f"{row:08d}-right.png"

    def repaint(self, row: int, change: Any, kind: str = "images") -> None:
        write_png(self.picture(row, kind), np.ascontiguousarray(change(read_image(self.picture(row, kind))[0])))

    def note(self, fault: str, row: int, kind: str) -> None:
        """Say that a fault of a row must be found as `kind`, or as an outlier where it is `outlier`."""
        self.planted[fault] = (f"images/{row:08d}-right.png", kind)

    def save(self) -> None:
        texts = [line if isinstance(line, str) else json.dumps(line) for line in self.lines]
        (self.folder / "metadata.jsonl").write_text("".join(text + "\n" for text in texts))


def plant_in_files(p: Planter) -> None:
    p.repaint(11, np.zeros_like)
    p.note("black picture", 11, "black")
    p.repaint(22, lambda a: np.full_like(a, 255))
    p.note("white picture", 22, "white")
    p.repaint(33, lambda a: np.full_like(a, 120))
    p.note("flat picture", 33, "flat")
    p.repaint(44, lambda a: a[:-4])
    p.note("picture of another size", 44, "size")
    p.picture(55).write_bytes(p.picture(55).read_bytes()[:500])
    p.note("truncated picture", 55, "file")
    p.picture(66).unlink()
    p.note("missing picture", 66, "file")
    p.picture(77, "masks").unlink()
    p.note("missing mask", 77, "mask")
    p.lines[88]["mask_file_name"] = None
    p.note("no mask", 88, "mask")
    p.repaint(99, lambda a: a[:, 3:], "masks")
    p.note("mask of another size", 99, "size")
    p.repaint(110, lambda a: np.where(a == 3, 7, a), "masks")
    p.note("unknown class", 110, "mask")
    p.picture(121, "masks").write_bytes(p.picture(122, "masks").read_bytes())
    p.note("mask of another image", 121, "mask and labels")
    p.picture(132).write_bytes(p.picture(131).read_bytes())
    p.note("picture of another image", 132, "same picture")
    noise = np.random.default_rng(0).normal(0, 2, (72, 96))
    brighter = np.clip(0.9 * read_image(p.picture(142))[0] + noise, 0, 255).astype(np.uint8)
    write_png(p.picture(143), brighter)
    p.note("the same picture with other noise and brightness", 143, "near-duplicate")
    p.repaint(154, lambda a: 255 - a)
    p.note("inverted picture", 154, "outlier")
    p.repaint(165, lambda a: a[:, ::-1])
    p.note("mirrored picture", 165, "outlier")


def plant_in_lines(p: Planter) -> None:
    a, b = p.lines[170], p.lines[171]
    a["labels"], b["labels"] = b["labels"], a["labels"]
    a["records"][0]["pupil"], b["records"][0]["pupil"] = b["records"][0]["pupil"], a["records"][0]["pupil"]
    a["records"][0]["glints"], b["records"][0]["glints"] = b["records"][0]["glints"], a["records"][0]["glints"]
    p.note("swapped labels", 170, "mask and labels")
    p.lines[180] = json.dumps(p.lines[180]).replace('"stop_diameter_mm": ', '"stop_diameter_mm": NaN, "x": ', 1)
    p.planted["NaN label"] = ("line 181", "line")
    for place in (p.lines[190]["labels"]["pupil"]["amodal"], p.lines[190]["records"][0]["pupil"]):
        place["centre_px"] = [place["centre_px"][0] + 8, place["centre_px"][1]]
    p.note("pupil's label off", 190, "pupil")
    p.lines[200]["labels"]["pupil"]["amodal"]["centre_px"] = None
    p.note("missing pupil", 200, "label")
    p.lines[210]["labels"]["glints"][1]["spot_xy_px"] = [3.0, 3.0]
    p.note("glint elsewhere", 210, "glint")
    p.lines[220]["labels"]["space"]["camera"]["line_of_sight"] = [0.0, 0.0, -0.5]
    p.note("gaze of half a length", 220, "label")
    gaze = p.lines[231]["labels"]["space"]["camera"]["line_of_sight"]
    p.lines[231]["labels"]["space"]["camera"]["line_of_sight"] = [-gaze[0], gaze[1], gaze[2]]
    p.note("gaze to the other side", 231, "outlier")
    p.lines[240]["parameters"]["draws"]["sensor.exposure_ms"] = 5000.0
    p.note("exposure in us", 240, "outlier")
    for line in p.lines[250:255]:
        line["split"] = "test" if line["split"] != "test" else "train"
    p.note("subject in two splits", 250, "subject in two splits")
    p.lines[260]["records"][0]["frame"] = p.lines[261]["records"][0]["frame"] = 260
    p.note("frame twice", 261, "same frame")
    p.lines[270]["file_name"] = "images/00000271-right.png"
    p.note("file twice", 271, "same frame")
    for outline in (p.lines[280]["labels"]["pupil"]["amodal"], p.lines[280]["records"][0]["pupil"]):
        outline["centre_px"] = [-20.0, 30.0]
    p.note("pupil outside of the picture", 280, "pupil outside")
    p.lines[290]["labels"] = []
    p.note("no labels", 290, "line")
    p.lines[300] = json.dumps(p.lines[300])[:700]
    p.planted["line cut off"] = ("line 301", "line")
    p.lines[310]["labels"]["pupil"]["visible_fraction"] = 1.4
    p.note("share above 1", 310, "label")


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """What was planted, and what an inspection found."""
    folder = tmp_path_factory.mktemp("planted") / "data"
    draw(folder, ROWS)
    planter = Planter(folder)
    plant_in_files(planter)
    plant_in_lines(planter)
    planter.save()
    page = folder.parent / "page.html"
    return planter.planted, inspect(folder, output=page), page


def test_every_planted_fault_is_found_where_it_is(found):
    planted, data, _ = found
    (own,) = data["datasets"]
    outliers = {outlier["image"] for outlier in own["outliers"]}
    faults = {(image["image"], kind) for kind, f in own["faults"].items() for image in f["images"]}
    assert len(planted) >= 20
    missed = [
        fault
        for fault, (name, kind) in planted.items()
        if not (name in outliers if kind == "outlier" else (name, kind) in faults)
    ]
    assert missed == []


def test_nothing_else_is_found(found):
    """An image without a planted fault has none: the others are twins of one that has."""
    planted, data, _ = found
    (own,) = data["datasets"]
    known = {name for name, _ in planted.values()} | {f"images/{row:08d}-right.png" for row in (171,)}
    for kind, faults in own["faults"].items():
        assert [image for image in faults["images"] if image["image"] not in known] == [], kind


def test_the_page_shows_faults_and_outliers(found):
    _, data, page = found
    text = page.read_text()
    assert re.findall(r'(?:src|href)="(?!data:|#)[^"]*', text) == []
    (own,) = data["datasets"]
    assert text.count('<div class="picture">') > len(own["outliers"]) + 20
    assert own["outliers"][0]["image"] in text


def test_a_sound_dataset_has_no_faults(tmp_path):
    draw(tmp_path / "data", 120)
    (own,) = inspect(tmp_path / "data")["datasets"]
    assert own["faults"] == {}
    assert own["subjects_in_two_splits"] == {}


def test_labels_that_are_missing_are_reported_with_their_cause(tmp_path):
    """The outline of the iris is taken away where the eye looks to the right by more than 12 degrees."""
    draw(tmp_path / "data", 120)
    planter = Planter(tmp_path / "data")
    gone = [line for line in planter.lines if line["records"][0]["pose"]["azimuth_deg"] < -12]
    for line in gone:
        line["labels"]["iris"]["amodal"] |= {"status": "missing", "centre_px": None, "semi_axes_px": None}
    planter.save()
    (own,) = inspect(tmp_path / "data")["datasets"]
    (missing,) = own["missing"]
    assert missing["share"] == pytest.approx(len(gone) / 120)
    assert "label iris x (px)" in missing["labels"]
    assert missing["depends_on"] in ("label eye azimuth (deg)", "label gaze yaw (deg)")
    assert abs(missing["rank_correlation"]) > 0.6


def test_shares_are_those_of_the_labels(tmp_path):
    draw(tmp_path / "data", 120)
    planter = Planter(tmp_path / "data")
    nowhere = {"centre_px": None, "semi_axes_px": None, "angle_rad": None, "pixels": 0, "cut": False}
    margins = {lid: [[float(x), y] for x in range(5)] for lid, y in (("upper", 20.0), ("lower", 40.0))}
    for row, line in enumerate(planter.lines):
        blink = (0.0, 0.1, 0.5, 1.0)[row % 4]
        line["labels"] |= {"lid_margins_px": margins, "eye_present": row % 10 > 0}
        line["parameters"]["scene_json"] = json.dumps({"region": {"blink": blink}})
        if row % 4 == 3:
            line["labels"]["pupil"] |= {"visible_fraction": None, "visible": nowhere}
    planter.save()
    (own,) = inspect(tmp_path / "data")["datasets"]
    poses = [line["records"][0]["pose"] for line in planter.lines]
    cosines = [np.cos(np.radians([p["azimuth_deg"], p["elevation_deg"]])).prod() for p in poses]
    ends = [0, 10, 20, 35, 180]
    gaze = np.histogram(np.degrees(np.arccos(cosines)), ends)[0] / 120
    assert list(own["shares"]["gaze"].values()) == pytest.approx(gaze.tolist())
    assert own["shares"]["lids"] == {"open": 0.5, "half shut": 0.25, "shut": 0.25}
    assert own["shares"]["pupil"] == {"hidden": 0.25, "half hidden": 0.0, "visible": 0.75}
    assert own["shares"]["eye"] == {"none": 0.1, "there": 0.9}
    assert own["shares"]["saturated pixels"] == {"to 20 %": 1.0, "more": 0.0}
