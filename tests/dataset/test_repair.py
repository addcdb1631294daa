"""Damaged folders, and folders that get more or fewer samples: resuming finds what is wrong and makes it again."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import warnings
from typing import Any

import pytest

from eyerender.base.errors import InputError, UnfinishedRunWarning
from eyerender.base.storage.files import write_json
from eyerender.cli.main import run
from eyerender.dataset.assemble import verify_dataset
from eyerender.dataset.run import generate
from eyerender.dataset.runfile import begin, refuse_taken
from eyerender.dataset.shard import verify
from eyerender.dataset.spec import DatasetSpec
from eyerender.dataset.status import status
from eyerender.dataset.validate import validate
from eyerender.folders.imagefolder import ImageFolder
from eyerender.folders.outfolder import MARKER
from tests.support import stages
from tests.support.dataset_specs import command, make, mapping, plan, tree, write

pytestmark = pytest.mark.render


def repairs(folder):
    """What the log says of repairs."""
    entries = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    return [entry["what"] for entry in entries if entry["event"] == "repair"]


def first(folder, kind, shard):
    return sorted((folder / kind / f"{shard:05d}").iterdir())[0]


def change_digit(path, first=""):
    """Change one digit of a text, beyond its middle or beyond some words."""
    text = path.read_text()
    start = text.index(first) if first else len(text) // 2
    at = next(k for k in range(start + len(first), len(text)) if text[k] in "123")
    path.write_text(text[:at] + str(int(text[at]) + 1) + text[at + 1 :])


def flip_byte(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def edit_done(folder, number, **changes):
    path = folder / "shards" / f"{number:05d}" / "done.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


@pytest.mark.packaging
def test_damaged_shards_are_made_again(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "copy")
    first(folder, "images", 0).unlink()
    flip_byte(first(folder, "masks", 1))
    change_digit(folder / "metadata.jsonl", '"file_name": "images/00002/00000007-right.png", ')
    first(folder, "images", 3).write_bytes(b"")
    edit_done(folder, 4, digest="0" * 64)
    (folder / "shards" / "00005" / "done.json").write_bytes(b"")
    shutil.copy(folder / "shards" / "00006" / "done.json", folder / "shards" / "00007" / "done.json")
    with open(folder / "log.jsonl", "a") as file:
        file.write('{"time": "20')  # cut short
    done = make(folder, plan())
    assert done["shards_made"] == 7
    assert tree(folder) == tree(tiny)
    lines = (folder / "log.jsonl").read_text().splitlines()
    assert lines.count('{"time": "20') == 1
    words = {
        0: "no such file",
        1: "its checksum differs",
        2: "lines.jsonl: its checksum differs",
        3: "has 0 bytes",
        4: "is of another spec",
        5: "is not valid JSON",
        7: "is of another shard",
    }
    found = [json.loads(line)["what"] for line in lines if '"event": "repair"' in line]
    found = [what for what in found if what.startswith("shard ")]  # the dataset is assembled again, too
    for what, (shard, word) in zip(found, words.items(), strict=True):
        assert what.startswith(f"shard {shard} is made again: ")
        assert word in what
        assert f"repairing: {what}" in done["said"]
    assert list(verify_dataset(folder)) == []


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(None, id="missing"),
        pytest.param(b"", id="empty"),
        pytest.param(b"\0" * 100, id="zeros", marks=pytest.mark.slow),
        pytest.param(b'{"schema": "eyerender/', id="cut-short"),
    ],
)
@pytest.mark.parametrize("name", ["run.json", "dataset.json"])
def test_damaged_files_of_the_dataset_are_written_again(tiny, tmp_path, name, content):
    folder = shutil.copytree(tiny, tmp_path / "copy")
    (folder / name).unlink()
    if content is not None:
        (folder / name).write_bytes(content)
    done = make(folder, plan())
    assert done["shards_made"] == 0
    assert tree(folder) == tree(tiny)
    assert len(repairs(folder)) == 1
    assert name in repairs(folder)[0]
    assert done["said"] == [f"repairing: {repairs(folder)[0]}"]


@pytest.mark.parametrize("content", [None, pytest.param(b'{"schema": "eyerender/', marks=pytest.mark.slow)])
def test_shards_whose_lines_are_lost_are_made_again(tiny, tmp_path, content):
    """A finished dataset holds the lines of its shards once, in metadata.jsonl."""
    folder = shutil.copytree(tiny, tmp_path / "copy")
    (folder / "metadata.jsonl").unlink()
    if content is not None:
        (folder / "metadata.jsonl").write_bytes(content)
    assert make(folder, plan())["shards_made"] == 8
    assert tree(folder) == tree(tiny)


@pytest.mark.parametrize("content", [None, ""])
def test_a_damaged_run_file_lets_no_other_spec_in(tiny, tmp_path, content):
    folder = shutil.copytree(tiny, tmp_path / "copy")
    (folder / "run.json").unlink()
    if content is not None:
        (folder / "run.json").write_text(content)
    before = tree(folder)
    with pytest.raises(InputError, match="holds a run of another spec"):
        make(folder, plan(seed=6))
    assert tree(folder) == before
    for shard in range(8):
        edit_done(folder, shard, versions={"mitsuba": "0.1"})
    with pytest.raises(InputError, match=r"versions.mitsuba: .0.1. -> "):
        make(folder, plan())
    assert tree(folder) == before


def test_a_run_starts_over_where_nothing_tells_what_it_was(tmp_path):
    (tmp_path / "run.json").write_bytes(b"")
    (tmp_path / "log.jsonl").write_bytes(b"\0\0\0")
    (tmp_path / "images" / "00007").mkdir(parents=True)
    (tmp_path / "shards" / "00000").mkdir(parents=True)
    (tmp_path / "shards" / "00000" / "done.json").write_bytes(b"")
    done = make(tmp_path, plan(count=1, subjects=1, shard_size=1))
    assert done["complete"]
    assert len(done["said"]) == 1
    assert done["said"][0].startswith("repairing: the run starts over: run.json: ")
    assert [p.name for p in (tmp_path / "images").iterdir()] == ["00000"]
    assert list(verify_dataset(tmp_path)) == []


@pytest.mark.parametrize(
    "names",
    [
        ["run.json", "thesis.txt", "log.jsonl"],
        ["run.json", "README.md"],
        ["run.json", "log.jsonl", "images/holiday.png"],
        ["images/00001/a.png", "metadata.jsonl", "dataset.json"],
        ["images/00001/a.png"],
        ["shards/00001/lines.jsonl", "metadata.jsonl"],
    ],
)
def test_folders_that_may_be_someone_elses_are_left_alone(tmp_path, names):
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    before = tree(tmp_path)
    with pytest.raises(InputError, match="is not empty; choose another folder or give --overwrite"):
        make(tmp_path, plan())
    assert tree(tmp_path) == before


def test_a_run_file_of_something_else_is_refused(tmp_path):
    (tmp_path / "run.json").write_text('{"schema": "other/1"}')
    with pytest.raises(InputError, match="does not describe a run of this version"):
        make(tmp_path, plan())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"schema": "eyerender/shard/9"}, "must have the schema"),
        ({"files": None}, "files: is missing"),
        ({"files": {}}, "files: do not belong to this shard"),
        ({"files": {"../run.json": {"bytes": 1, "sha256": ""}}}, "files: do not belong to this shard"),
        ({"files": {"images/00001/a.png": {"bytes": "1", "sha256": ""}}}, "files: is missing, or not in the format"),
        ({"samples": [1]}, "samples: is missing"),
        ({"backend": {"name": 1}}, "backend: is missing"),
        ({"shard": 3}, "is of another shard"),
        ({"digest": "0"}, "is of another spec"),
    ],
)
def test_a_wrong_done_file_is_told(tiny, tmp_path, changes, words):
    folder = shutil.copytree(tiny, tmp_path / "copy")
    edit_done(folder, 1, **changes)
    found = list(verify(folder, 1, plan().digest))
    assert len(found) == 1
    assert found[0].startswith("shards/00001/done.json: ")
    assert words in found[0]


def test_links_are_not_followed(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "copy")
    image = first(folder, "images", 1)
    image.rename(tmp_path / "away.png")
    image.symlink_to(tmp_path / "away.png")
    assert "a symbolic link" in next(verify(folder, 1))


def test_a_quick_check_compares_sizes(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "copy")
    flip_byte(first(folder, "images", 1))
    change_digit(folder / "metadata.jsonl")
    assert list(verify_dataset(folder, quick=True)) == []
    assert len(list(verify_dataset(folder))) == 2


@pytest.mark.parametrize("name", ["metadata.jsonl", "masks", "shards/00002/done.json"])
def test_nothing_damaged_is_exported(tiny, tmp_path, capsys, name):
    folder = shutil.copytree(tiny, tmp_path / "copy")
    if name == "masks":
        flip_byte(first(folder, "masks", 2))
    elif name.endswith("done.json"):
        (folder / name).unlink()
    else:
        change_digit(folder / name)
    assert run(["export-dataset", str(folder), str(tmp_path / "out"), "--format", "csv"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert name.removesuffix("/done.json") in err
    assert "start generate again on the folder to repair it" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.packaging
def test_a_part_withdraws_what_is_damaged_in_another(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "copy")
    flip_byte(first(folder, "images", 1))
    done = make(folder, plan(), part=(1, 2))
    assert not done["complete"]
    assert done["shards_missing"] == 1
    assert done["said"][0].startswith("repairing: shard 1 is made again: images/00001/")
    assert not (folder / "dataset.json").exists()
    assert make(folder, plan(), part=(2, 2))["complete"]
    assert tree(folder) == tree(tiny)


@pytest.mark.parametrize("name", ["images", "shards", "masks/00002", "shards/00002", "log.jsonl", "metadata.jsonl"])
def test_a_run_does_not_go_on_in_a_folder_with_links(tiny, tmp_path, name):
    """Shards are made and removed, lines appended: where a link leads, all of it would happen elsewhere."""
    folder, away = shutil.copytree(tiny, tmp_path / "copy"), tmp_path / "away"
    (folder / name).rename(away)
    (folder / name).symlink_to(away)
    edit_done(folder, 2, digest="another")  # it would be made again
    before = tree(tmp_path)
    with pytest.raises(InputError, match=f"{name}: is a symbolic link"):
        make(folder, plan())
    with pytest.raises(InputError, match=f"holds '{name}', which this package did not make"):
        make(folder, plan(), overwrite=True)
    assert tree(tmp_path) == before


def test_a_run_goes_on_in_a_folder_that_was_being_cleared(tmp_path):
    """All that stands in it is the marker, or what was to become the marker."""
    for name in (MARKER, f".{MARKER}.0123abcd.part"):
        folder = tmp_path / name
        folder.mkdir()
        write_json(folder / MARKER, {"schema": "eyerender/folder/1", "files": []})
        (folder / MARKER).rename(folder / name)
        refuse_taken(folder)
        assert not begin(folder, plan(), pytest.fail)
        assert [p.name for p in folder.iterdir()] == ["run.json"]


TINY = {"scene.image.window_px": [48, 40], "scene.image.spp": 1}


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    return write(tmp_path_factory.mktemp("spec") / "tiny.yaml", **TINY)


def grown(spec, folder, count):
    """Make `count` samples in a folder; returns how many images were made."""
    done = generate(spec, folder, count=count, workers=1, threads=1)
    assert done["complete"]
    assert done["statistics"]["images"] == done["statistics"]["samples"] == count
    report = validate(folder)
    assert report["ok"], report["problems"]
    return done["images_made"]


@pytest.mark.slow
def test_a_dataset_grows_and_shrinks_and_keeps_what_it_has(spec, tmp_path):
    folder, seen = tmp_path / "out", dict[str, Any]()
    for count, made in ((9, 9), (24, 15), (14, 0), (40, 16), (24, 0), (9, 0), (40, 0), (24, 0)):
        assert grown(spec, folder, count) == made  # what a smaller dataset left out is kept
        lines = [json.loads(line) for line in (folder / "metadata.jsonl").read_text().splitlines()]
        assert len({line["subject"] for line in lines}) == {9: 4, 14: 4, 24: 4, 40: 8}[count]
        for line in lines:
            whole = line, (folder / line["file_name"]).read_bytes(), (folder / line["mask_file_name"]).read_bytes()
            assert seen.setdefault(line["sample"], whole) == whole
        # Loaders of image folders take every picture that they find.
        assert len(list(folder.glob("images/*/*.png"))) == count
    fresh = tmp_path / "fresh"
    grown(spec, fresh, 24)
    for stage in folder.glob(".partial-*"):
        shutil.rmtree(stage)
    assert tree(folder) == tree(fresh)


@pytest.mark.parametrize("layout", ["files", "webdataset"])
@pytest.mark.parametrize(
    "kills", [pytest.param(2, marks=pytest.mark.packaging), pytest.param(10, marks=pytest.mark.slow)]
)
@pytest.mark.timeout(900)
def test_a_growth_that_is_killed_keeps_the_old_images_readable(tmp_path, layout, kills):
    spec, folder = write(tmp_path / "tiny.yaml", **TINY, layout=layout), tmp_path / "out"
    grown(spec, folder, 9)
    old = {entry.name: (entry.line, entry.data("file_name"), time_of(entry)) for entry in ImageFolder.load(folder)}
    argv = ("generate", str(spec), str(folder), "--count", "24", "--workers", "1")
    total = 2 * 15 + 2 * 8 if layout == "files" else 2 * 15 + 4 * 8
    for at in [*stages.cuts(random.Random(kills), total, kills + 1), 0]:
        process = command(
            *argv, env=stages.environment(tmp_path, folder, at=at, how="kill all"), start_new_session=True
        )
        _, err = process.communicate()
        assert process.returncode == (-signal.SIGKILL if at else 0), err
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnfinishedRunWarning)
            found = {entry.name: entry for entry in ImageFolder.load(folder)}
        for name, (line, data, time) in old.items():
            entry = found[name]
            assert (entry.line["labels"], entry.data("file_name")) == (line["labels"], data)
            assert layout == "webdataset" or time_of(entry) == time  # it was not rendered again
        if at:
            state = status(folder)
            assert 9 <= state["samples_finished"] + state["samples_in_partial_shards"] <= 24
            assert all("unfinished" in problem for problem in validate(folder)["problems"])
    assert len(found) == 24
    assert grown(spec, folder, 9) == 0
    assert grown(spec, folder, 24) == 0


def time_of(entry):
    return os.stat(entry.folder / entry.line["file_name"]).st_mtime_ns if (entry.folder / "images").exists() else 0


def test_only_the_number_of_samples_of_one_plan_may_change(spec, tmp_path):
    folder = tmp_path / "out"
    grown(spec, folder, 2)
    other = DatasetSpec.from_mapping(mapping(**TINY, seed=6)).first(4)
    with pytest.raises(InputError, match=r"spec\.seed: 5 -> 6"):
        generate(other, folder)
    # A count of the spec's own is another plan, whose subjects have other samples.
    other = DatasetSpec.from_mapping(mapping(**TINY, count=30))
    with pytest.raises(InputError, match=r"spec\.planned: 24 -> 30"):
        generate(other, folder)
    assert validate(folder)["ok"]
