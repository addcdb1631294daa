"""Networks in ONNX files as extractors, and the example that makes one."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from eyerender.apps.benchmark.network import load_network
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from tests.support.paths import ROOT

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

META = {"eyerender": "network/1"}
OUTPUTS = {"pupil_ellipse": [[30.0, 20.0, 8.0, 5.0, 0.5]], "confidence": [[0.9]]}


def network(path, *, outputs=OUTPUTS, shape=(1, 1, 40, 60), meta=META, domain="", external=False):
    """Write a network that answers the same ellipse for every picture (plus 0 times the picture's mean)."""
    helper = onnx.helper
    nodes = [helper.make_node("ReduceMean", ["image"], ["mean"], keepdims=0),
             helper.make_node("Sub", ["mean", "mean"], ["zero"], domain=domain)]  # fmt: skip
    weights, results = [], []
    for name, values in outputs.items():
        weights.append(onnx.numpy_helper.from_array(np.array(values, np.float32), f"{name}_constant"))
        nodes.append(helper.make_node("Add", ["zero", f"{name}_constant"], [name]))
        results.append(helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None))
    image = helper.make_tensor_value_info("image", onnx.TensorProto.FLOAT, shape)
    graph = helper.make_graph(nodes, "constant", [image], results, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, meta)
    if external:
        onnx.save(model, path, save_as_external_data=True, location="weights.bin", size_threshold=0)
    else:
        onnx.save(model, path)
    return path


@pytest.fixture
def pictures(tmp_path):
    """A picture of 120 x 160 px, which a network of 60 x 40 px sees at a quarter of its size, 15 px from the left."""
    home = tmp_path / "pictures"
    home.mkdir()
    Image.fromarray(np.full((160, 120), 100, np.uint8)).save(home / "a.png")
    row = "image,centre_x_px,centre_y_px,semi_axis_a_px,semi_axis_b_px,angle_deg"
    (home / "labels.csv").write_text(f"{row}\na.png,61.5,81.5,32,20,{np.degrees(0.5)}\n")
    return home


def test_a_network_runs_as_an_extractor_in_px_of_the_picture(pictures, tmp_path):
    path = network(tmp_path / "constant.onnx")
    assert run(["bench-extractors", str(pictures), "-o", str(tmp_path / "out"), "--extractor", f"onnx:{path}"]) == 0
    (entry,) = json.loads((tmp_path / "out" / "results.json").read_text())["extractors"]
    assert entry["name"] == "constant"
    assert entry["summary"]["right"] == 1
    assert entry["summary"]["centre_px"]["median"] == pytest.approx(0, abs=1e-5)
    assert entry["summary"]["semi_axes_bias_px"] == pytest.approx([0, 0], abs=1e-4)


def test_an_unsure_network_finds_no_pupil(pictures, tmp_path):
    path = network(tmp_path / "unsure.onnx", outputs=OUTPUTS | {"confidence": [[0.4]]}, shape=("n", 1, 40, 60))
    arguments = ["bench-extractors", str(pictures), "-o", str(tmp_path / "out"), "--extractor", f"unsure=onnx:{path}"]
    assert run(arguments) == 0
    (entry,) = json.loads((tmp_path / "out" / "results.json").read_text())["extractors"]
    assert entry["summary"]["none"] == 1
    assert entry["failures"][0]["reason"] == "the network's confidence is 0.40"


WRONG = {
    "no metadata": ({"meta": {}}, "its metadata must hold 'eyerender': 'network/1', not nothing"),
    "other metadata": ({"meta": {"eyerender": "network/2"}}, "not 'network/2'"),
    "no confidence": ({"outputs": {"pupil_ellipse": [[1, 2, 3, 4, 5]]}}, "has no output confidence"),
    "four numbers": ({"outputs": OUTPUTS | {"pupil_ellipse": [[1, 2, 3, 4]]}}, "must hold 5 numbers"),
    "not finite": ({"outputs": OUTPUTS | {"confidence": [[np.nan]]}}, "the confidence must be 0 to 1, not nan"),
    "colours": ({"shape": (1, 3, 40, 60)}, "must have one float32 input (1, 1, h, w)"),
    "no size": ({"shape": (1, 1, "h", "w")}, "must have one float32 input"),
    "huge": ({"shape": (1, 1, 40, 50_000)}, "up to 4096 px"),
    "other files": ({"external": True}, "keeps weights in other files"),
    "unknown operators": ({"domain": "evil"}, "ONNX Runtime refuses it"),
}


