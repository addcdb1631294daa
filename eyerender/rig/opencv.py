"""Read camera calibrations written by OpenCV, ROS, Kalibr and scripts.

OpenCV's `cv2.FileStorage` writes YAML (with a special header and tags), XML or JSON, ROS `camera_info` in YAML, Kalibr
YAML whose keys are cameras. All are read as plain data, like YAML, JSON and .npz files of scripts with the usual names.
A key that may describe the lens and is not read is an error: half a calibration moves features by pixels.
"""

from __future__ import annotations

import io
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from ..base.arrays import Floats
from ..base.errors import InputError, Problems
from ..base.spec import LARGEST, MAX_YAML_BYTES, Spec, parse_yaml
from ..base.storage.files import parse_json, read_bytes, read_text, shown
from .distortion import FISHEYE_COUNT, RATIONAL_COUNT, FisheyeDistortion, RationalDistortion, coefficients_of

_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
_SUPPORTED = 8
_THIN_PRISM = "; thin prisms and tilted sensors are not supported"
# Names are compared in lower case, without punctuation.
_MATRIX = ("cameramatrix", "k", "kk", "intrinsicmatrix", "intrinsics", "mtx", "matrix")
_DISTORTION = (
    "distortioncoefficients", "distortioncoeffs", "distortioncoeff", "distcoeffs", "distcoeff", "distcoefs",
    "distortion", "dist", "d", "kc",
)  # fmt: skip
_ROTATION = ("r", "rotation", "rotationmatrix", "rvec", "rotationvector")
_TRANSLATION = ("t", "tmm", "tvec", "translation", "translationvector")
_SIZES = (("imagewidth", "imageheight"), ("width", "height"))
_SIZE = ("imagesize", "size", "resolution", "cameraresolution", "imgsize", "resolutionpx")
_MODEL = ("distortionmodel", "cameramodel", "camtype", "model")
_FOCAL = ("fx", "fy", "cx", "cy")
# What the writers state beside the lens: OpenCV's calibration programs, ROS, Pupil Labs, and common scripts in Python.
_HARMLESS = """
    calibrationtime calibrationdate nframes nrofframes framescount numframes numimages boardwidth boardheight boardsize
    squaresize markersize patternsize aspectratio fixaspectratio flags avgreprojectionerror perviewreprojectionerrors
    extrinsicparameters imagepoints gridpoints objpoints imgpoints objectpoints cameramatrixstddev distcoeffsstddev rms
    rmserror ret error meanerror totalerror reprojectionerror meanreprojectionerror reprojerror rvecs tvecs
    newcameramatrix newcameramtx optimalcameramatrix roi rectificationmatrix projectionmatrix binningx binningy header
    cameraname name id serial serialnumber date time timestamp version fps fisheyemodel
    camoverlaps rostopic tcamimu tcncnm1 timeshiftcamimu
""".split()  # noqa: SIM905
_LIKE_DISTORTION = re.compile(r"dist(?!ance)|coef|tangential|radial|fisheye|^[kps]\d$|^tau")
_UNNAMED = (
    "four coefficients in a column, without a model, may be a fisheye's; add distortion_model: fisheye, or plumb_bob "
    "for a pinhole"
)
_MODELS = ("plumbbob", "rationalpolynomial", "pinhole", "radtan", "radial", "brownconrady", "opencv", "none", "")
_FISHEYES = ("fisheye", "equidistant", "equi", "kannalabrandt", "kannalabrandt4", "kb4")


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenCvCalibration:
    """Content of a calibration file.

    Attributes:
        K: (3, 3) camera matrix, px.
        distortion: coefficients (5,), (6,) or (8,) of a model of `distortion.py`.
        R: (3, 3) rotation, world to camera; None if the file has no pose.
        t: (3,) translation, world to camera, in the file's unit of length; None if the file has no pose.
        size_px: width and height of the image; None if the file does not state them.
    """

    K: Floats
    distortion: Floats
    R: Floats | None
    t: Floats | None
    size_px: tuple[int, int] | None


