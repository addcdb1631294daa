"""Samples as pure functions of (spec, i); subjects, splits, interleaving, and the rule of drawing again."""

from __future__ import annotations

import hashlib
import json
import pickle
from collections import Counter, defaultdict
from itertools import pairwise

import numpy as np
import pytest
import yaml

from eyerender.base.errors import InputError
from eyerender.dataset.draws import unit_number
from eyerender.dataset.plan import RANKED_SUBJECTS, Plan
from eyerender.dataset.realise import frames_of, realise
from eyerender.dataset.selection import Selection, in_spread_order, scrambled
from eyerender.dataset.spec import DatasetSpec, shipped_datasets
from eyerender.eye.catalogue import load_eye
from eyerender.scene.spec import SceneSpec
from tests.support.dataset_specs import mapping, plan, write
from tests.support.paths import load

PEOPLE = ("people_eyelink", "people_iris_camera", "people_nvgaze", "people_openeds", "people_pupil_core")
HEADSETS = ("people_any_headset", "people_two_cameras")


def test_shipped_specs_load_and_come_back_from_their_own_yaml(tmp_path):
    assert sorted(shipped_datasets()) == [
        "bench_world",
        "dataset_binocular",
        "dataset_glasses",
        "dataset_quick",
        "dataset_region",
        "dataset_sequence",
        *sorted((*PEOPLE, *HEADSETS)),
    ]
    for name, path in shipped_datasets().items():
        spec = DatasetSpec.load(path)
        spec.dump(tmp_path / "copy.yaml")
        assert DatasetSpec.load(tmp_path / "copy.yaml") == spec
        made = Plan.load(name)
        assert len(spec.shards) >= 8
        assert realise(made, spec.selection.samples[-1], frames_of(made)).sample is not None


@pytest.mark.parametrize("name", sorted({"dataset_quick", "dataset_region", *PEOPLE} - {"people_iris_camera"}))
def test_specs_still_give_their_samples(name):
    """The same numbers to the last digit as when the file was written."""
    golden = load("samples_1.json")[name]
    made = Plan.of(DatasetSpec.from_mapping(golden["spec"]))
    for sample in golden["samples"]:
        assert json.loads(json.dumps(made.draw(sample["sample"]).to_mapping())) == sample


def test_a_smaller_count_makes_samples_of_the_same_plan(tmp_path):
    # Subjects and splits are parts of the whole plan, so nothing of a sample may depend on how many are made.
    for changes in ({}, {"subjects": None}):
        file = write(tmp_path / "spec.yaml", **changes)
        whole, part = Plan.load(file), Plan.load(file, count=5)
        assert part.spec.count == len(part.spec.selection.samples) == 5
        assert part.digest == whole.digest
        assert [part.draw(i).to_mapping() for i in range(24)] == [whole.draw(i).to_mapping() for i in range(24)]
        with pytest.raises(InputError, match="must be 0 to 23"):
            part.draw(24)
        # A part of a part; the whole again is the plan itself.
        part.spec.dump(tmp_path / "part.yaml")
        assert Plan.load(tmp_path / "part.yaml", count=2).spec == whole.spec.first(2)
        assert Plan.load(tmp_path / "part.yaml", count=24).spec == whole.spec
    # Fewer samples than subjects are planned are made too.
    assert Plan.load("dataset_quick", count=2).draw(1).to_mapping() == Plan.load("dataset_quick").draw(1).to_mapping()


def test_a_larger_count_continues_the_plan_with_new_subjects(tmp_path):
    own = Plan.load(write(tmp_path / "spec.yaml"))
    larger = Plan.load(tmp_path / "spec.yaml", count=60)
    assert larger.spec.planned == 24
    assert [larger.subject_of(i) for i in (0, 5, 6, 23, 24, 29, 47)] == [
        *((0, 0), (0, 5), (1, 0), (3, 5)),
        *((4, 0), (4, 5), (7, 5)),
    ]
    for i in range(24):
        assert larger.draw(i).to_mapping() == own.draw(i).to_mapping()
    for block in range(3):
        splits = Counter(larger.split_of(s) for s in range(4 * block, 4 * block + 4))
        assert splits == {"train": 2, "validation": 1, "test": 1}
    assert list(larger.spec.selection.samples) == [*range(48), *(48 + 6 * s + k for s in range(4) for k in range(3))]


