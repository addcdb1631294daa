"""Items for training: labels with validity, mirrored and moved pictures, augmentation."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.dataset.training.augment import Augmentation
from eyerender.dataset.training.item import LABELS, partners, person_names, rig_pose
from eyerender.dataset.training.place import Placement, placed
from eyerender.dataset.training.prepare import Preparation, lamps_vary
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec
from tests.support.labels import labels_of
from tests.support.training import SIZE, line_of, mirrored_tree, scene_tree

PARTS = ("image", "mask", "normals", *LABELS, "camera")
LENSES: dict[str, Any] = {
    "pinhole": {},
    "tangential": {"distortion": [-0.1, 0.02, 0.01, -0.008, 0.0]},
    "fisheye": {"distortion": {"model": "fisheye", "k": [0.05, -0.01, 0.0, 0.0], "p": [0.002, -0.003]}},
}
ZEROS = np.array([[0, 1, 0], [1, 0, 0], [1, 1, 0]], dtype=bool)  # of a camera matrix
MOUNT = {"rotation_deg": [2.0, -1.0, 3.0], "translation_mm": [0.4, -0.6, 0.3]}


def item_of(tree, **options):
    line, pictures = line_of(tree)
    return Preparation(parts=PARTS, **options).read(line, pictures.get, "here")


def differences(one, other):
    """Largest difference of each part of two items."""
    pairs = {k: (v, other.parts[k]) for k, v in one.parts.items() if k != "camera"}
    pairs |= {f"camera.{k}": (v, other.parts["camera"][k]) for k, v in one.parts["camera"].items()}
    return {
        k: np.max(np.abs(np.nan_to_num(np.asarray(a, dtype=float) - np.asarray(b, dtype=float))), initial=0.0)
        for k, (a, b) in pairs.items()
    }


def nans(item):
    return {part: np.isnan(value).tolist() for part, value in item.parts.items() if part in LABELS}


@pytest.mark.parametrize(("lens", "mount", "symmetric"), [
    ("pinhole", None, True), ("tangential", MOUNT, True), ("fisheye", None, False),
])  # fmt: skip
def test_a_mirrored_left_eye_is_that_of_the_mirrored_scene(lens, mount, symmetric):
    tree = scene_tree(**LENSES[lens])
    if mount:
        tree["rig"]["mount"] = mount
    if not symmetric:
        tree["rig"]["lights"][1]["position_mm"][2] += 9.0
    mirrored = item_of(tree, mirror_left=True)
    lamps = (1, 0, 2) if symmetric else (0, 1, 2)
    truth = item_of(mirrored_tree(tree, lamps), mirror_left=True)
    assert mirrored.mirrored
    assert not truth.mirrored
    assert mirrored.parts["eye"] == 0
    assert (mirrored.lamps is None) is not symmetric
    assert np.isfinite(truth.parts["glints"]).all()
    assert nans(mirrored) == nans(truth)
    found = differences(mirrored, truth)
    assert max(found.values()) < 1e-9, found
    assert item_of(tree).mirrored is False


@pytest.mark.slow
@pytest.mark.render
def test_the_rendered_mask_of_the_mirrored_scene_is_the_mirrored_mask():
    images = []
    for tree in (scene_tree(), mirrored_tree(scene_tree(), (1, 0, 2))):
        del tree["region"]
        (image,) = er.render(Scene.of(SceneSpec.from_mapping({**tree, "image": {"spp": 1}})))
        images.append((image.parts, [glint["spot_xy_px"] for glint in labels_of(image)["glints"]]))
    (mask, spots), (other, mirrored_spots) = images
    np.testing.assert_array_equal(mask[:, ::-1], other)
    turned = np.array([SIZE[0] - 1, 0]) + np.array(spots)[[1, 0, 2]] * [-1, 1]
    np.testing.assert_allclose(turned, mirrored_spots, atol=1e-9)


def test_vectors_in_the_frame_of_a_moved_rig_are_those_that_its_camera_sees():
    """In its own frame a rig's camera stands where it was built; a pose of the line replaces the mount."""
    tree = scene_tree()
    tree["rig"]["mount"] = MOUNT
    line, pictures = line_of(tree)
    own = tree["rig"]["cameras"][0]["calibration"]
    R, t = rig_pose(line)
    posed = {
        **line,
        "rig_pose": {"rotation_rad": Rotation.from_matrix(R).as_rotvec().tolist(), "translation_mm": t.tolist()},
    }
    for one in (line, posed):
        parts = Preparation(parts=PARTS).read(one, pictures.get, "").parts
        for name in ("gaze", "optic_axis"):
            np.testing.assert_allclose(parts[f"{name}_rig"] @ np.transpose(own["R"]), parts[name], atol=1e-12)
            azimuth, elevation = np.radians(parts[f"{name}_deg"])
            level = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
            np.testing.assert_allclose([*level, np.sin(elevation)], parts[f"{name}_rig"], atol=1e-12)
        seen = parts["centres_rig_mm"] @ np.transpose(own["R"]) + own["t_mm"]
        np.testing.assert_allclose(seen, parts["centres_mm"], atol=1e-10)
    plain = item_of(scene_tree())
    pose = line_of(scene_tree())[0]["records"][0]["pose"]
    assert plain.parts["optic_axis_deg"] == pytest.approx([pose["azimuth_deg"], pose["elevation_deg"]], abs=1e-9)


