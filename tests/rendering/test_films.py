"""Folders of sequences as videos and as BIDS: exact frames, times and truth."""

from __future__ import annotations

import csv
import gzip
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

import eyerender as er
from eyerender.apps.benchmark.folder import load_labelled
from eyerender.base.errors import InputError
from eyerender.dataset.export import export
from eyerender.dataset.export.item import Item
from eyerender.dataset.export.recordings import Recordings, moment_of
from eyerender.folders.imagefolder import ImageFolder
from eyerender.folders.video import VideoReader
from tests.support.sequences import in_time

SEQUENCE = {
    "duration_s": 0.08,
    "seed": 3,
    "gaze": {"field_deg": [12, 8], "distance_mm": 600, "fixation_ms": 60},
    "timestamps": {"meaning": "end", "jitter_ms": 0.1, "dropped_share": 0.2},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory, renderer):
    """A folder of frames of two cameras, 97 x 64 px, at 100 and 50 Hz."""
    scene = in_time("headset", SEQUENCE)
    (camera,) = scene.spec.to_mapping()["rig"]["cameras"]
    one = {**camera, "focal_length_px": 120, "principal_point_px": None, "resolution_px": [97, 64]}
    cameras = [one, {**one, "name": "slow", "frame_rate_hz": 50.0}]
    screen = {"centre_mm": [600, 0, 0], "size_mm": [500, 300]}
    small = {"image": {"spp": 1}, "rig.cameras": cameras, "rig.screen": screen, "sensor.bit_depth": 12}
    path = tmp_path_factory.mktemp("film") / "folder"
    er.render_folder(scene.with_(small), path)
    return path


@pytest.fixture(scope="module")
def entries(folder):
    """The frames of each camera."""
    found = list(ImageFolder.load(folder))
    return {k: [entry for entry in found if entry.records[0]["camera"] == k] for k in (0, 1)}


def frames_of(path, *, grey16=False):
    """Decode a video with OpenCV."""
    options = [cv2.CAP_PROP_CONVERT_RGB, 0]
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, options if grey16 else [])
    out = []
    while (got := video.read())[0]:
        out.append(got[1])
    return out


