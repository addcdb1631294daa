"""Parts of images, pictures of one size, groups of one instant, and streams that mix subjects."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.folders.imagefolder import ImageFolder
from tests.support.dataset_specs import TINY, make, plan

torch = pytest.importorskip("torch", reason="needs PyTorch; run ./scripts/test-torch")

from torch.utils.data import ConcatDataset, DataLoader  # noqa: E402

from eyerender.dataset.training.item import LABELS  # noqa: E402
from eyerender.torch import FolderDataset, StreamDataset, collate, person_names  # noqa: E402

pytestmark = pytest.mark.render
CAMERA = TINY["scene"]["rig"]["cameras"][0]
TWO = [CAMERA, {**CAMERA, "position_mm": [615.0, 200.0, -150.5], "resolution_px": [800, 600], "name": "second"}]
GEOMETRY = ("depth", "normals", "iris_coordinates", "instances")


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A folder of two cameras, eight bits, both layouts of geometry."""
    path = tmp_path_factory.mktemp("pair") / "made"
    changes = {
        "count": 4, "subjects": 2, "scene.rig.cameras": TWO, "scene.image": {"window_px": [80, 64], "spp": 2},
        "scene.sensor.bit_depth": 8, "labels": {"geometry": list(GEOMETRY)}, "require": "nothing",
    }  # fmt: skip
    make(path, plan(**changes))
    return path


def test_parts_of_points_cameras_and_geometry(pair):
    parts = ("glints", "lids", "camera", "instance_mask", "depth", "normals", "iris_coordinates")
    data = FolderDataset(pair, parts=parts)
    for item, entry in zip(data, ImageFolder.load(pair), strict=True):
        labels, (x0, y0, width, height) = entry.labels, entry.window
        for found, glint in zip(item["glints"].tolist(), labels["glints"], strict=True):
            if glint["xy_px"] is not None:
                np.testing.assert_allclose(found[:2], np.array(glint["xy_px"]) - [x0, y0], rtol=1e-5)
                assert found[2] == glint["visible"]
        assert item["lids"].shape == (2, 17, 2)
        assert item["lids"].isnan().all()  # a bare eye
        assert item["depth"].shape == (1, height, width)
        assert item["normals"].shape == (3, height, width)
        assert item["iris_coordinates"].shape == (2, height, width)
        np.testing.assert_array_equal(item["depth"][0], entry.depth())
        np.testing.assert_array_equal(item["normals"].permute(1, 2, 0), entry.normals())
        np.testing.assert_array_equal(item["instance_mask"], entry.instance_mask())
        camera = item["camera"]
        assert camera["index"] == entry.line["parameters"]["camera"]
        apex = camera["R"] @ torch.tensor(labels["space"]["world"]["cornea_apex_mm"]) + camera["t_mm"]
        u, v, w = (camera["K"] @ apex).tolist()
        row, column = round(v / w), round(u / w)
        assert abs(float(item["depth"][0, row, column]) - float(apex[2])) < 0.5


def test_folders_of_different_cameras_join_at_one_size(folder, pair):
    parts = ("image", "mask", *LABELS, "camera")
    with pytest.raises(InputError, match="image: has different sizes in a batch; give FolderDataset a size"):
        next(iter(DataLoader(ConcatDataset([FolderDataset(f) for f in (folder, pair)]), 28, collate_fn=collate)))
    both = ConcatDataset([FolderDataset(f, parts=parts, size=(70, 50)) for f in (folder, pair)])
    batch = next(iter(DataLoader(both, 28)))
    assert batch["image"].shape == (28, 1, 50, 70)
    assert batch["mask"].shape == (28, 50, 70)
    assert batch["camera"]["K"].shape == (28, 3, 3)
    assert batch["valid"]["person"].shape == batch["person"].shape == (28, len(person_names()))
    assert 0 <= float(batch["image"].min()) <= float(batch["image"].max()) <= 1
    for mask, (x, y, a, b, angle) in zip(batch["mask"], batch["pupil"].tolist(), strict=True):
        if not (8 < x < 62 and 8 < y < 42):
            continue
        v, u = np.nonzero(mask.numpy() == 3)
        assert abs(u.mean() - x) < 0.3
        assert abs(v.mean() - y) < 0.3
        assert np.pi * a * b == pytest.approx(len(u), rel=0.12)
        assert 0 <= angle < np.pi