def test_moved_labels_are_those_of_the_equivalent_camera():
    """Shift, scale, roll and flip are those of a camera; ray optics through that camera gives the labels again."""
    augment = Augmentation(erase=0, crop=(0.7, 1.0), roll_deg=180, flip=0.5)
    flips = 0
    for key in range(6):
        tree = scene_tree()
        moved = augment.changed(item_of(tree, augment=augment), (160, 160), [key])
        flips += moved.mirrored
        camera = moved.parts["camera"]
        other = mirrored_tree(tree, (1, 0, 2)) if moved.mirrored else tree
        other["rig"]["cameras"][0] = {
            "resolution_px": [160, 160],
            "calibration": {name: camera[name].tolist() for name in ("R", "t_mm")}
            | {"K": np.where(ZEROS, 0.0, camera["K"]).tolist()},
        }
        assert np.abs(camera["K"][ZEROS]).max() < 1e-9
        truth = item_of(other)
        found = differences(moved, truth)
        for part in (*("gaze", "optic_axis", "centres_mm", "gaze_rig", "optic_axis_rig", "centres_rig_mm"),
                     *("gaze_deg", "optic_axis_deg", "pupil_mm", "eye")):  # fmt: skip
            assert found[part] < 1e-9, part
        for part in ("pupil", "iris"):
            turn = (moved.parts[part][4] - truth.parts[part][4] + np.pi / 2) % np.pi - np.pi / 2
            assert np.abs(moved.parts[part][:4] - truth.parts[part][:4]).max() < 1e-9
            assert abs(turn) < 1e-9
        assert np.abs(moved.parts["glints"][:, :2] - truth.parts["glints"][:, :2]).max() < 1e-9
        # Landmarks of lids are rounded to 1e-4 px.
        assert np.abs(moved.parts["lids"] - truth.parts["lids"]).max() < 3e-4
        # The mask moves with the labels; nearest pixels round its border by up to half a pixel.
        v, u = np.nonzero(moved.parts["mask"] == 3)
        if moved.parts["visible_fraction"][0] == 0.8:
            assert np.hypot(u.mean() - moved.parts["pupil"][0], v.mean() - moved.parts["pupil"][1]) < 0.5
    assert 0 < flips < 6


def test_pictures_are_resampled_where_labels_say():
    """A bright disc keeps its centre of mass on its label, whatever the size."""
    item = item_of(scene_tree())
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    x, y = item.parts["pupil"][:2]
    disc = np.clip(15.5 - np.hypot(u - x, v - y), 0, 1).astype(np.float32)
    item.parts["image"] = disc
    for scale, turn, size in (
        (0.31, 0.4, (70, 60)),
        (1.7, -1.0, (300, 300)),
        (1.0, 0.0, (150, 130)),
        (0.5, 0.0, (100, 75)),
    ):
        at = Placement.about(np.array([x, y]), np.array(size) / 2 + 0.3, scale=scale, turn_rad=turn, size=size)
        out = placed(item, at)
        image = out.parts["image"]
        v, u = np.mgrid[: size[1], : size[0]]
        centre = [(image * u).sum() / image.sum(), (image * v).sum() / image.sum()]
        np.testing.assert_allclose(centre, out.parts["pupil"][:2], atol=0.02)
        assert image.sum() == pytest.approx(disc.sum() * scale**2, rel=0.01)


def test_labels_of_hidden_pupils_and_of_absent_eyes_are_not_valid():
    line, pictures = line_of(scene_tree())

    def valid(**changes):
        other = copy.deepcopy(line)
        for path, value in changes.items():
            node, *keys, last = other["labels"], *path.split("__")
            for key in keys:
                node = node[key]
            node[last] = value
        return Preparation(parts=PARTS).read(other, pictures.get, "").valid()

    pupil = ("pupil", "pupil_mm", "gaze", "gaze_rig", "gaze_deg", "optic_axis", "optic_axis_rig", "optic_axis_deg")
    everything = valid()
    for part, flags in everything.items():
        assert flags.all() or part == "person" or (part == "lids" and flags.any()), part
    for share in (0.0, 0.09, None):
        hidden = valid(pupil__visible_fraction=share)
        assert not any(hidden[part].any() for part in pupil)
        assert hidden["centres_mm"].tolist() == [True, True, False]
        assert hidden["iris"]
    assert valid(pupil__visible_fraction=0.1)["gaze"]
    assert not valid(iris__visible_fraction=0.05)["iris"]
    absent = valid(eye_present=False)
    assert not any(flags.any() for part, flags in absent.items() if part not in ("glints", "lids"))
    assert not valid(lid_opening=None)["lid_opening"].any()
    assert not valid(lid_margins_px=None)["lids"].any()