def read_opencv(path: str | Path, camera: str | None = None) -> OpenCvCalibration:
    """Read the calibration of one camera; `camera` is its key in a file of several (Kalibr's cam0, cam1, ...).

    Raises:
        InputError: the file cannot be read, or uses an unsupported model; the message names the key.
    """
    source = str(path)
    content = read_bytes(path, limit=MAX_YAML_BYTES)
    found = (
        _archive(content, source)
        if content.startswith(b"PK")
        else _mapping(read_text(path, limit=MAX_YAML_BYTES), source)
    )
    return calibration_of(_one_camera(found, camera, source), source)


def _one_camera(found: dict[str, Any], camera: str | None, source: str) -> dict[str, Any]:
    """Return the keys of one camera of a file whose keys are cameras, or those of the file."""
    cameras = {key: value for key, value in found.items() if isinstance(value, dict) and "intrinsics" in value}
    if camera is not None and camera not in cameras:
        raise InputError(f"holds no camera {shown(camera)}, only {shown(', '.join(cameras))}", source=source)
    if camera is None and len(cameras) > 1:
        raise InputError(f"holds {', '.join(cameras)}; say which, by camera: {min(cameras)}", source=source)
    return cameras[camera or next(iter(cameras))] if cameras else found


def calibration_of(found: dict[str, Any], source: str) -> OpenCvCalibration:
    """Read the calibration of one camera from keys and values; InputError naming the key."""
    problems = Problems(source)
    data = _named(found, problems)
    if "p" in data:
        data.pop("r", None)  # a message of ROS: R rectifies, P projects what is rectified

    def array(names: tuple[str, ...]) -> tuple[str, Floats | None]:
        key, value = next((data[name] for name in names if name in data), (names[0], None))
        return key, None if value is None else problems.attempt(lambda: _array(value, source, key))

    key, K = array(_MATRIX)
    if K is None and all(name in data for name in _FOCAL):
        fx, fy, cx, cy = (_number(data[name], problems) for name in _FOCAL)
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if K is not None and K.shape in ((9,), (1, 9), (9, 1)):
        K = K.reshape(3, 3)
    if K is not None and K.shape == (4,):  # Kalibr's fu, fv, pu, pv
        K = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]])
    if K is None and len(problems) == 0:
        problems.add(f"missing; the file holds {shown(', '.join(k for k, _ in data.values()), 120)}", "camera_matrix")
    elif K is not None and K.shape != (3, 3):
        problems.add("must be a 3 x 3 matrix", key)
    own = next((data[name] for name in _DISTORTION if name in data and _is_own(data[name][1])), None)
    distortion = _own(*own, problems) if own else _distortion(*array(_DISTORTION), data, problems)
    R, t = _pose(array(_ROTATION), array(_TRANSLATION), problems)
    size = _size(data, problems)
    problems.check()
    assert K is not None
    return OpenCvCalibration(K=K, distortion=distortion, R=R, t=t, size_px=size)


def _named(found: dict[str, Any], problems: Problems) -> dict[str, tuple[str, Any]]:
    """Return (key, value) by normalised name; report keys that may change the lens and that nothing here reads."""
    data: dict[str, tuple[str, Any]] = {}
    for key, value in found.items():
        inner = {key: value}
        is_group = isinstance(value, dict) and "data" not in value and not _is_own(value)
        if is_group and _plain(key) in (*_MATRIX, *_DISTORTION):
            inner = value  # the numbers by name, as k1 and fx
        for inner_key, one in inner.items():
            if _plain(str(inner_key)) in data:
                problems.add(f"is the same as {data[_plain(str(inner_key))][0]}; remove one", str(inner_key))
            data[_plain(str(inner_key))] = (str(inner_key), one)
    groups = (_MATRIX, _DISTORTION, _ROTATION, _TRANSLATION)
    for group in groups:
        twice = [data[name][0] for name in group if name in data and data[name][1] is not None]
        if len(twice) > 1:
            problems.add(f"says the same as {twice[0]}; remove one", twice[1])
    known = {*_HARMLESS, *_FOCAL, *_SIZE, *_MODEL, *map(_plain, _COEFFICIENTS)}.union(*groups, *_SIZES)
    if "p" in data and _count(data["p"][1]) == 12:
        known.add("p")
    for name, (key, value) in data.items():
        if name not in known and (_LIKE_DISTORTION.search(name) or _is_numeric(value)):
            reason = "may describe the lens, but is not a key that is read; remove it if it does not, else rename it"
            problems.add(f"{reason} (camera_matrix, distortion_coefficients)", key)
    return data


