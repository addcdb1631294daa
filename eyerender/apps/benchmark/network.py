"""Extractors that are networks in ONNX files, given as `onnx:FILE`.

The only input is a float32 tensor (1 or any, 1, h, w): a grey picture whose levels are shares of the full scale. The
picture is fitted into h x w px without a change of its proportions, in the middle of zeros, as by `size` of
`eyerender.torch.FolderDataset`. Two outputs are read: `pupil_ellipse` (1, 5), which is x, y, a, b in px of that picture
(pixel centres at integers) and the angle of a in rad from +x towards +y; and `confidence` (1, 1), 0 to 1. A pupil with
a confidence below 0.5 is missing, and its ellipse may be anything. The metadata of the file hold `eyerender:
network/1`, which stands for this meaning of its numbers.

Files come from anybody: no file beside them is opened, operators that ONNX Runtime does not know are refused, and so is
a network whose first run, on a grey ramp, takes more than 20 s.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from threading import Timer
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Singles
from ...base.errors import InputError, one_line
from ...base.storage.files import read_bytes, shown
from ...dataset.training.place import Placement, warped

KEY, VERSION = "eyerender", "network/1"
OUTPUTS = {"pupil_ellipse": 5, "confidence": 1}
LARGEST_BYTES = 2**29
_LARGEST_PX = 4096
_TRIAL_S = 20.0  # longest first run of a network
_SURE = 0.5


@dataclass(frozen=True, slots=True)
class NetworkExtractor:
    """An extractor that runs a network (`protocol.Extractor`)."""

    session: Any  # the `onnxruntime.InferenceSession`
    size: tuple[int, int]  # (width, height) of the pictures that the network takes
    conventions: ClassVar[dict[str, str]] = {"angle_of": "first"}
    reports: ClassVar[tuple[str, ...]] = ("pupil",)

    def __call__(self, image: NDArray[Any], request: Mapping[str, Any], /) -> dict[str, Any]:
        """Find the pupil in a picture (h, w) of integer codes.

        Raises:
            ValueError: the picture has no codes, or an output is not finite.
        """
        if image.dtype.kind != "u":
            raise ValueError("a network needs a picture of integer codes")
        levels = image.astype(np.float32) / np.float32(2 ** request["bit_depth"] - 1)
        at = Placement.fit((image.shape[1], image.shape[0]), self.size)
        ellipse, confidence = self.run(warped(levels, at, smooth=True))
        if confidence < _SURE:
            reason = f"the network's confidence is {confidence:.2f}"
            return {"pupil": {"status": "missing", "reason": reason, "confidence": confidence}}
        return {
            "pupil": {
                "status": "ok",
                "confidence": confidence,
                "centre_px": ((ellipse[:2] - at.offset) / at.scale).tolist(),
                "axes_px": (ellipse[2:4] / at.scale).tolist(),
                "angle": float(ellipse[4]),
            }
        }

    def run(self, levels: Singles, options: Any = None) -> tuple[NDArray[np.float64], float]:
        """Run the network on a picture of its size, and return the ellipse (5,) and the confidence.

        Raises:
            ValueError: an output has another size, the confidence is not 0 to 1, or the ellipse of a found pupil is not
                finite.
        """
        name = self.session.get_inputs()[0].name
        found = self.session.run(list(OUTPUTS), {name: np.ascontiguousarray(levels[None, None])}, options)
        for (output, count), value in zip(OUTPUTS.items(), found, strict=True):
            if np.size(value) != count:
                raise ValueError(f"output {output!r} must hold {count} numbers for each picture")
        ellipse, confidence = np.asarray(found[0], dtype=float).ravel(), float(np.ravel(found[1])[0])
        if not 0.0 <= confidence <= 1.0:
            raise ValueError(f"the confidence must be 0 to 1, not {confidence:g}")
        if confidence >= _SURE and not np.all(np.isfinite(ellipse)):
            raise ValueError("the ellipse of a found pupil must be finite")
        return ellipse, confidence


def load_network(path: str) -> NetworkExtractor:
    """Load a network from an ONNX file, and run it once.

    Raises:
        InputError: the file cannot be read or is no ONNX file, it needs other files or unknown operators, its input,
            outputs or metadata are others than above, or onnx and onnxruntime are not installed.
    """
    content = read_bytes(path, limit=LARGEST_BYTES)
    try:
        import onnx
        import onnxruntime
    except ImportError as error:
        reason = f"needs {error.name} (the extra 'torch'); run: pip install onnx onnxruntime"
        raise InputError(reason, source=path) from None
    try:
        model = onnx.load_model_from_string(content)
    except Exception as error:  # of protobuf, whose classes differ between its versions
        raise InputError("is not an ONNX file", source=path) from error
    if any(tensor.data_location == onnx.TensorProto.EXTERNAL for tensor in _tensors(model)):
        raise InputError("keeps weights in other files; save the model as one file", source=path)
    version = {one.key: one.value for one in model.metadata_props}.get(KEY)
    if version != VERSION:
        had = "nothing" if version is None else shown(version)
        raise InputError(f"its metadata must hold {KEY!r}: {VERSION!r}, not {had}", source=path)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # times are those of one core
    options.log_severity_level = 4
    try:
        providers = ["CPUExecutionProvider"]
        session = onnxruntime.InferenceSession(content, options, providers=providers, enable_fallback=0)
    except Exception as error:  # ONNX Runtime has a class for each of its codes
        raise InputError(f"ONNX Runtime refuses it ({one_line(str(error), 160)})", source=path) from error
    network = NetworkExtractor(session, _size(session, path))
    width, height = network.size
    ramp = np.linspace(0.0, 1.0, width * height, dtype=np.float32).reshape(height, width)
    limit = onnxruntime.RunOptions()
    timer = Timer(_TRIAL_S, setattr, (limit, "terminate", True))
    timer.start()
    try:
        network.run(ramp, limit)
    except Exception as error:
        slow = f"it takes more than {_TRIAL_S:g} s" if limit.terminate else one_line(str(error), 160)
        raise InputError(f"cannot be run on a grey ramp ({slow})", source=path) from error
    finally:
        timer.cancel()
    return network


def _size(session: Any, path: str) -> tuple[int, int]:
    """Check inputs and outputs, and return the size (width, height) of the pictures."""
    inputs, names = session.get_inputs(), [one.name for one in session.get_outputs()]
    if missing := [name for name in OUTPUTS if name not in names]:
        own = ", ".join(shown(name) for name in names[:8])
        raise InputError(f"has no output {' and no '.join(missing)}; its outputs are {own}", source=path)
    shape = inputs[0].shape if len(inputs) == 1 and inputs[0].type == "tensor(float)" else []
    if len(shape) == 4 and (shape[0] == 1 or not isinstance(shape[0], int)) and shape[1] == 1:
        height, width = shape[2:]
        if all(isinstance(n, int) and 1 <= n <= _LARGEST_PX for n in (height, width)):
            return width, height
    raise InputError(f"must have one float32 input (1, 1, h, w), up to {_LARGEST_PX} px", source=path)


def _tensors(message: Any) -> Iterator[Any]:
    """Find all tensors in a message of ONNX, at any depth."""
    if message.DESCRIPTOR.name == "TensorProto":
        yield message
        return
    for field, value in message.ListFields():
        if field.message_type is not None:
            for one in [value] if hasattr(value, "DESCRIPTOR") else value:
                if hasattr(one, "DESCRIPTOR"):
                    yield from _tensors(one)
