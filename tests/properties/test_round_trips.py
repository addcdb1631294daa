"""What a person writes comes back the same from a mapping, from YAML and from a pickle."""

from __future__ import annotations

import pickle

import numpy as np
import yaml
from hypothesis import given
from hypothesis import strategies as st

from eyerender.eye.catalogue import load_eye
from eyerender.eye.spec import EyeSpec
from eyerender.region.anatomy import Region
from eyerender.scene.spec import SceneSpec
from tests.support.fuzzing import budget
from tests.support.scenes import mappings, number

SIZES = st.floats(1e-9, 1e9)  # numbers whose text needs an exponent are among them
SENSORS = st.fixed_dictionaries(
    {},
    optional={
        "exposure_ms": number(1e-6, 1e4),
        "full_well_e": number(100.0, 1e6),
        "bit_depth": st.sampled_from([8, 10, 12, 16]),
        "noise": st.booleans(),
    },
)
LOOKS = st.fixed_dictionaries(
    {},
    optional={
        "iris_albedo": number(0.01, 0.9),
        "iris_seed": st.integers(0, 2**32 - 1),
        "sclera_contrast": number(0.0, 1.0),
    },
)


@budget(25)
@given(mappings(), SENSORS, LOOKS, st.integers(0, 2**63 - 1), st.text(min_size=1, max_size=20), SIZES)
def test_scenes(data, sensor, look, seed, name, intensity):
    data["rig"]["lights"][0]["intensity_mw_sr"] = intensity
    spec = SceneSpec.from_mapping({**data, "sensor": sensor, "look": look, "seed": seed, "name": name})
    for again in (
        SceneSpec.from_mapping(spec.to_mapping()),
        SceneSpec.from_mapping(yaml.safe_load(spec.to_yaml())),
        pickle.loads(pickle.dumps(spec)),
    ):
        assert again == spec
        assert again.digest() == spec.digest()
        assert hash(again) == hash(spec)


@budget(30)
@given(st.sampled_from(["E1", "E2", "E3", "E4", "E5"]), number(0.98, 1.02), number(1.3, 1.4), number(-9.0, 9.0))
def test_eyes(model, factor, index, tilt_deg):
    data = load_eye(model).to_mapping()
    data["limbus_radius_mm"] *= factor
    data["cornea"][0]["medium"] = {"index": index}
    data["stop"]["tilt_deg"] = [0.0, tilt_deg, tilt_deg / 3]
    spec = EyeSpec.from_mapping(data)
    assert EyeSpec.from_mapping(spec.to_mapping()) == spec
    assert EyeSpec.from_mapping(yaml.safe_load(spec.to_yaml())) == spec


@budget(30)
@given(st.integers(0, 2**32 - 1), number(0.0, 1.0), number(0.0, 1.0))
def test_regions(seed, spread, blink):
    spec = Region.drawn(seed, spread=spread, blink=blink)
    again = Region.from_mapping(yaml.safe_load(yaml.safe_dump(spec.to_mapping())))
    assert again == spec
    assert np.isfinite([v for v in spec.to_mapping().values() if isinstance(v, float)]).all()
