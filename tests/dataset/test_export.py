"""Exports, each read back with the loader that training code uses, where there is one."""

from __future__ import annotations

import csv
import io
import json
import os
import resource
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image
from scipy.io import loadmat

from eyerender.apps.benchmark.folder import load_labelled
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.dataset.assemble import type_first
from eyerender.dataset.export import FORMATS, export, parquet
from eyerender.dataset.export.coco import run_lengths
from eyerender.dataset.export.gaze import yaw_pitch_deg
from eyerender.dataset.export.video import LosslessVideo
from eyerender.folders.imagefile import read_image, write_png
from eyerender.folders.imagefolder import ImageFolder
from eyerender.optics.ellipse import Ellipse, iou

pytestmark = pytest.mark.render
SPLITS = {"train": 12, "validation": 6, "test": 6}


@pytest.fixture(scope="module")
def lines(tiny):
    return {entry.path.stem: entry.line for entry in ImageFolder.load(tiny).entries}


@pytest.fixture(scope="module")
def exported(tiny, tmp_path_factory):
    """Format -> its folder, made when asked for."""
    place = tmp_path_factory.mktemp("export")

    def made(format):
        folder = place / format
        if not folder.exists():
            assert export(tiny, format, folder)["images"] == 24
        return folder

    return made


def eight_bit(tiny, line, folder):
    """What export.json says an image of the export is."""
    how = json.loads((folder / "export.json").read_text())["image"]
    assert (how["bits"], how["encoding"], how["gamma"]) == (8, "gamma", 2.2)
    share = np.asarray(Image.open(tiny / line["file_name"])) / 65535
    return np.round(255 * np.minimum(1, how["gain"] * share) ** (1 / 2.2)).astype(np.uint8)


def local(line, xy):
    return np.array(xy) - [line["window_px"]["x0"], line["window_px"]["y0"]]


def test_webdataset_reads_it(tiny, exported, lines):
    import webdataset as wds

    folder = exported("webdataset")
    for split, count in SPLITS.items():
        url = f"{folder}/{split}-000000.tar"
        samples = list(wds.WebDataset(url, shardshuffle=False, empty_check=False))
        assert len(samples) == count
        for sample in samples:
            line = json.loads(sample["json"])
            source = lines[sample["__key__"]]
            own = {key: line[key] for key in ("bit_depth", "encoding", "gamma", "gain", "source_bit_depth")}
            assert line == {**source, **own}
            assert (own["bit_depth"], own["encoding"], own["gamma"]) == (8, "gamma", 2.2)
            assert own["source_bit_depth"] == 16
            assert line["split"] == split
            picture = np.asarray(Image.open(io.BytesIO(sample["png"])))
            np.testing.assert_array_equal(picture, eight_bit(tiny, source, folder))
            assert sample["mask.png"] == (tiny / line["mask_file_name"]).read_bytes()
        decoded = next(iter(wds.WebDataset(url, shardshuffle=False, empty_check=False).decode("pil")))
        assert decoded["json"]["split"] == split


def test_coco_masks_come_back(tiny, exported, lines):
    from pycocotools import coco

    folder = exported("coco")
    for split, count in SPLITS.items():
        data = coco.COCO(folder / "annotations" / f"instances_{split}.json")
        assert len(data.imgs) == count
        names = {c["id"]: c["name"] for c in data.loadCats(data.getCatIds())}
        for number, info in data.imgs.items():
            line = lines[Path(info["file_name"]).stem]
            assert line["split"] == split
            picture = np.asarray(Image.open(folder / split / info["file_name"]))
            np.testing.assert_array_equal(picture, eight_bit(tiny, line, folder))
            mask, _ = read_image(tiny / line["mask_file_name"])
            glints = 0
            for mark in data.loadAnns(data.getAnnIds(imgIds=[number])):
                name = names[mark["category_id"]]
                if name == "glint":
                    spot = local(line, line["labels"]["glints"][mark["light"]]["xy_px"])
                    np.testing.assert_allclose(mark["keypoints"][:2], spot, atol=1e-9)
                    glints += 1
                    continue
                inside = data.annToMask(mark).astype(bool)
                np.testing.assert_array_equal(inside, mask == mark["category_id"])
                assert mark["area"] == inside.sum()
                x, y, w, h = mark["bbox"]
                assert inside[y : y + h, x : x + w].sum() == inside.sum()
                if name in ("pupil", "iris"):
                    centre = line["labels"][name]["amodal"]["centre_px"]
                    np.testing.assert_allclose(mark["ellipse"][:2], local(line, centre))
            assert glints == 2


