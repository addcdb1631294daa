"""Sweeps of rigs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eyerender.apps.sweeps.run import GOALS, SweepRun, evaluate, pareto, run_sweep
from eyerender.apps.sweeps.spec import SweepSpec, SweptPlaces, layouts_of
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.design.eyebox import sharp_depth_mm
from eyerender.rig.defocus import confusion_px

SWEEP: dict[str, Any] = {
    "format": 1,
    "scene": "headset",
    "people": 2,
    "sweep": {
        "cameras": [{"places": {"points_mm": [[40, -38, -15], [42, -25, -12]]}}],
        "lights": {
            "places": {"surface_mm": [[28, -45, 12], [28, -18, 12], [28, -18, -12], [28, -45, -12]], "count": [3, 2]},
            "number": [2, 6],
            "intensity_mw_sr": [0.2],
        },
    },
}


def spec_of(**sweep: object) -> SweepSpec:
    return SweepSpec.from_mapping({**SWEEP, "sweep": {**SWEEP["sweep"], **sweep}})


def test_places_lie_evenly_on_curves_and_surfaces():
    curve = SweptPlaces.from_mapping({"curve_mm": [[0, 0, 0], [3, 0, 0], [3, 1, 0]], "count": 5}).places()
    np.testing.assert_allclose(curve, [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [3, 1, 0]], atol=1e-12)
    corners = [[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0]]
    grid = SweptPlaces.from_mapping({"surface_mm": corners, "count": [3, 2]}).places()
    np.testing.assert_allclose(grid, [[x, y, 0] for y in (0, 3) for x in (0, 1, 2)], atol=1e-12)
    for wrong in (
        {"points_mm": [[0, 0, 0]], "count": 1},
        {"curve_mm": corners},
        {"surface_mm": corners, "count": 4},
        {},
    ):
        with pytest.raises(InputError):
            SweptPlaces.from_mapping(wrong)


def test_layouts_are_all_combinations_and_sensors_keep_their_size():
    spec = spec_of(resolution_scale=[1.0, 0.5])
    layouts = layouts_of(spec, spec.base(Path()))
    assert len(layouts) == 2 * 2 * 2
    half = next(layout for layout in layouts if layout.values["resolution_scale"] == 0.5)
    whole = layouts[0]
    small, large = half.scene["rig"]["cameras"][0], whole.scene["rig"]["cameras"][0]
    assert small["resolution_px"] == [320, 240]
    # The angle of view stays: focal length over width.
    assert small["focal_length_px"] / 320 == large["focal_length_px"] / 640


def test_a_killed_sweep_in_shards_ends_like_one_run(tmp_path):
    spec = spec_of(cameras=[])
    scene = spec.base(Path())
    whole = run_sweep(spec, scene, tmp_path / "whole", SweepRun(workers=1))
    assert whole["complete"]
    parts = tmp_path / "parts"
    first = run_sweep(spec, scene, parts, SweepRun(workers=1, part=(1, 2)))
    assert first["missing"] == 1
    (parts / "layouts" / "000000.json").unlink()  # a kill leaves a layout without its file
    run_sweep(spec, scene, parts, SweepRun(workers=1, part=(2, 2)))
    done = run_sweep(spec, scene, parts, SweepRun(workers=1))
    assert json.loads(json.dumps(done)) == json.loads(json.dumps(whole))
    assert (parts / "layouts.csv").read_bytes() == (tmp_path / "whole" / "layouts.csv").read_bytes()
    two = [row for row in done["rows"] if row["values"]["number"] == 2]
    assert all(row["leds"] == 2 == len(row["lights_mm"]) for row in two)
    with pytest.raises(InputError, match="holds another sweep"):
        run_sweep(spec_of(cameras=[], resolution_scale=[0.5]), scene, parts)


def test_the_pareto_front_is_what_no_other_row_beats():
    rng = np.random.default_rng(4)
    rows = [dict(zip(GOALS, values.tolist(), strict=True)) for values in rng.integers(0, 4, (60, len(GOALS)))]
    rows[3]["noise_deg"] = None
    found = pareto(rows)

    def value(row: dict, goal: str) -> float:
        return float("inf") if row[goal] is None else GOALS[goal] * row[goal]

    for k, row in enumerate(rows):
        beaten = any(
            all(value(other, g) <= value(row, g) for g in GOALS) and any(value(other, g) < value(row, g) for g in GOALS)
            for other in rows
        )
        assert found[k] != beaten


def test_sweeps_that_cannot_be_are_refused():
    for sweep, reason in (
        ({"cameras": [{"camera": 3}]}, "there is no camera 3"),
        ({"cameras": [{"focal_length_mm": [4.0]}]}, "has no focal_length_mm"),
        ({"lights": {**SWEEP["sweep"]["lights"], "number": [7]}}, "must be at most 6"),
    ):
        spec = spec_of(**sweep)
        with pytest.raises(InputError, match=reason):
            layouts_of(spec, spec.base(Path()))


def test_a_long_lens_pays_with_depth_and_field_and_tolerances_count(tmp_path):
    """A longer lens has less noise. It is sharp over less depth, and its picture does not hold the whole eye box."""
    spec = SweepSpec.from_mapping({
        "format": 1, "scene": "headset", "people": 1, "sweep": {"cameras": [{"focal_length_px": [720, 2400]}]},
    })  # fmt: skip
    scene, tolerances = spec.base(Path()), tmp_path / "tolerances.yaml"
    one = {"part": "camera", "quantity": "rotation_deg", "sd": 0.2, "when": "after"}
    tolerances.write_text(json.dumps({"format": 1, "tolerances": [one]}))
    (tmp_path / "sweep.yaml").write_text(spec.to_yaml())
    out = ["-o", str(tmp_path / "out"), "--workers", "1"]
    assert run(["sweep", str(tmp_path / "sweep.yaml"), "--tolerances", str(tolerances), *out]) == 0
    short, long = json.loads((tmp_path / "out/summary.json").read_text())["rows"]
    assert long["noise_deg"] < short["noise_deg"]
    assert long["sharp_depth_mm"] < short["sharp_depth_mm"]
    assert long["field"] < 0.9
    assert short["field"] == 1.0
    assert 0 < short["units_deg"] < 1
    assert short["tolerances"][0] == {**one, "number": "all", "gaze_deg": short["tolerances"][0]["gaze_deg"]}
    with pytest.raises(InputError, match="holds another sweep"):
        run_sweep(spec, scene, tmp_path / "out", SweepRun(workers=1))
    file = tmp_path / "wrong.yaml"
    file.write_text("format: 1\ntolerances:\n- {part: led, number: 9, quantity: position_mm, sd: 1, when: after}\n")
    assert run(["sweep", str(tmp_path / "sweep.yaml"), "-o", str(tmp_path / "no"), "--tolerances", str(file)]) == 2
    assert not (tmp_path / "no").exists()


def test_the_sharp_depth_ends_where_the_circle_of_confusion_reaches_the_limit(tmp_path):
    scene = SweepSpec.from_mapping(SWEEP).base(Path()).with_({"lens.focus_mm": 45.0})
    found = sharp_depth_mm(scene, 1.0)
    depth = np.linspace(40.0, 50.0, 100_001)
    disc = confusion_px(scene.spec.lens, scene.rig.cameras[0], scene.spec.sensor, depth)
    assert found == pytest.approx(np.ptp(depth[disc <= 1.0]), abs=2e-4)  # two steps of the depth


def test_noise_falls_with_the_power_of_the_leds():
    place = {"curve_mm": [[28, -45, 12], [28, -18, -12]], "count": 3}
    spec = SweepSpec.from_mapping({
        "format": 1, "scene": "headset", "people": 1,
        "sweep": {"lights": {"places": place, "intensity_mw_sr": [0.05, 0.1, 0.2]}},
    })  # fmt: skip
    rows = [evaluate(spec, layout) for layout in layouts_of(spec, spec.base(Path()))]
    noise = [row["noise_deg"] for row in rows]
    assert noise == sorted(noise, reverse=True)
    assert noise[0] > 1.2 * noise[2]  # at least: with shot noise alone it would be 2
    assert len({row["dropout"] for row in rows}) == 1