def rows_of(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("bits", [8, 16])
def test_a_lossless_video_has_every_frame_bit_by_bit(folder, entries, tmp_path, bits):
    encoding = {"encoding": "stored", "bits": bits}
    export(folder, "video", tmp_path / "out", **encoding)
    for camera, own in entries.items():
        found = frames_of(tmp_path / "out" / f"headset_000000_001/eye0_camera{camera}.mkv", grey16=True)
        assert len(found) == len(own) >= 2
        for picture, entry in zip(found, own, strict=True):
            wanted = entry.image() if bits == 16 else np.round(entry.image() * (255 / 4095)).astype(np.uint8)
            assert picture.shape == (64, 98)  # an even width
            assert picture.dtype == wanted.dtype
            np.testing.assert_array_equal(picture[:, :97], wanted)


def test_times_and_truth_lie_beside_a_video(folder, entries, tmp_path):
    export(folder, "video", tmp_path / "out", speed=0.1)
    place = tmp_path / "out" / "headset_000000_001"
    reader = VideoReader(place / "eye0_camera0.mkv")
    assert reader.frames_per_s == 100.0
    stem = str(place / "eye0_camera0")
    times, truth = (rows_of(f"{stem}_{name}.csv") for name in ("timestamps", "truth"))
    records = [entry.records[0] for entry in entries[0]]
    assert [float(row["time_s"]) for row in times] == [record["time_s"] for record in records]
    stored = [entry.line["timestamp_s"] for entry in entries[0]]
    assert [float(row["timestamp_s"]) for row in times] == stored
    np.testing.assert_array_equal(np.load(f"{stem}_timestamps.npy"), stored)
    assert [row["event"].split("+") for row in truth] == [record["events"] for record in records]
    assert [float(row["azimuth_deg"]) for row in truth] == [record["pose"]["azimuth_deg"] for record in records]
    widths = [entry.labels["pupil"]["stop_diameter_mm"] for entry in entries[0]]
    assert [float(row["pupil_mm"]) for row in truth] == widths
    rows = rows_of(tmp_path / "out" / "recordings.csv")
    assert [(row["file"], int(row["frames"])) for row in rows] == [
        (f"eye0_camera{k}.mkv", len(own)) for k, own in entries.items()
    ]
    assert VideoReader(place / "eye0_camera0_view.mp4").frames_per_s == pytest.approx(10.0)


def test_bids_of_a_folder_is_where_its_labels_say_the_eye_looks(folder, entries, tmp_path):
    export(folder, "bids", tmp_path / "out", screen_px=(1000, 600))
    (table,) = (tmp_path / "out").glob("sub-01/beh/*recording-eye1_physio.tsv.gz")
    rows = [line.split("\t") for line in gzip.decompress(table.read_bytes()).decode().splitlines()]
    assert len(rows) == len(entries[0])
    for row, entry in zip(rows, entries[0], strict=True):
        world = entry.labels["space"]["world"]
        origin, way = np.array(world["line_of_sight_point_mm"]), np.array(world["line_of_sight"])
        point = origin + way * (600 - origin[0]) / way[0]
        wanted = [entry.records[0]["time_s"], 499.5 - 2 * point[1], 299.5 - 2 * point[2]]
        if (entry.labels["pupil"]["visible_fraction"] or 0.0) < 0.1:
            assert row[1:4] == ["n/a"] * 3
        else:
            np.testing.assert_allclose([float(cell) for cell in row[:3]], wanted, atol=1e-5)
    about = json.loads(table.with_suffix("").with_suffix(".json").read_text())
    assert about["SamplingFrequency"] == 100.0
    assert (tmp_path / "out" / ".bidsignore").read_text() == "export.json\n"


def test_a_new_recording_begins_where_time_begins_anew(entries):
    counter, moment = Recordings(), moment_of(Item(entries[0][0]))
    times = (0.0, 0.1, 0.2, 0.0, 0.1, 0.0)
    assert [counter.number(replace(moment, time_s=t)) for t in times] == [1, 1, 1, 2, 2, 3]
    assert counter.number(replace(moment, subject=1, time_s=0.0)) == 1
    assert counter.number(replace(moment, camera=1, time_s=0.3)) == 1


def test_a_viewing_video_has_the_brightness_of_the_codes(folder, entries, tmp_path):
    export(folder, "video", tmp_path / "out", encoding="stored", bits=16, speed=0.001)
    found = frames_of(tmp_path / "out" / "headset_000000_001/eye0_camera0_view.mp4")
    assert len(found) == len(entries[0])
    for picture, entry in zip(found, entries[0], strict=True):
        assert picture[:, :97].mean() == pytest.approx(entry.image().mean() / 4095 * 255, abs=4)


def test_exports_of_sequences_refuse_what_they_cannot_write(folder, entries, tmp_path):
    line = json.loads(json.dumps(entries[0][0].line))
    line["records"][0]["events"] = None
    with pytest.raises(InputError, match="shows no frame of a sequence"):
        moment_of(Item(replace(entries[0][0], line=line)))
    for options, words in (({"shuffle": 1}, "have an order"), ({"speed": 0.0}, "must be 0.001 to 100")):
        with pytest.raises(InputError, match=words):
            export(folder, "video", tmp_path / "out", **options)
    with pytest.raises(InputError, match="must be 1 to 65536"):
        export(folder, "bids", tmp_path / "out", screen_px=(0, 600))
    assert not (tmp_path / "out").exists()


def test_the_benchmark_knows_what_the_eye_does_in_each_frame(folder, entries):
    images = {image.name: image for image in load_labelled(folder)}
    for entry in (*entries[0], *entries[1]):
        conditions, events = images[entry.name].conditions, set(entry.records[0]["events"])
        for word in ("saccade", "oscillation"):
            assert (word in conditions) == (word in events)
        assert ("fixation" in conditions) == (events == {"fixation"})