def test_coco_images_have_their_gaze(exported, lines):
    for path in sorted((exported("coco") / "annotations").glob("instances_*.json")):
        for image in json.loads(path.read_text())["images"]:
            labels = lines[Path(image["file_name"]).stem]["labels"]
            space = labels["space"]["camera"]
            assert image["line_of_sight"] == space["line_of_sight"]
            assert image["optic_axis"] == space["optic_axis"]
            assert image["pupil_entrance_diameter_mm"] == labels["pupil"]["entrance_diameter_mm"]
            # Towards the camera: the angle between gaze and the camera's axis is small, and so are yaw and pitch.
            yaw, pitch = (np.radians(image[f"line_of_sight_{angle}_deg"]) for angle in ("yaw", "pitch"))
            assert np.cos(pitch) * np.cos(yaw) == pytest.approx(-space["line_of_sight"][2], abs=1e-12)


def test_yaw_and_pitch_are_zero_towards_the_camera_and_positive_to_the_left_and_up():
    """In the camera's frame x is right and y is down, so a gaze to the image's left and up has negative x and y."""
    s = np.sin(np.radians(30))
    c = np.cos(np.radians(30))
    assert yaw_pitch_deg([0, 0, -1]) == (0, 0)
    assert yaw_pitch_deg([-s, 0, -c]) == pytest.approx((30, 0))
    assert yaw_pitch_deg([0, -s, -c]) == pytest.approx((0, 30))


def test_run_lengths_of_corners():
    assert run_lengths(np.zeros((2, 3), bool)) == [6]
    assert run_lengths(np.ones((2, 3), bool)) == [0, 6]
    assert run_lengths(np.array([[0, 1], [1, 1]], bool)) == [1, 3]