@pytest.mark.parametrize("planned", [24, 23, 7, 30])
@pytest.mark.parametrize("subjects", [1, 4, 7])
def test_a_choice_goes_through_the_subjects_in_rounds(planned, subjects):
    for count in range(1, 2 * planned + 1):
        whole = [i for block in range(count // planned) for i in range(block * planned, (block + 1) * planned)]
        found = Selection(count=count, planned=planned, subjects=subjects, shard_size=5, spread=count % planned > 0)
        block = range(len(whole), len(whole) + planned)
        order = sorted(block, key=lambda i: (i - found.first_of(found.subject_of(i)), found.subject_of(i)))
        expected = sorted(whole + order[: count - len(whole)])
        assert list(found.samples) == expected
        assert [i for shard in found.shards for i in found.shard_samples(shard)] == expected
        assert all(found.shard_samples(shard) for shard in found.shards)
        assert found.subject_count == len({found.subject_of(i) for i in expected})


def test_a_small_plan_has_shards_for_several_workers():
    data = mapping()
    del data["shard_size"]
    assert DatasetSpec.from_mapping(data).shard_size == 2
    assert DatasetSpec.from_mapping({**data, "count": 16 * 64}).shard_size == 64
    assert DatasetSpec.from_mapping({**data, "count": 10**6}).shard_size == 64


def test_neighbours_of_a_spread_order_are_far_apart():
    assert in_spread_order(range(8)) == [0, 4, 2, 6, 1, 5, 3, 7]
    assert sorted(in_spread_order(range(13))) == list(range(13))
    assert in_spread_order([]) == []


def test_a_plan_has_at_least_the_samples_and_the_subjects_that_are_asked_for():
    for changes, words in (
        ({"planned": 0}, "planned: must be >= 1"),
        ({"planned": 30, "subjects": 31}, r"subjects: must be at most 30 \(count or planned\), not 31"),
    ):
        with pytest.raises(InputError, match=words):
            plan(**changes)


def test_another_eye_takes_the_place_of_the_specs_own(tmp_path, monkeypatch):
    own, other = Plan.load("dataset_quick"), Plan.load("dataset_quick", eye="E4")
    assert own.digest != other.digest
    a, b = own.draw(5), other.draw(5)
    assert (a.eye["name"], b.eye["name"]) == ("E2 of subject 0", "E4")
    # Nothing else changes, but that E2's parameters are not asked for.
    assert {k: v for k, v in a.draws.items() if not k.startswith("eye_parameters")} == b.draws
    load_eye("E4").model_copy(update={"name": "mine"}).dump(tmp_path / "mine.yaml")
    monkeypatch.chdir(tmp_path)
    assert Plan.load("dataset_quick", eye="mine.yaml").draw(5).build().eye_spec.name == "mine"


def test_blinks_pass_and_lids_stay_also_inside_a_choice():
    lids = {"seed": {"draw": "integer", "low": 1, "high": 10**6}, "blink": {"draw": "uniform", "low": 0.0, "high": 0.5}}
    made = plan(scene__region={"draw": "choice", "values": [None, lids]})
    regions = defaultdict(list)
    for i in range(24):
        sample = made.draw(i)
        regions[sample.turn.subject].append(sample.scene["region"])
    kinds = {subject: {region is None for region in mine} for subject, mine in regions.items()}
    assert sorted(map(len, kinds.values())) == [1, 1, 1, 1]
    lidded = [mine for mine in regions.values() if mine[0] is not None]
    assert lidded
    for mine in lidded:
        assert len({region["seed"] for region in mine}) == 1
        assert len({region["blink"] for region in mine}) == 6


def test_an_eye_drawn_as_a_whole_is_refused():
    with pytest.raises(InputError, match="draw single values of the eye"):
        plan(scene__eye={"draw": "choice", "values": [{"model": "E1"}, {"model": "E2"}]}, eye_parameters={})


def test_a_sample_depends_on_nothing_but_spec_and_index():
    forwards = [plan().draw(i).to_mapping() for i in range(24)]
    again = plan()
    backwards = [again.draw(i).to_mapping() for i in reversed(range(24))]
    assert backwards[::-1] == forwards
    sent = Plan.from_mapping(pickle.loads(pickle.dumps(plan().to_mapping())), plan().base)
    assert sent.digest == plan().digest
    assert sent.draw(11).to_mapping() == forwards[11]
    assert plan(seed=6).draw(11).draws != forwards[11]["draws"]


def test_samples_are_plain_scenes():
    for i in range(24):
        sample = plan().draw(i)
        spec = SceneSpec.from_mapping(yaml.safe_load(yaml.safe_dump(sample.scene)))
        assert spec.eye.pupil_diameter_mm == sample.draws["eye.pupil_diameter_mm"]
        assert 2.5 <= spec.eye.pupil_diameter_mm <= 6.0
        assert spec.subject.ipd_mm == sample.draws["subject.ipd_mm"]
        radius = sample.draws["eye_parameters.E2.cornea.0.shape.radius_mm"]
        assert sample.build().eye_spec.to_mapping()["cornea"][0]["shape"]["radius_mm"] == radius
    assert len({plan().draw(i).scene["seed"] for i in range(24)}) == 24


def test_an_identity_fixes_its_eye_and_its_looks():
    made = plan()
    identity = defaultdict(set)
    frames = defaultdict(set)
    for i in range(24):
        sample = made.draw(i)
        names = ("look.iris_albedo", "subject.ipd_mm", "eye_parameters.E2.cornea.0.shape.radius_mm")
        identity[sample.turn.subject].add(tuple(sample.draws[n] for n in names))
        frames[sample.turn.subject].add(sample.draws["eye.pupil_diameter_mm"])
    assert {len(v) for v in identity.values()} == {1}
    assert len(set.union(*identity.values())) == 4
    assert {len(v) for v in frames.values()} == {6}


@pytest.mark.parametrize(("count", "subjects"), [(24, 4), (25, 4), (7, 7), (100, 33)])
def test_subjects_take_consecutive_samples_alike(count, subjects):
    made = plan(count=count, subjects=subjects)
    pairs = [made.subject_of(i) for i in range(count)]
    assert [s for s, _ in pairs] == sorted(s for s, _ in pairs)
    sizes = np.bincount([s for s, _ in pairs])
    assert len(sizes) == subjects
    assert sizes.max() - sizes.min() <= 1
    for s in range(subjects):
        assert [k for q, k in pairs if q == s] == list(range(sizes[s]))


def test_splits_part_the_subjects_by_their_shares():
    made = plan(count=1000, subjects=1000)
    names = [made.split_of(s) for s in range(1000)]
    assert [names.count(n) for n in ("train", "validation", "test")] == [500, 250, 250]
    # In random order: blocks of one split would be longer.
    assert sum(a != b for a, b in pairwise(names)) > 500
    other = plan(count=1000, subjects=1000)
    assert names == [other.split_of(s) for s in reversed(range(1000))][::-1]


def test_a_sample_that_cannot_be_made_is_drawn_again():
    # Half of the targets lie behind the head, where no eye can look.
    made = plan(
        **{"scene.targets": {"world_mm": [[{"draw": "uniform", "low": -600, "high": 600}, 0, 0]]}, "attempts": 40}
    )
    rejected = 0
    for i in range(24):
        found = realise(made, i, 1)
        assert found.sample is not None
        attempts = [r.attempt for r in found.rejections]
        assert attempts == list(range(found.sample.turn.attempt))
        for r in found.rejections:
            x = made.draw(i, r.attempt).draws["targets.world_mm.0.0"]
            assert x < 120  # behind, or too near to the eye
            assert r.reason
        rejected += len(attempts)
        # Another attempt is another frame of the same subject.
        assert made.draw(i, 1).draws["look.iris_albedo"] == made.draw(i, 0).draws["look.iris_albedo"]
        assert made.draw(i, 1).draws["eye.pupil_diameter_mm"] != made.draw(i, 0).draws["eye.pupil_diameter_mm"]
    assert 5 < rejected < 100


def test_a_sample_with_nothing_left_to_draw_is_given_up_at_once():
    made = plan(**{"scene.targets": {"world_mm": [[-600, 0, 0]]}, "scene.eye.pupil_diameter_mm": 4.0})
    found = realise(made, 3)
    assert found.sample is None
    assert len(found.rejections) == 1
    with pytest.raises(InputError, match="sample 0 cannot be made"):
        frames_of(made)


def test_an_identity_whose_eye_cannot_be_is_drawn_again():
    # A cornea of less than 5.07 mm radius (5.85 sqrt(1 - 0.25)) does not reach its own limbus.
    wide = {"draw": "uniform", "low": 3.0, "high": 8.5}
    made = plan(eye_parameters={"E2": {"cornea.0.shape.radius_mm": wide}}, subjects=12)
    again = 0
    for s in range(12):
        attempt, reasons = made.identity(s)
        assert len(reasons) == attempt
        again += attempt
        sample = made.draw(2 * s)
        assert sample.turn.subject_attempt == attempt
        sample.build()
    assert again > 0


def test_pupils_must_lie_in_the_window_unless_not_required():
    far = {"scene.rig.cameras.0.look_at_mm": [0.0, 80.0, 0.0]}
    assert realise(plan(**far, attempts=2), 0).sample is None
    assert realise(plan(**far, require="nothing"), 0).sample is not None


def test_eyes_of_several_models():
    made = plan(**{"scene.eye.model": {"draw": "choice", "values": ["E1", "E2", "E5"]}, "count": 40, "subjects": 40})
    models = set()
    for i in range(40):
        sample = made.draw(i)
        model = sample.draws["eye.model"]
        models.add(model)
        assert (sample.eye["name"] != load_eye(model).name) == (model == "E2")
        asked = sample.draws["eye_parameters.E2.cornea.0.shape.radius_mm"]
        assert (asked is None) == (model != "E2")
        if model != "E2":
            assert sample.eye == load_eye(model).to_mapping()
    assert models == {"E1", "E2", "E5"}


def test_a_million_subjects_are_split_by_rank_and_more_by_thresholds():
    splits = {"b": 0.3, "a": 0.1, "c": 0.6}
    few = plan(count=999, subjects=None, splits=splits)
    counts = Counter(few.split_of(s) for s in range(999))
    assert counts == {"a": 100, "b": 300, "c": 599}
    numbers = [unit_number(5, "split", "subject", s, 0) for s in range(999)]
    order = sorted(range(999), key=numbers.__getitem__)  # the rule in its plainest form
    assert [few.split_of(s) for s in order] == ["a"] * 100 + ["b"] * 300 + ["c"] * 599
    many = plan(count=RANKED_SUBJECTS + 1, subjects=None, splits=splits)
    expected = ["a" if u < 0.1 else "b" if u < 0.4 else "c" for u in numbers]
    assert [many.split_of(s) for s in range(999)] == expected
    assert "_ranked" not in vars(many)
    assert plan(count=10**9, subjects=None, splits={"all": 1}).split_of(10**9 - 1) == "all"


def test_the_splits_of_existing_datasets_do_not_change():
    made = plan(count=5000, subjects=2000)
    found = hashlib.sha256(" ".join(map(made.split_of, range(2000))).encode()).hexdigest()
    assert found == "67f7fc7319740a4a7dd4998db5847cf02ae8a72a32133067ee597ae571ef9197"


@pytest.mark.parametrize("name", ["dataset_quick", "people_eyelink"])
def test_a_scene_that_is_drawn_as_a_number_is_an_error(name):
    drawn = {"draw": "uniform", "low": 1.0, "high": 2.0}
    spec = DatasetSpec.from_mapping({**Plan.load(name).spec.to_mapping(), "scene": drawn})
    with pytest.raises(InputError, match="scene: must be a mapping"):
        Plan.of(spec).draw(0)


@pytest.mark.parametrize(
    ("planned", "subjects", "size", "count"),
    [
        pytest.param(1000, 70, 100, 1000, id="even"),
        pytest.param(1003, 70, 97, 1003, id="uneven"),
        pytest.param(1003, 70, 97, 2300, id="grown"),
        pytest.param(1003, 70, 97, 333, id="spread"),
        pytest.param(50, 3, 64, 50, id="one-shard"),
        pytest.param(24, 24, 3, 30, id="a-subject-per-sample"),
    ],
)
def test_every_sample_is_in_one_shard(planned, subjects, size, count):
    spread = count % planned > 0
    own = {"planned": planned, "subjects": subjects, "shard_size": size}
    selection = Selection(count=count, spread=spread, interleave=5, **own)
    by_shard = {shard: selection.shard_samples(shard) for shard in selection.shards}
    assert sorted(k for samples in by_shard.values() for k in samples) == sorted(selection.samples)
    assert all(len(samples) <= size for samples in by_shard.values())
    assert all(selection.shard_of(k) == shard for shard, samples in by_shard.items() for k in samples)
    # A sample stays in its shard when the dataset grows.
    more = Selection(count=3 * planned, spread=False, interleave=5, **own)
    assert all(more.shard_of(k) == shard for shard, samples in by_shard.items() for k in samples)


def test_a_shard_of_a_thousand_has_fifty_subjects_and_runs_of_neighbours():
    selection = Selection(count=500_000, planned=500_000, subjects=1000, shard_size=1000, spread=False, interleave=1)
    for shard in (0, 17, 499):
        samples = np.array(selection.shard_samples(shard))
        assert len({selection.subject_of(int(k)) for k in samples}) >= 50
        assert np.count_nonzero(np.diff(samples) == 1) >= 800  # the last shards hold what is left of each subject


def test_hashes_are_those_of_splitmix64():
    """Published values of the reference implementation for the seed 1234567 (Vigna)."""
    published = [6457827717110365317, 3203168211198807973, 9817491932198370423]
    assert scrambled(np.arange(1, 4), 1234567).tolist() == published


def test_shards_have_their_size_across_the_blocks_of_a_plan():
    selection = Selection(count=12_160, planned=3_040, subjects=152, shard_size=1000, spread=False, interleave=1)
    sizes = [len(selection.shard_samples(shard)) for shard in selection.shards]
    assert sizes == [1000] * 12 + [160]
    assert sizes == [selection.shard_count(shard) for shard in selection.shards]