def test_what_is_cut_off_or_covered_counts_as_unseen():
    item = item_of(scene_tree(), augment=Augmentation())
    x, y, *_ = item.parts["pupil"]
    column, row = round(x), round(y)
    at = Placement(scale=1.0, turn_rad=0.0, offset=np.array([-column, 0.0]), size=SIZE)
    half = placed(item, at)
    inside = item.mask[:, column:] == 3
    share = inside.sum() / (item.mask == 3).sum()
    assert half.parts["visible_fraction"][0] == pytest.approx(0.8 * share)
    v, u = np.nonzero(inside)
    np.testing.assert_allclose(half.parts["visible_pupil"][:2], [u.mean(), v.mean()], atol=1e-9)
    gone = placed(item, Placement(scale=1.0, turn_rad=0.0, offset=np.array([400.0, 0.0]), size=SIZE))
    assert not gone.valid()["gaze"]
    assert not gone.valid()["glints"].any()
    assert np.isnan(gone.parts["visible_pupil"]).all()
    covered = placed(item, Placement(scale=1.0, turn_rad=0.0, offset=np.zeros(2), size=SIZE,
                                     patches=((column - 12, column + 12, 0, SIZE[1]),)))  # fmt: skip
    assert covered.shown[0] < 0.8
    assert not (covered.parts["mask"][:, column - 12 : column + 12]).any()
    hidden = np.abs(item.parts["glints"][:, 0] - column) < 11
    assert hidden.any()
    assert not covered.parts["glints"][hidden, 2].any()
    assert covered.valid()["glints"].all()
    assert row < SIZE[1]


def test_lamps_are_renamed_by_their_mirrored_places():
    ring = [[0, 10 * np.cos(a), 10 * np.sin(a)] for a in np.arange(6) * np.pi / 3]
    assert partners(np.array(ring), 1).tolist() == [3, 2, 1, 0, 5, 4]
    assert partners(np.array(ring) + np.array([0, 0.3, 0]), 1).tolist() == [3, 2, 1, 0, 5, 4]  # 0.6 mm off
    assert partners(np.array(ring) + np.array([0, 0.6, 0]), 1) is None
    assert partners(np.array(ring[:2] + ring[4:]), 1) is None
    assert partners(np.zeros((0, 3)), 1).tolist() == []


def test_the_same_key_gives_the_same_picture_and_limits_are_checked():
    augment = Augmentation(seed=4)
    item = item_of(scene_tree(), augment=augment)
    one, two, other = (augment.changed(item, (64, 64), key) for key in ([1, 2], [1, 2], [1, 3]))
    np.testing.assert_array_equal(one.parts["image"], two.parts["image"])
    assert not np.array_equal(one.parts["image"], other.parts["image"])
    assert one.parts["image"].dtype == np.float32
    assert 0 <= one.parts["image"].min() <= one.parts["image"].max() <= 1
    wrong: tuple[tuple[str, Any], ...] = (
        ("flip", 1.1),
        ("scale", (0, 1)),
        ("scale", (0.001, 0.001)),
        ("gamma", (2.0, 1.0)),
        ("noise", (0.0, np.nan)),
        ("seed", -1),
    )
    for field, value in wrong:
        with pytest.raises(InputError, match=f"{field}: is out of range"):
            Augmentation(**{field: value})


def test_rigs_with_fewer_lamps_get_rows_of_nan():
    line, pictures = line_of(scene_tree())
    item = Preparation(parts=("glints",), lights=5).read(line, pictures.get, "")
    assert item.valid()["glints"].tolist() == [True] * 3 + [False] * 2
    with pytest.raises(InputError, match="lights: must be >= 3, the number of the lamps of a rig"):
        Preparation(parts=("glints",), lights=2).read(line, pictures.get, "")
    plain = {"position_mm": [{"draw": "uniform", "low": 0, "high": 1}, 0, 0]}
    assert not lamps_vary({"rig": {"lights": [plain, {"ring": {"count": 4}}]}})
    for lights in ({"draw": "choice"}, [{"draw": "choice"}], [{"ring": {"count": {"draw": "integer"}}}]):
        assert lamps_vary({"rig": {"lights": lights}})
    assert len(person_names()) == len(set(person_names()))
