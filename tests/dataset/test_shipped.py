"""Every scene and dataset spec that comes with the package validates once it is made: no false alarms."""

from __future__ import annotations

import pytest

from eyerender.base.errors import BackendError
from eyerender.cli.main import run
from eyerender.dataset.maker import Maker
from eyerender.dataset.picturesize import scaled
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import frames_of
from eyerender.dataset.spec import DatasetSpec, shipped_datasets
from eyerender.dataset.validate import validate
from eyerender.folders.imagefolder import ImageFolder
from eyerender.imaging.folder import render_folder
from eyerender.scene import Scene, is_dataset, load_scene, shipped_files, shipped_scenes
from eyerender.scene.spec import SceneSpec
from tests.support.dataset_specs import make
from tests.support.in_process import single_workers_in_process
from tests.support.paths import BARE_HEAD_MOUNTED

pytestmark = pytest.mark.render

# Bare eyes and one with lids and an uneven pupil take a few seconds; skin of several subjects takes more.
QUICK = ("guestrin2006", "head_mounted", "headset")
NAMES = sorted({*shipped_scenes(), *shipped_datasets()})


def small(name):
    """A shipped scene with one sample a pixel, and of its directions and head positions the first and the last."""
    scene = load_scene(name, spp=1)
    data = scene.spec.to_mapping()
    if "grid" in data["targets"]:
        data["targets"] = {"grid": [2, 2]}
    else:
        points = {kind: found for kind, found in data["targets"].items() if isinstance(found, list)}
        data["targets"] = {kind: [found[0], found[-1]] for kind, found in points.items()}
    heads = data["subject"]["head_positions_mm"]
    data["subject"]["head_positions_mm"] = heads if len(heads) == 1 else [heads[0], heads[-1]]
    return Scene.of(SceneSpec.from_mapping(data))


def few(name):
    """A shipped dataset spec with one sample a pixel, two subjects and four samples."""
    data = DatasetSpec.load(shipped_datasets()[name]).to_mapping()
    data |= {"count": 4, "subjects": 2, "shard_size": 2}
    if "sequence" in data["scene"]:
        data["planned"], data["scene"]["sequence"]["duration_s"] = 4, 2 / 60  # two clips of two frames
    data["scene"]["image"]["spp"] = 1
    return Plan.of(DatasetSpec.from_mapping(data))


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in NAMES]
)
def test_it_validates_once_it_is_made(name, tmp_path):
    folder = tmp_path / "out"
    try:
        if name in shipped_datasets():
            make(folder, few(name))
        else:
            render_folder(small(name), folder)
    except BackendError as error:
        pytest.skip(f"nothing to render with: {error}")
    report = validate(folder, deep=True)
    assert report["ok"], report["problems"]
    assert report["recomputed"] == report["images"] >= 2
    assert report["notes"] == []


@pytest.mark.parametrize("eye", ["E5", pytest.param("E3", marks=pytest.mark.slow)])
def test_eyes_seen_from_the_side_validate(eye, tmp_path):
    """The outlines hold for tilted and biconic corneas too, up to where rays just miss the rim."""
    data = load_scene(BARE_HEAD_MOUNTED, spp=1).spec.to_mapping()
    data["eye"] = {"model": eye, "pupil_diameter_mm": 6.0}
    del data["targets"]
    data["poses"] = [{"azimuth_deg": -35, "elevation_deg": -25}, {"azimuth_deg": 35, "elevation_deg": -25}]
    try:
        render_folder(Scene.of(SceneSpec.from_mapping(data)), tmp_path / "out")
    except BackendError as error:
        pytest.skip(f"nothing to render with: {error}")
    report = validate(tmp_path / "out")
    assert report["ok"], report["problems"]


def test_all_are_covered():
    assert NAMES == [
        "bench_world", "blignaut2014", "dataset_binocular", "dataset_glasses", "dataset_quick", "dataset_region",
        "dataset_sequence", "desktop_tracker", "eyelink_desktop", "guestrin2006", "head_mounted", "headset",
        "headset_binocular", "people_any_headset", "people_eyelink", "people_iris_camera", "people_nvgaze",
        "people_openeds", "people_pupil_core", "people_two_cameras", "quickstart", "stress", "webcam",
    ]  # fmt: skip


def test_shipped_datasets_are_those_that_declare_themselves_so():
    assert set(shipped_datasets()) == {name for name, path in shipped_files().items() if is_dataset(path)}


@pytest.mark.packaging
def test_a_window_at_grazing_incidence_leaves_the_picture_finite():
    """Its light has no path to some places behind the cornea, where the search for one ends without a number."""
    data = DatasetSpec.load(shipped_datasets()["people_pupil_core"]).to_mapping()
    data["scene"] = scaled(data["scene"], (40, 40))
    data["scene"]["ambient"] = {"map": {"place": "office", "place_seed": 51054, "azimuth_deg": -98.3}}
    plan = Plan.of(DatasetSpec.from_mapping(data))
    (sample,) = Maker(plan, frames_of(plan), threads=1).make_all([200])
    assert len(sample.images) == 2


def test_shipped_datasets_state_their_licence():
    assert {DatasetSpec.load(path).licence for path in shipped_datasets().values()} == {"CC0-1.0"}


@pytest.mark.render
def test_a_recipe_of_people_is_made_with_another_eye(tmp_path, capsys):
    argv = ["generate", "people_openeds", "--eye", "E1", "--count", "2", "--size", "50x80", "--spp", "2"]
    with single_workers_in_process():
        assert run([*argv, "-o", str(tmp_path / "out"), "--workers", "1"]) == 0
    for entry in ImageFolder.load(tmp_path / "out"):
        assert entry.records[0]["eye_model"] == "E1"
        assert entry.labels["lid_margins_px"] is not None
    assert "## Licence\nCC0-1.0" in (tmp_path / "out" / "README.md").read_text()
    capsys.readouterr()
    assert run(["validate", str(tmp_path / "out"), "--render", "1"]) == 0
