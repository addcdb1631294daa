"""Datasets of eyes in their lids: the same keys as bare eyes, visible and amodal labels that hang together."""

from __future__ import annotations

import json

import numpy as np
import pytest
from dataset_specs import make

from eyerender.dataset.export import export
from eyerender.dataset.plan import Plan
from eyerender.dataset.spec import DatasetSpec, find_dataset
from eyerender.dataset.validate import validate
from eyerender.errors import BackendError
from eyerender.imagefile import read_image
from eyerender.imagefolder import ImageFolder

pytestmark = pytest.mark.render


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three frames of one subject of the shipped spec, few rays, its lids more and more shut."""
    data = DatasetSpec.load(find_dataset("dataset_region")).to_mapping()
    data |= {"count": 3, "subjects": 1, "splits": {"train": 1.0}}
    data["scene"]["image"]["spp"] = 1
    data["scene"]["region"]["blink"] = {"draw": "sequence", "values": [0.0, 0.45, 0.75]}
    made = tmp_path_factory.mktemp("region") / "out"
    try:
        make(made, Plan.of(DatasetSpec.from_mapping(data)))
    except BackendError as error:
        pytest.skip(f"nothing to render with: {error}")
    return made


def test_it_is_a_sound_dataset(folder):
    report = validate(folder)
    assert report["ok"], report["problems"]


def test_its_lines_have_the_keys_of_bare_eyes(tiny, folder):
    def below(node, path=""):
        if isinstance(node, dict):
            return {p for key, value in node.items() for p in below(value, f"{path}.{key}")}
        if isinstance(node, list) and node and isinstance(node[0], dict):
            return below(node[0], f"{path}[]")
        return {path}

    bare, lidded = (json.loads((place / "metadata.jsonl").read_text().splitlines()[0]) for place in (tiny, folder))
    own = {".labels.lid_margins_px.upper", ".labels.lid_margins_px.lower"}
    assert below(lidded["labels"], ".labels") == below(bare["labels"], ".labels") - {".labels.lid_margins_px"} | own
    assert below(lidded["records"]) == below(bare["records"])


def test_webdataset_has_its_amodal_masks(folder, tmp_path):
    import webdataset as wds

    export(folder, tmp_path / "out", "webdataset")
    samples = list(wds.WebDataset(str(tmp_path / "out" / "train-000000.tar"), shardshuffle=False, empty_check=False))
    assert len(samples) == 3
    for sample in samples:
        name = json.loads(sample["json"])["amodal_mask_file_name"]
        assert sample["amodal.png"] == (folder / name).read_bytes()


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