def test_csv_rows(tiny, exported, lines):
    folder = exported("csv")
    with open(folder / "labels.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 24
    for row in rows:
        line = lines[Path(row["file_name"]).stem]
        assert (row["bit_depth"], row["encoding"], row["source_bit_depth"]) == ("8", "gamma", "16")
        picture, depth = read_image(folder / row["file_name"])
        assert depth == 8
        np.testing.assert_array_equal(picture, eight_bit(tiny, line, folder))
        mask = (folder / row["mask_file_name"]).read_bytes()
        assert mask == (tiny / line["mask_file_name"]).read_bytes()
        centre = local(line, line["labels"]["pupil"]["amodal"]["centre_px"])
        assert [float(row["pupil_amodal_x_px"]), float(row["pupil_amodal_y_px"])] == centre.tolist()
        assert float(row["camera_target_mm_z"]) == line["labels"]["space"]["camera"]["target_mm"][2]
        assert int(row["subject"]) == line["subject"]
        for name in ("line_of_sight", "optic_axis"):
            yaw, pitch = (np.radians(float(row[f"{name}_{angle}_deg"])) for angle in ("yaw", "pitch"))
            # The inverse that MPIIGaze's code has.
            vector = [-np.cos(pitch) * np.sin(yaw), -np.sin(pitch), -np.cos(pitch) * np.cos(yaw)]
            np.testing.assert_allclose([float(row[f"camera_{name}_{axis}"]) for axis in "xyz"], vector, atol=1e-12)
        pupil = line["labels"]["pupil"]
        assert float(row["pupil_entrance_diameter_mm"]) == pupil["entrance_diameter_mm"]
        assert float(row["pupil_stop_diameter_mm"]) == pupil["stop_diameter_mm"] == float(row["pupil_diameter_mm"])
    card = (folder / "README.md").read_text()
    assert "atan2(-x, -z)" in card
    assert "camera_line_of_sight_x" in card


def test_hugging_face_reads_parquet_and_its_card(tiny, exported, lines, tmp_path, monkeypatch):
    """The folder as it would be uploaded: the head of the card names the splits and the columns that are pictures."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import datasets

    folder = exported("parquet")
    _, head, text = (folder / "README.md").read_text().split("---\n", 2)
    card = yaml.safe_load(head)
    assert text.startswith("# tiny: parquet")
    read = datasets.load_dataset(str(folder), cache_dir=str(tmp_path / "cache"))
    assert {name: len(rows) for name, rows in read.items()} == SPLITS
    assert datasets.Features._from_yaml_list(card["dataset_info"]["features"]) == read["train"].features
    pictures = [name for name, kind in read["train"].features.items() if isinstance(kind, datasets.Image)]
    assert pictures == ["image", "mask"]
    with open(exported("csv") / "labels.csv", newline="") as file:
        table = {Path(row["file_name"]).stem: row for row in csv.DictReader(file)}
    for split, rows in read.items():
        for row in rows:
            line = json.loads(row["line_json"])
            name = Path(line["file_name"]).stem
            source = lines[name]
            np.testing.assert_array_equal(np.asarray(row["image"]), eight_bit(tiny, source, folder))
            np.testing.assert_array_equal(np.asarray(row["mask"]), read_image(tiny / source["mask_file_name"])[0])
            assert row["split"] == line["split"] == split
            assert line["labels"] == source["labels"]
            for key in row.keys() - {"image", "mask", "line_json"}:
                expected = table[name][key]
                assert (row[key] is None and expected == "") or type(row[key])(expected) == row[key]


def test_parquet_files_load_without_the_card(exported, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import datasets

    files = {split: str(exported("parquet") / "data" / f"{split}-*.parquet") for split in SPLITS}
    read = datasets.load_dataset("parquet", data_files=files, cache_dir=str(tmp_path))
    assert {name: len(rows) for name, rows in read.items()} == SPLITS
    assert np.asarray(read["test"][0]["image"]).shape == (72, 96)  # the files say which columns are pictures


def test_parquet_files_and_groups_of_rows_are_limited(tiny, tmp_path, monkeypatch):
    from pyarrow.parquet import ParquetFile

    monkeypatch.setattr(parquet, "IMAGES_A_FILE", 5)
    monkeypatch.setattr(parquet, "IMAGES_A_GROUP", 2)
    export(tiny, "parquet", tmp_path / "out")
    files = sorted((tmp_path / "out" / "data").glob("train-*"))
    assert [file.name for file in files] == [f"train-{k:05d}-of-00003.parquet" for k in range(3)]
    sizes = []
    for place in files:
        found = ParquetFile(place)
        sizes.append([found.metadata.row_group(k).num_rows for k in range(found.num_row_groups)])
    assert sizes == [[2, 2, 1], [2, 2, 1], [2]]
    monkeypatch.setattr(parquet, "BYTES_A_GROUP", 1)
    export(tiny, "parquet", tmp_path / "small")
    found = ParquetFile(tmp_path / "small" / "data" / "test-00000-of-00002.parquet")
    assert found.num_row_groups == 5


def test_openeds_reads_it(tiny, exported):
    """As RITnet's loader goes about it: names from images/, stripped, labels/NAME.npy resized to the picture."""
    folder = exported("openeds")
    with open(folder / "files.csv", newline="") as file:
        origin = {row["file"]: row["from"] for row in csv.DictReader(file)}
    for split, count in SPLITS.items():
        names = [f.strip(".png") for f in os.listdir(folder / split / "images") if f.endswith(".png")]
        assert len(names) == count
        for name in names:
            picture = Image.open(folder / split / "images" / f"{name}.png").convert("L")
            label = np.load(folder / split / "labels" / f"{name}.npy")
            label = np.resize(label, (picture.height, picture.width))
            source = origin[f"{split}/images/{name}.png"]
            np.testing.assert_array_equal(label, read_image(tiny / source.replace("images", "masks"))[0])
            assert label.dtype == np.uint8


def test_ellseg_reads_it(tiny, exported, lines):
    """As EllSeg's loader goes about it: key files name archives, archives are read by index."""
    import h5py

    folder = exported("ellseg")
    keys = sorted(os.listdir(folder / "MasterKey"))
    assert keys == [f"tiny_{s}.mat" for s in sorted(SPLITS)]
    for name in keys:
        key = loadmat(folder / "MasterKey" / name)
        count = np.size(key["archive"])
        assert key["dataset"].item() == "tiny"
        assert key["subset"].item() in SPLITS
        assert count == SPLITS[key["subset"].item()]
        assert key["resolution"].tolist() == [[72, 96]] * count
        with h5py.File(folder / "All" / f"{key['archive'].reshape(-1)[0]}.h5") as file:
            for k in range(count):
                line = lines[Path(file["Info"][k].decode()).stem]
                assert line["split"] == key["subset"].item()
                np.testing.assert_array_equal(file["Images"][k, ...], eight_bit(tiny, line, folder))
                mask = read_image(tiny / line["mask_file_name"])[0]
                np.testing.assert_array_equal(file["Masks"][k, ...], mask)
                # Nothing stands before these eyes: the whole outlines differ in a few pixels of their edges.
                assert np.mean(file["Masks_noSkin"][k, ...] != mask) < 0.01
                for part in ("pupil", "iris"):
                    amodal = line["labels"][part]["amodal"]
                    fit = [*local(line, amodal["centre_px"]), *amodal["semi_axes_px"], amodal["angle_rad"]]
                    np.testing.assert_allclose(file["Fits"][part][k, ...], fit)
                np.testing.assert_allclose(key["pupil_loc"][k], file["Fits"]["pupil"][k, :2])


def test_teyed_reads_it(tiny, exported, lines):
    """Videos through OpenCV, text files line by line; a pupil drawn as OpenCV reads the ellipse covers the mask."""
    folder = exported("teyed")
    with open(folder / "splits.csv", newline="") as file:
        videos = list(csv.DictReader(file))
    assert sum(int(v["frames"]) for v in videos) == 24
    by_subject: dict[int, list] = {}
    for name in sorted(lines):
        by_subject.setdefault(lines[name]["subject"], []).append(lines[name])
    for video in videos:
        frames = by_subject[int(video["subject"])]
        assert video["split"] == frames[0]["split"]
        stream = cv2.VideoCapture(str(folder / "VIDEOS" / video["video"]))
        rows = {}
        for kind in ("pupil_eli", "iris_eli", "validity_pupil", "gaze_vec", "eye_ball", "pupil_lm_2D"):
            text = (folder / "ANNOTATIONS" / f"{video['video']}{kind}.txt").read_text().splitlines()
            assert text[0].startswith("FRAME;")
            rows[kind] = [[float(v) for v in line.split(";")[:-1]] for line in text[1:]]
        for k, line in enumerate(frames):
            good, picture = stream.read()
            assert good
            np.testing.assert_array_equal(picture[..., 0], eight_bit(tiny, line, folder))
            frame, angle, x, y, width, height = rows["pupil_eli"][k]
            assert frame == k + 1
            drawn = np.zeros(picture.shape[:2], np.uint8)
            cv2.ellipse(drawn, ((x, y), (width, height), angle), 1, -1)
            mask = read_image(tiny / line["mask_file_name"])[0] == 3
            # OpenCV draws in whole pixels: one pixel more or less along an edge of about 50.
            assert np.count_nonzero((drawn > 0) & mask) / np.count_nonzero((drawn > 0) | mask) > 0.8
            assert np.linalg.norm(rows["gaze_vec"][k][1:]) == pytest.approx(1, abs=1e-5)
            assert rows["validity_pupil"][k] == [k + 1, 1]
            assert len(rows["pupil_lm_2D"][k]) == 2 + 16
        assert not stream.read()[0]


@pytest.mark.parametrize("format", ["coco", "teyed"])
def test_a_bench_scores_answers_about_an_export_as_about_the_dataset(tiny, exported, format):
    """The truth is the same, so the overlap of any answer is."""
    folders = [load_labelled(folder) for folder in (tiny, exported(format))]
    outlines = [
        sorted((i.pupil.numbers() for i in images if i.pupil is not None), key=lambda p: np.round(p[:2], 3).tolist())
        for images in folders
    ]
    assert len(outlines[0]) == len(outlines[1]) > 10
    scores: list[list[float]] = [[], []]
    for kept, numbers in zip(scores, outlines, strict=True):
        for x, y, a, b, angle in numbers:
            # An answer that is about a pixel off; rounded, it is the same for both.
            answer = Ellipse(np.round([x + 1.5, y - 1.0]), np.round([1.1 * a + 2, b + 1]), 0.0)
            kept.append(iou(answer, Ellipse(np.array([x, y]), np.array([a, b]), angle)))
    np.testing.assert_allclose(scores[1], scores[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize(("width", "height"), [(62, 46), (63, 46), (62, 47), (63, 47), (1, 1)])
def test_videos_are_lossless(tmp_path, width, height):
    frames = np.random.default_rng(0).integers(0, 256, (5, height, width), dtype=np.uint8)
    with LosslessVideo(tmp_path / "v.mp4", width, height) as video:
        for frame in frames:
            video.add(frame)
    stream = cv2.VideoCapture(str(tmp_path / "v.mp4"))
    assert stream.get(cv2.CAP_PROP_FRAME_COUNT) == 5
    assert stream.get(cv2.CAP_PROP_FPS) == 25
    for k, frame in enumerate(frames):
        read, picture = stream.read()
        assert read
        assert stream.get(cv2.CAP_PROP_POS_MSEC) == pytest.approx(40 * k)
        assert picture.shape == (height + height % 2, width + width % 2, 3)
        np.testing.assert_array_equal(picture[:height, :width], np.repeat(frame[..., None], 3, axis=-1))
        np.testing.assert_array_equal(picture[-1, -1], frame[-1, -1])


def test_a_video_that_cannot_be_written_is_an_error(tmp_path):
    with pytest.raises(OSError, match=r"OpenCV cannot write a video \(FFV1\) of 62 x 46 pixels to v\.mp4"):
        LosslessVideo(tmp_path / "missing" / "v.mp4", 62, 46)


def test_a_video_cut_short_is_an_error(tmp_path):
    """A limit on the size of files stands for a full disk."""
    frame = np.random.default_rng(0).integers(0, 256, (200, 200), dtype=np.uint8)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    video = LosslessVideo(tmp_path / "v.mp4", 200, 200)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        for _ in range(10):
            video.add(frame)
        with pytest.raises(OSError, match="a video could not be written whole; the disk may be full"):
            video.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_hugging_face_reads_the_folder_as_it_is(tiny, tmp_path, monkeypatch, lines):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import datasets

    read = datasets.load_dataset("imagefolder", data_dir=str(tiny), cache_dir=str(tmp_path))
    assert list(read) == ["train"]  # one split as files go; the column tells the dataset's own
    rows = read["train"]
    assert len(rows) == 24
    for row, line in zip(rows, lines.values(), strict=True):
        assert row["split"] == line["split"]
        assert row["labels"]["pupil"]["amodal"] == line["labels"]["pupil"]["amodal"]
        np.testing.assert_array_equal(np.asarray(row["image"]), read_image(tiny / line["file_name"])[0])
        np.testing.assert_array_equal(np.asarray(row["mask"]), read_image(tiny / line["mask_file_name"])[0])


def test_hugging_face_reads_one_split_by_its_column(tiny, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import datasets

    subjects = {}
    for name, count in SPLITS.items():
        rows = datasets.load_dataset(
            "imagefolder", data_dir=str(tiny), cache_dir=str(tmp_path), split="train", filters=[("split", "==", name)]
        )
        assert rows["split"][:] == [name] * count
        assert np.asarray(rows[0]["image"]).shape == (72, 96)
        subjects[name] = set(rows["subject"])
    assert [len(s) for s in subjects.values()] == [2, 1, 1]
    assert len(set.union(*subjects.values())) == 4


def test_hugging_face_reads_a_reason_that_comes_late(tiny, tmp_path, monkeypatch):
    """Its column types are those of the first 10 MB of lines, where nothing has hidden a glint yet."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import datasets

    folder = tmp_path / "long"
    folder.mkdir()
    for kind in ("images", "masks"):
        (folder / kind).symlink_to(tiny / kind)
    lines = (tiny / "metadata.jsonl").read_text().splitlines(keepends=True)
    lines *= 1 + int(11e6 / sum(len(line) for line in lines))
    last = json.loads(lines[-1])
    assert last["records"][0]["glints"][1]["reason"] is None
    last["records"][0]["glints"][1]["reason"] = "behind the lid"
    lines[-1] = json.dumps(last) + "\n"
    taken: list[dict] = []
    (folder / "metadata.jsonl").write_text("".join(type_first(lambda: lines, taken.append)))
    assert [json.dumps(line) + "\n" for line in taken] == lines
    rows = datasets.load_dataset("imagefolder", data_dir=str(folder), cache_dir=str(tmp_path / "cache"))["train"]
    reasons = [record[0]["glints"][1]["reason"] for record in rows["records"]]
    assert len(reasons) == len(lines)
    assert reasons[:2] == [None, "behind the lid"]
    assert set(reasons[2:]) == {None}


def test_mlcroissant_validates_and_reads_the_description(tiny, lines):
    import mlcroissant

    described = mlcroissant.Dataset(jsonld=str(tiny / "croissant.json"))
    assert not described.metadata.ctx.issues.errors
    records = list(described.records("images"))
    assert len(records) == 24
    for record, line in zip(records, lines.values(), strict=True):
        assert record["images/sample"] == line["sample"]
        assert record["images/file_name"] in (line["file_name"], line["file_name"].encode())


@pytest.mark.parametrize(("format", "library"), [("ellseg", "h5py"), ("parquet", "pyarrow")])
def test_a_layout_without_its_library_is_one_line(tiny, tmp_path, monkeypatch, capsys, format, library):
    monkeypatch.setitem(sys.modules, library, None)
    assert run(["export-dataset", str(tiny), str(tmp_path / "out"), "--format", format]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == (
        f"error: --format {format}: needs {library} (the extra '{format}'); run: pip install {library}"
    )
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_exported_is_refused(tiny, tmp_path):
    with pytest.raises(InputError, match="must be one of webdataset, imagefolder, coco"):
        export(tiny, "zip", tmp_path / "out")
    (tmp_path / "taken").mkdir()
    write_png(tmp_path / "taken" / "a.png", np.zeros((4, 4), np.uint8))
    for format in FORMATS:
        with pytest.raises(InputError, match="is not of the layout" if format == "labels" else "is not empty"):
            export(tiny, format, tmp_path / "taken")
    with pytest.raises(InputError, match="no such folder"):
        export(tmp_path / "nowhere", "coco", tmp_path / "out")