def test_a_group_holds_all_cameras_of_an_instant(pair):
    data = FolderDataset(pair, parts=("image", "camera", "line"), group="sample")
    assert len(data) == 4
    for k, item in enumerate(data):
        assert item["sample"] == k
        assert item["camera"]["index"].tolist() == [0, 1]
        assert item["image"].shape == (2, 1, 64, 80)
        assert [line["sample"] for line in item["line"]] == [k, k]
        assert item["subject"] == item["line"][0]["subject"]
    with pytest.raises(InputError, match="group: must be 'sample', not 'subject'"):
        FolderDataset(pair, group="subject")  # type: ignore[arg-type]


def test_a_stream_mixes_the_images_of_several_batches(spec):
    def batches(**options):
        stream = StreamDataset(spec, batch_size=4, parts=("eye",), **options)
        return [batch["sample"].tolist() for batch in stream]

    plain, mixed = batches(lanes=5), batches(shuffle=5)
    assert sorted(k for batch in mixed for k in batch) == list(range(20))
    assert [len(batch) for batch in mixed] == [4] * 5
    subjects = [len({k // 5 for k in batch}) for batch in mixed]
    assert np.mean(subjects) > 2 > np.mean([len({k // 5 for k in batch}) for batch in plain])
    assert batches(shuffle=5) == mixed
    assert batches(shuffle=5, start=3) == mixed[3:]  # renders the window again
    stream = StreamDataset(spec, batch_size=4, parts=("eye",), shuffle=3)
    parts = iter(stream)
    begun = [next(parts)["sample"].tolist() for _ in range(2)]
    resumed = StreamDataset(spec, batch_size=4, parts=("eye",), shuffle=3)
    resumed.load_state_dict(stream.state_dict())
    assert begun + [batch["sample"].tolist() for batch in resumed] == batches(shuffle=3)
    with pytest.raises(InputError, match="shuffle: is 3 in the state, but 0 here"):
        StreamDataset(spec, batch_size=4, parts=("eye",)).load_state_dict(stream.state_dict())


def test_pictures_have_the_codes_of_their_camera(tmp_path):
    """Unless the camera's gamma is to be undone; a folder and a stream agree."""
    drawn = {"draw": "uniform", "per": "subject", "low": 1.2, "high": 2.2}
    own = plan(**{"count": 4, "scene.sensor.bit_depth": 8, "scene.sensor.gamma": drawn})
    make(tmp_path / "made", own)
    for encoding in ("stored", "linear"):
        data = FolderDataset(tmp_path / "made", encoding=encoding)
        streamed = torch.cat([batch["image"] for batch in StreamDataset(own, batch_size=4, encoding=encoding)])
        for item, entry, other in zip(data, ImageFolder.load(tmp_path / "made"), streamed, strict=True):
            share = entry.image().astype(np.float32) / 255
            wanted = share if encoding == "stored" else share**entry.gamma
            np.testing.assert_array_equal(item["image"][0], wanted)
            np.testing.assert_array_equal(other[0], wanted)
    assert torch.equal(FolderDataset(tmp_path / "made")[0]["image"], FolderDataset(
        tmp_path / "made", encoding="stored")[0]["image"])  # fmt: skip
    with pytest.raises(InputError, match="encoding: must be 'stored' or 'linear', not 'gamma'"):
        FolderDataset(tmp_path / "made", encoding="gamma")  # type: ignore[arg-type]
