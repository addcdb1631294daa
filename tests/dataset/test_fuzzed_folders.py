"""Folders that somebody else may have made, or that broke: read, checked, exported, resumed, or refused in one line.

Whatever a folder says, nothing outside of it is read into a result, and nothing is written outside of the output.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given

from eyerender.apps.inspection import inspect
from eyerender.apps.quickstart import compare_folder
from eyerender.dataset.assemble import assemble
from eyerender.dataset.done import sum_of
from eyerender.dataset.export import FORMATS, OF_SEQUENCES, export
from eyerender.dataset.lines import restore_lines
from eyerender.dataset.runfile import begin
from eyerender.dataset.shard import withdraw_damaged
from eyerender.dataset.validate import validate
from eyerender.folders.imagefile import read_image
from eyerender.folders.imagefolder import ImageFolder, finished
from eyerender.gaze.records import load_observations
from eyerender.imaging.imageobserver import rigs_of
from tests.support.dataset_specs import make_or_skip, plan
from tests.support.fuzzing import CASES, budget, edited, garbled, proper, strict_json

SECRET = b"the secret of another folder"
JSON = ("dataset.json", "run.json", "shards/00000/done.json")
LINES = ("metadata.jsonl",)
FILES = (*JSON, *LINES, "images/00000", "masks/00000", "README.md")
ACTIONS = (
    "read",
    "validate",
    "deep",
    "resume",
    "compare",
    "records",
    "inspect",
    *(f for f in FORMATS if f not in ("labels", *OF_SEQUENCES)),
)
HARMS = ("json", "json", "line", "line", "line", "bytes", "link", "link up", "pipe", "folder", "gone")


@pytest.fixture(scope="session")
def four(tmp_path_factory):
    """A dataset of four images in two shards."""
    folder = tmp_path_factory.mktemp("fuzzed") / "four"
    return make_or_skip(folder, small())


def small() -> Any:
    return plan(count=4, shard_size=2, subjects=2, labels={"boundary_points": 8})


def parsed(path: Path, *, first: bool = False) -> Any:
    """The JSON of a file, or of its first line; None where it was harmed before."""
    try:
        text = path.read_text(encoding="utf-8")
        return json.loads(text.splitlines()[0] if first else text)
    except (OSError, ValueError, IndexError, RecursionError):
        return None


def harmed(folder: Path, rng: Random, secret: Path) -> None:
    """Do one or two things to a folder that a stranger or a bad disk may have done."""
    for _ in range(rng.choice((1, 1, 2))):
        what = rng.choice(HARMS)
        path = target(folder / rng.choice(JSON if what == "json" else LINES if what == "line" else FILES))
        if path is None:
            continue
        if what == "json":
            data = parsed(path)
            if data is not None:
                path.write_text(json.dumps(edited(data, rng)), encoding="utf-8")
        elif what == "line":
            edit_line(folder, path, rng)
        elif what == "bytes":
            path.write_bytes(garbled(path.read_bytes(), rng))
        else:
            replace(folder, path, what, secret)


def target(path: Path) -> Path | None:
    """The file at a path, or the first one in a folder there; None where an earlier harm has changed what is there."""
    if path.parent.is_symlink() or not path.parent.is_dir() or path.is_symlink():
        return None
    if path.is_dir():
        path = min(path.iterdir(), default=path)
    return path if path.is_file() else None


def edit_line(folder: Path, path: Path, rng: Random) -> None:
    """The same change in the shard and in what is put together of it, as somebody who means it would do."""
    data = parsed(path, first=True)
    if data is None:
        return
    changed = json.dumps(edited(data, rng))
    for other in LINES:
        if (folder / other).is_file() and not (folder / other).is_symlink():
            lines = (folder / other).read_text(encoding="utf-8").splitlines()
            (folder / other).write_text("\n".join([changed, *lines[1:]]) + "\n", encoding="utf-8")


def replace(folder: Path, path: Path, what: str, secret: Path) -> None:
    """Put a link, a pipe, a folder or nothing in a file's place, or a link in its folder's."""
    path.unlink()
    if what == "link" or (what == "link up" and path.parent == folder):
        path.symlink_to(secret)
    elif what == "link up":
        shutil.rmtree(path.parent)
        path.parent.symlink_to(secret.parent)
    elif what == "pipe":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()


def signed(folder: Path) -> None:
    """Write the right checksums into done.json and dataset.json, so that only the content can give a lie away."""
    for path in (*folder.glob("shards/*/done.json"), folder / "dataset.json"):
        if not path.is_file() or path.is_symlink():
            continue
        data = parsed(path)
        todo = [data]
        while todo:
            node = todo.pop()
            if not isinstance(node, dict):
                continue
            for name, value in list(node.items()):
                if isinstance(value, dict) and {"sha256", "bytes"} <= value.keys():
                    for place in (folder / name, path.parent / name):
                        if len(name) < 200 and "\0" not in name and place.is_file() and not place.is_symlink():
                            node[name] = sum_of(place)
                todo.append(value)
        if data is not None:
            path.write_text(json.dumps(data), encoding="utf-8")


def inspected(folder: Path, out: Path) -> Any:
    """What an inspection finds, with its page."""
    out.mkdir(exist_ok=True)
    return inspect(folder, output=out / "page.html")


def use(folder: Path, action: str, out: Path) -> Any:
    """Do with a folder what a command would do."""
    if action == "read":
        found = ImageFolder.load(folder)
        for entry in found.entries:
            for key in ("file_name", "mask_file_name"):
                path = entry.file(key)
                if path is not None:
                    read_image(path)
        strict_json(list(found.truth().records()))
        return rigs_of(found)
    if action in ("validate", "deep"):
        report = validate(folder, quick=action == "validate", deep=action == "deep")
        strict_json(report)
        assert all(len(p) < 1500 and p.isprintable() for p in report["problems"])
        return report
    if action == "resume":
        made = small()
        begin(folder, made, lambda _: None)
        restore_lines(folder)
        withdraw_damaged(folder, sorted(finished(folder) & {0, 1}), made.digest)
        if {0, 1} <= finished(folder):
            strict_json(assemble(made, folder))
        return None
    if action in ("compare", "inspect"):
        strict_json(compare_folder(folder).to_mapping() if action == "compare" else inspected(folder, out))
        return None
    if action == "records":
        return load_observations(folder / "metadata.jsonl", "guestrin2006")
    return export(folder, action, out)


def fuzz(four: Path, tmp_path: Path, examples: int, actions: tuple[str, ...]) -> None:
    if "compare" in actions:
        use(four, "compare", tmp_path / "out")  # compiles the extractor, which the bound on time is not for
    place, out, secret = tmp_path / "folder", tmp_path / "out", tmp_path / "elsewhere" / "secret.png"
    secret.parent.mkdir()
    secret.write_bytes(SECRET)

    @budget(examples)
    @given(CASES)
    def cases(rng: Random) -> None:
        action = rng.choice(actions)
        shutil.rmtree(place, ignore_errors=True)
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(four, place)
        harmed(place, rng, secret)
        if rng.random() < 0.7:
            signed(place)
        proper(lambda: use(place, action, out))
        assert secret.read_bytes() == SECRET
        assert [p.name for p in secret.parent.iterdir()] == [secret.name]
        assert {p.name for p in tmp_path.iterdir()} <= {"folder", "out", "elsewhere"}
        for path in out.rglob("*") if out.exists() else ():
            assert not path.is_symlink()
            assert not path.is_file() or SECRET not in path.read_bytes()

    cases()


def test_the_unharmed_folder_can_be_used(four, tmp_path):
    assert all((four / name).exists() for name in FILES)
    shutil.copytree(four, tmp_path / "folder")
    signed(tmp_path / "folder")
    for action in ACTIONS:
        found = use(tmp_path / "folder", action, tmp_path / action)
        assert action != "validate" or found["ok"]


@pytest.mark.parametrize(
    ("file", "keys", "value"),
    [
        ("dataset.json", ("spec", "count"), 10**9),
        ("dataset.json", ("spec", "count"), 10**299),
        ("metadata.jsonl", ("parameters", "scene_json"), "[" * 100_000),
        ("metadata.jsonl", ("parameters", "eye_json"), "[" * 100_000),
        ("metadata.jsonl", ("parameters", "eye_json"), 3),
        ("metadata.jsonl", ("labels", "pupil"), []),
    ],
)
@pytest.mark.parametrize("action", ["read", "deep", "compare", "csv"])
def test_lies_that_fuzzing_found(four, tmp_path, file, keys, value, action):
    """Shards without end, deeply nested JSON in a text, labels of another shape; all checksums are right."""
    shutil.copytree(four, tmp_path / "folder")
    for name in LINES if file in LINES else (file,):
        path = tmp_path / "folder" / name
        first, *others = path.read_text(encoding="utf-8").splitlines() if file in LINES else [path.read_text()]
        data = node = json.loads(first)
        for key in keys[:-1]:
            node = node[key]
        node[keys[-1]] = value
        path.write_text("\n".join([json.dumps(data), *others]) + "\n", encoding="utf-8")
    signed(tmp_path / "folder")
    proper(lambda: use(tmp_path / "folder", action, tmp_path / "out"))


def test_harmed_folders(four, tmp_path):
    fuzz(four, tmp_path, 30, ACTIONS)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_many_harmed_folders(four, tmp_path):
    fuzz(four, tmp_path, 400, ACTIONS)