@pytest.mark.parametrize(("changes", "words"), WRONG.values(), ids=WRONG)
def test_a_wrong_network_is_refused(tmp_path, changes, words):
    with pytest.raises(InputError) as refused:
        load_network(str(network(tmp_path / "wrong.onnx", **changes)))
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("content", "words"), [(b"no network", "is not an ONNX file"), (None, "no such file")])
def test_a_file_that_is_no_network_ends_the_command_with_one_line(pictures, tmp_path, capfd, content, words):
    path, output = tmp_path / "wrong.onnx", tmp_path / "out"
    if content is not None:
        path.write_bytes(content)
    assert run(["bench-extractors", str(pictures), "-o", str(output), "--extractor", f"onnx:{path}"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"error: --extractor onnx:{path}: ")
    assert words in line
    assert not output.exists()


def test_the_example_trains_tests_and_writes_a_network_that_the_benchmark_takes(folder, tmp_path):
    source = next((folder / "images").rglob("*.png"))
    (tmp_path / "one__eye.png").write_bytes(source.read_bytes())
    table = tmp_path / "ellipses.csv"
    table.write_text("file,x_px,y_px,a_px,b_px,angle_deg\none__eye.png,20,20,5,4,30\n")
    script = [sys.executable, ROOT / "examples" / "gaze_network.py", folder, "--copies", "4", "--epochs", "1"]
    options = ["--test", folder, "--onnx", tmp_path / "gaze.onnx", "--pictures", tmp_path, "--ellipses", table]
    done = subprocess.run([*script, *options], capture_output=True, text=True, check=True)
    written, tested, *figures = done.stdout.splitlines()[2:]
    assert "outputs within" in written  # the script ends with an error if they differ by more than 1e-4
    assert float(written.split("within ")[1].split()[0]) <= 1e-4
    assert tested.endswith("1 networks")
    (error,) = [line.split()[2] for line in figures if line.startswith("  gaze, deg")]
    assert 0 <= float(error) <= 180
    assert figures[-1].split()[:2] == ["one", "1"]
    assert load_network(str(tmp_path / "gaze.onnx")).size == (128, 128)
    failed = subprocess.run([*script[:2], tmp_path / "none"], capture_output=True, text=True, check=False)
    assert failed.returncode == 2
    assert len(failed.stderr.splitlines()) == 1


def test_the_shipped_weights_are_small_and_run_as_an_extractor():
    path = ROOT / "examples" / "weights" / "gaze.onnx"
    assert path.stat().st_size < 400_000
    found = load_network(str(path))
    assert found.size == (128, 128)
    y, x = np.mgrid[:240, :240]
    picture = np.where(np.hypot(x - 130, y - 120) < 12, 10, np.where(np.hypot(x - 130, y - 120) < 36, 80, 150))
    pupil = found(picture.astype(np.uint8), {"bit_depth": 8})["pupil"]
    assert pupil["status"] == "ok"
    assert np.hypot(pupil["centre_px"][0] - 130, pupil["centre_px"][1] - 120) < 6


def test_the_example_turns_pictures_upright_with_their_labels(monkeypatch):
    """Each quarter turn, mirrored or not: the bright pixel stays at the pupil, the gaze in the world is the same."""
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    example = importlib.import_module("gaze_network")

    rng, count = np.random.default_rng(0), 8
    turns = [Rotation.from_euler("z", 90 * k + 20, degrees=True).as_matrix() for k in range(4)] * 2
    ahead = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])  # up in the world is up in the picture
    mirrored = torch.arange(count) >= 4
    gaze = torch.nn.functional.normalize(torch.tensor(rng.normal(size=(count, 3))), dim=-1)
    column, row = rng.integers(example.SIZE, size=(2, count))
    image = torch.zeros(count, 1, example.SIZE, example.SIZE)
    image[torch.arange(count), 0, row, column] = 1
    pixels = torch.tensor(np.stack([column, row], axis=-1)).double()
    K = torch.tensor([[100.0, 0, 50], [0, 110, 70], [0, 0, 1]]).repeat(count, 1, 1)
    R = torch.tensor(np.array(turns) @ ahead)
    data = {"image": image, "mirrored": mirrored, "R": R.clone(), "K": K, "camera_gaze": gaze.clone(),
            "gaze": gaze.clone(), "shape": torch.zeros(count, 3), "pupil": pixels.repeat(1, 3)[:, :5].clone(),
            "points": ((pixels + 0.5) * 2 / example.SIZE - 1)[:, None].clone()}  # fmt: skip
    own = gaze * torch.where(mirrored[:, None], torch.tensor([-1.0, 1, 1]), 1)
    found = example.upright(data)
    x, y = found["pupil"][:, :2].long().unbind(-1)
    assert (found["image"][torch.arange(count), 0, y, x] == 1).all()
    torch.testing.assert_close((found["points"][:, 0] + 1) * example.SIZE / 2 - 0.5, found["pupil"][:, :2])
    torch.testing.assert_close(
        (found["R"].mT @ found["camera_gaze"][..., None])[..., 0], (R.mT @ own[..., None])[..., 0]
    )
    assert (found["R"][:, 1, 2] < -0.9).all()