def _plain(key: str) -> str:
    return re.sub(r"[^a-z0-9]", "", key.lower())


def _is_numeric(value: Any) -> bool:
    if isinstance(value, dict):
        return "data" in value
    if isinstance(value, list):
        return bool(value) and all(map(_is_numeric, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def _count(value: Any) -> int:
    value = value.get("data") if isinstance(value, dict) else value
    return sum(map(_count, value)) if isinstance(value, list) else 1


def _number(given: tuple[str, Any], problems: Problems) -> float:
    key, value = given
    if not _is_numeric(value) or isinstance(value, list | dict) or not abs(value) <= LARGEST:
        problems.add("must be a finite number", key)
        return 0.0
    return float(value)


def _archive(content: bytes, source: str) -> dict[str, Any]:
    """Read the arrays of an .npz file of NumPy."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(one.file_size for one in archive.infolist()) > 16 * MAX_YAML_BYTES:
                raise InputError("unpacks to too much", source=source)
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return {name: arrays[name].tolist() for name in arrays.files}
    except InputError:
        raise
    except Exception as error:  # zip files and NumPy's headers fail in many ways
        raise InputError(f"is not an .npz file of plain numbers ({type(error).__name__})", source=source) from None


def _mapping(text: str, source: str) -> dict[str, Any]:
    start = text.lstrip("\ufeff").lstrip()
    if start.startswith("<"):
        found = _xml(start, source)
    elif start.startswith("{"):
        found = parse_json(start, source=source)
    else:
        # OpenCV's header is not a valid YAML directive.
        plain = re.sub(r"\A%YAML:[^\n]*", "", start)
        found = parse_yaml(plain, source, mapping_tags=("opencv-matrix", "opencv-nd-matrix"))
    if not isinstance(found, dict):
        raise InputError("must hold named values", source=source)
    return {str(key): value for key, value in found.items()}


def _xml(text: str, source: str) -> dict[str, Any]:
    if text.count("<!") != text.count("<!--"):
        # Neither OpenCV nor ROS writes entities, and they could expand to gigabytes. They are refused even inside
        # comments, because only a parser can tell whether something is a comment.
        raise InputError("holds a document type or entities, which are not read", source=source)
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"is not valid XML: {error}", source=source) from None
    out: dict[str, Any] = {}
    for node in root:
        out[node.tag] = {part.tag: _numbers(part.text) for part in node} if len(node) else _numbers(node.text)
    return out


def _numbers(text: str | None) -> Any:
    """Parse an element's text as a number or a list of numbers; return the text itself if it holds anything else."""
    words = (text or "").split()
    try:
        found = [float(word) for word in words]
    except ValueError:
        return text
    return found[0] if len(found) == 1 else found


def _array(value: Any, source: str, key: str) -> Floats:
    """Convert an OpenCV matrix, or nested lists, to an array of finite numbers."""
    shape = None
    if isinstance(value, dict):
        shape, value = value.get("sizes", [value.get("rows"), value.get("cols")]), value.get("data")
        shape = shape if isinstance(shape, list) else [shape]
        value = value if isinstance(value, list) else [value]
    try:
        found = np.asarray(value)
        if shape is not None:
            found = found.reshape([int(size) for size in shape if size is not None])
    except (ValueError, TypeError, OverflowError):
        found = np.zeros(0, object)
    if found.dtype.kind not in "iuf" or not (np.abs(found) <= LARGEST).all():
        raise InputError("must be a matrix of finite numbers", source=source, path=key)
    return np.asarray(found, dtype=float)


def _is_own(value: Any) -> bool:
    """Return whether a distortion has the form of scenes, with its model."""
    return isinstance(value, dict) and value.get("model") in ("fisheye", "rational")


def _own(key: str, value: Any, problems: Problems) -> Floats:
    kind: type[Spec] = FisheyeDistortion if value["model"] == "fisheye" else RationalDistortion
    try:
        return coefficients_of(kind.from_mapping(value))
    except InputError as error:
        problems.add(error.reason, f"{key}.{error.path}")
        return np.zeros(5)


def _model(data: dict[str, tuple[str, Any]], problems: Problems) -> str | None:
    """Return the model that the file names, pinhole or fisheye; None if it names none. Report one that is unknown."""
    found = None
    for named, model in (data[name] for name in _MODEL if name in data):
        plain = _plain(str(model or ""))
        if plain in _FISHEYES:
            found = "fisheye"
        elif plain in _MODELS:
            found = found or "pinhole"
        else:
            problems.add(f"the model {shown(model)} is not supported; plumb_bob and fisheye are", named)
    _, fisheye = data.get("fisheyemodel", ("", None))
    return found if fisheye is None else ("fisheye" if fisheye != 0 else found or "pinhole")


def _distortion(key: str, found: Floats | None, data: dict[str, tuple[str, Any]], problems: Problems) -> Floats:
    model = _model(data, problems)
    names = ("k1", "k2", "k3", "k4") if model == "fisheye" else _COEFFICIENTS
    flat = {name: data[_plain(name)] for name in _COEFFICIENTS if _plain(name) in data}
    if flat and found is not None:
        problems.add(f"says the same as {key}; remove one", next(iter(flat.values()))[0])
    elif flat:
        key = ", ".join(named for named, _ in flat.values())
        found = np.array([_number(flat[name], problems) if name in flat else 0.0 for name in names])
        if unknown := [named for name, (named, _) in flat.items() if name not in names]:
            problems.add(f"a {model} has only {', '.join(names)}", ", ".join(unknown))
    if model is None and found is not None and (found.shape == (4, 1) or list(flat) == ["k1", "k2", "k3", "k4"]):
        problems.add(_UNNAMED, key)
    values = np.zeros(0) if found is None else found.ravel()
    if len(values) > len(names):
        problems.add(f"holds {len(values)} coefficients; the model has at most {len(names)}", key)
        return np.zeros(5)
    if model == "fisheye":
        out = np.zeros(FISHEYE_COUNT)
        out[: len(values)] = values
        return out
    extra = [_COEFFICIENTS[k] for k in range(_SUPPORTED, len(values)) if values[k] != 0]
    if extra:
        problems.add(f"{', '.join(extra)} must be 0{_THIN_PRISM}", key)
    out = np.zeros(RATIONAL_COUNT if np.any(values[5:_SUPPORTED]) else 5)
    out[: min(len(values), len(out))] = values[: len(out)]
    return out


def _pose(
    rotation: tuple[str, Floats | None], translation: tuple[str, Floats | None], problems: Problems
) -> tuple[Floats | None, Floats | None]:
    (r_key, R), (t_key, t) = rotation, translation
    if R is None and t is None:
        return None, None
    if R is None or t is None:
        has, lacks = (t_key, "rotation") if R is None else (r_key, "translation")
        problems.add(f"is given without the {lacks}", has)
        return None, None
    if R.size == 3:
        R = Rotation.from_rotvec(R.ravel()).as_matrix()
    if R.size == 9:
        R = R.reshape(3, 3)
    if R.shape != (3, 3):
        problems.add("must be a 3 x 3 matrix or a vector of 3 numbers", r_key)
    if t.size != 3:
        problems.add("must be a vector of 3 numbers", t_key)
    return R, t.ravel()


def _size(data: dict[str, tuple[str, Any]], problems: Problems) -> tuple[int, int] | None:
    given: Any = None
    key = "image size"
    for pair in _SIZES:
        if all(name in data for name in pair):
            key, given = ", ".join(data[name][0] for name in pair), [data[name][1] for name in pair]
            break
    else:
        for name in _SIZE:
            if name in data:
                key, given = data[name]
                given = given.get("data") if isinstance(given, dict) else given
                break
    if given is None:
        return None
    numbers = given if isinstance(given, list) and len(given) == 2 else []
    if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in numbers) or not numbers:
        numbers = [0]
    if not all(1 <= v <= 65536 and v == int(v) for v in numbers):
        problems.add("must be two whole numbers from 1 to 65536", key)
        return None
    return int(numbers[0]), int(numbers[1])
