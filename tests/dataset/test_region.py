"""Datasets of eyes in their lids: the same keys as bare eyes, visible and amodal labels that hang together."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from eyerender.dataset.export import export
from eyerender.dataset.plan import Plan
from eyerender.dataset.spec import DatasetSpec, find_dataset
from eyerender.dataset.validate import validate
from eyerender.folders.imagefile import read_image, write_png
from eyerender.folders.imagefolder import ImageFolder
from tests.support.dataset_specs import make_or_skip

pytestmark = pytest.mark.render


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three frames of one subject of the shipped spec, few rays, its lids more and more shut."""
    data = DatasetSpec.load(find_dataset("dataset_region")).to_mapping()
    data |= {"count": 3, "subjects": 1, "splits": {"train": 1.0}}
    data["labels"] = {**data["labels"], "as_annotated": True}
    data["scene"]["image"]["spp"] = 1
    data["scene"]["region"]["blink"] = {"draw": "sequence", "values": [0.0, 0.45, 0.75]}
    return make_or_skip(tmp_path_factory.mktemp("region") / "out", Plan.of(DatasetSpec.from_mapping(data)))


def test_it_is_a_sound_dataset(folder):
    report = validate(folder)
    assert report["ok"], report["problems"]


@pytest.mark.parametrize("shift", [2, 3])
def test_shifted_masks_are_found_behind_lids(folder, tmp_path, shift):
    copy = shutil.copytree(folder, tmp_path / "copy")
    paths = sorted(copy.glob("masks/*/*.png"))
    for path in paths:
        write_png(path, np.roll(read_image(path)[0], shift, axis=1))
    found = validate(copy)["problems"]
    lines = [json.loads(line) for line in (copy / "metadata.jsonl").read_text().splitlines()]
    seen = {Path(line["file_name"]).name: line["labels"]["pupil"]["visible_fraction"] for line in lines}
    assert sum(share > 0.5 for share in seen.values()) == 2  # of the third one, lids hide most of the outline
    for path in (path for path in paths if seen[path.name] > 0.5):
        mine = [p for p in found if p.startswith(f"images/00000/{path.name}: ")]
        assert any("the mask of its pupil" in p and "its outline" in p for p in mine)
        assert any("the mask of its iris" in p and "its outline" in p for p in mine)


def test_a_moved_lid_is_found(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    for path in [copy / "metadata.jsonl", *copy.glob("shards/*/lines.jsonl")]:
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        lines[1]["labels"]["lid_margins_px"]["upper"][8][1] += 5
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    found = validate(copy, quick=True)["problems"]
    assert sum("computed again: labels.lid_margins_px.upper.8.1" in p for p in found) == 1


def test_its_lines_have_the_keys_of_bare_eyes(tiny, folder):
    def below(node, path=""):
        if isinstance(node, dict):
            return {p for key, value in node.items() for p in below(value, f"{path}.{key}")}
        if isinstance(node, list) and node and isinstance(node[0], dict):
            return below(node[0], f"{path}[]")
        return {path}

    bare, lidded = (json.loads((place / "metadata.jsonl").read_text().splitlines()[0]) for place in (tiny, folder))
    own = {".labels.lid_margins_px.upper", ".labels.lid_margins_px.lower"}
    own |= {".labels.lid_opening.mm", ".labels.lid_opening.share"}
    null = {".labels.lid_margins_px", ".labels.lid_opening"}
    assert below(lidded["labels"], ".labels") == below(bare["labels"], ".labels") - null | own
    assert below(lidded["records"]) == below(bare["records"])


def test_webdataset_has_its_amodal_masks(folder, tmp_path):
    import webdataset as wds

    export(folder, "webdataset", tmp_path / "out")
    samples = list(wds.WebDataset(str(tmp_path / "out" / "train-000000.tar"), shardshuffle=False, empty_check=False))
    assert len(samples) == 3
    for sample in samples:
        name = json.loads(sample["json"])["amodal_mask_file_name"]
        assert sample["amodal.png"] == (folder / name).read_bytes()


def test_exports_take_masks_as_people_draw_them(folder, tmp_path):
    export(folder, "openeds", tmp_path / "out")
    entries = ImageFolder.load(folder).entries
    for k, entry in enumerate(entries):
        drawn, mask, whole = entry.annotated_mask(), entry.mask(), entry.amodal_mask()
        assert np.all((drawn == mask) | (mask == 0))
        assert np.all((drawn == whole) | (drawn == 0))
        assert np.array_equal(np.load(tmp_path / "out" / "train" / "labels" / f"{k:06d}.npy"), drawn)
    assert any(np.any(entry.annotated_mask() != entry.mask()) for entry in entries)
    copy = shutil.copytree(folder, tmp_path / "copy")
    path = copy / entries[0].line["annotated_mask_file_name"]
    write_png(path, np.zeros_like(read_image(path)[0]))
    assert any("annotated mask lacks" in problem for problem in validate(copy)["problems"])


def test_the_opening_falls_with_the_blink(folder):
    entries = sorted(ImageFolder.load(folder).entries, key=lambda e: e.line["sample"])
    shares = [entry.line["labels"]["lid_opening"]["share"] for entry in entries]
    assert shares[0] == 1.0
    np.testing.assert_allclose(shares[1:], [0.55, 0.25], atol=0.04)  # shut lids meet above the lower lid's place


def test_lids_hide_what_the_labels_say(folder):
    entries = ImageFolder.load(folder).entries
    shares = []
    for entry in sorted(entries, key=lambda e: e.line["sample"]):
        line = entry.line
        seen, whole = read_image(entry.mask_path)[0], read_image(folder / line["amodal_mask_file_name"])[0]
        for part, value in (("pupil", 3), ("iris", 2)):
            # Lids hide, they show nothing that was not there: visible pixels are among the amodal ones.
            assert not np.any((seen == value) & (whole != value))
            share = np.count_nonzero(seen == value) / np.count_nonzero(whole == value)
            assert line["labels"][part]["visible_fraction"] == pytest.approx(share, abs=1e-12)
        arcs = line["labels"]["pupil"]["visible_arcs_deg"]
        shares.append((line["labels"]["pupil"]["visible_fraction"], sum(b - a for a, b in arcs)))
        # The upper margin stands above the lower one in every image, and comes down with the blink.
        upper, lower = (np.array(line["labels"]["lid_margins_px"][lid]) for lid in ("upper", "lower"))
        assert upper[8, 1] < lower[8, 1]
        for glint in line["labels"]["glints"]:
            assert glint["visible"] == (glint["hidden_by"] == "visible" or glint["visible_share"] > 0)
    (open_share, open_arc), _, (shut_share, shut_arc) = shares
    assert open_share > 0.95
    assert open_arc > 300
    assert shut_share < 0.5
    assert shut_arc < 300
