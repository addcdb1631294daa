"""Near-infrared eye images through refractive corneas, with exact labels.

The public names below are the whole interface. They load their modules on first use, so `import eyerender` loads
neither Mitsuba nor OpenCV.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from . import gaze
    from .analytic.observer import AnalyticObserver, trace
    from .benchmark.protocol import Extractor
    from .benchmark.run import bench_extractors
    from .capture import EyeImage, render_windows
    from .comparison import Comparison, compare
    from .dataset.estimate import estimate
    from .dataset.export import export
    from .dataset.realise import sample
    from .dataset.run import generate
    from .dataset.sheet import preview
    from .dataset.spec import DatasetSpec
    from .dataset.validate import validate
    from .errors import BackendError, EyerenderError, InputError
    from .extraction import ExtractionSettings, extract
    from .eye.catalogue import load_eye
    from .eye.kappa import kappa_deg, with_kappa
    from .eye.margin import PupilMargin
    from .eye.model import EyeModel
    from .eye.parts import TopographySpec
    from .eye.spec import EyeSpec
    from .eye.topography import read_topography
    from .imagefolder import ImageFolder
    from .imageobserver import ImageObserver, detect
    from .images import LabelledImage, auto_exposed, export_scene, render, render_folder
    from .observation import Observations
    from .population.synteyes import SyntEye, SyntEyes
    from .quickstart import compare_folder, run_quickstart
    from .region.anatomy import Brow, Face, Fissure, Lashes, Lid, Region, Skin, TearFilm
    from .region.headspec import Head, HeadParts
    from .region.look import Look
    from .report.comparison import write_report
    from .rig.camera import CalibrationFile, Camera, CameraCalibration, PinholeCamera
    from .rig.imaging import Ambient, Lens, Motion, Opening, Panel, RadianceMap, Sun
    from .rig.light import Led, LedRing
    from .rig.rig import Rig, RigGeometry
    from .rig.screen import Screen
    from .rig.sensor import Sensor
    from .scene import Frame, Frames, Scene, load_scene, shipped_scenes
    from .scene.observer import Observer
    from .scene.people import Population
    from .scene.spec import Eye, EyeDirection, Picture, SceneSpec, Targets
    from .scene.subject import Subject
    from .status import Status

_HOMES = {
    "Ambient": "rig.imaging",
    "AnalyticObserver": "analytic.observer",
    "BackendError": "errors",
    "Brow": "region.anatomy",
    "CalibrationFile": "rig.camera",
    "Camera": "rig.camera",
    "CameraCalibration": "rig.camera",
    "Comparison": "comparison",
    "DatasetSpec": "dataset.spec",
    "ExtractionSettings": "extraction",
    "Extractor": "benchmark.protocol",
    "Eye": "scene.spec",
    "EyeDirection": "scene.spec",
    "EyeImage": "capture",
    "EyeModel": "eye.model",
    "EyeSpec": "eye.spec",
    "EyerenderError": "errors",
    "Face": "region.anatomy",
    "Fissure": "region.anatomy",
    "Frame": "scene",
    "Frames": "scene",
    "Head": "region.headspec",
    "HeadParts": "region.headspec",
    "ImageFolder": "imagefolder",
    "ImageObserver": "imageobserver",
    "InputError": "errors",
    "LabelledImage": "images",
    "Lashes": "region.anatomy",
    "Led": "rig.light",
    "LedRing": "rig.light",
    "Lens": "rig.imaging",
    "Lid": "region.anatomy",
    "Look": "region.look",
    "Motion": "rig.imaging",
    "Observations": "observation",
    "Observer": "scene.observer",
    "Opening": "rig.imaging",
    "Panel": "rig.imaging",
    "Picture": "scene.spec",
    "PinholeCamera": "rig.camera",
    "Population": "scene.people",
    "PupilMargin": "eye.margin",
    "RadianceMap": "rig.imaging",
    "Region": "region.anatomy",
    "Rig": "rig.rig",
    "RigGeometry": "rig.rig",
    "Scene": "scene",
    "SceneSpec": "scene.spec",
    "Screen": "rig.screen",
    "Sensor": "rig.sensor",
    "Skin": "region.anatomy",
    "Status": "status",
    "Subject": "scene.subject",
    "Sun": "rig.imaging",
    "SyntEye": "population.synteyes",
    "SyntEyes": "population.synteyes",
    "Targets": "scene.spec",
    "TearFilm": "region.anatomy",
    "TopographySpec": "eye.parts",
    "bench_extractors": "benchmark.run",
    "compare": "comparison",
    "compare_folder": "quickstart",
    "detect": "imageobserver",
    "estimate": "dataset.estimate",
    "export": "dataset.export",
    "auto_exposed": "images",
    "export_scene": "images",
    "extract": "extraction",
    "generate": "dataset.run",
    "kappa_deg": "eye.kappa",
    "load_eye": "eye.catalogue",
    "load_scene": "scene",
    "preview": "dataset.sheet",
    "read_topography": "eye.topography",
    "render": "images",
    "render_folder": "images",
    "render_windows": "capture",
    "run_quickstart": "quickstart",
    "sample": "dataset.realise",
    "shipped_scenes": "scene",
    "trace": "analytic.observer",
    "validate": "dataset.validate",
    "with_kappa": "eye.kappa",
    "write_report": "report.comparison",
}

__all__ = [
    "Ambient",
    "AnalyticObserver",
    "BackendError",
    "Brow",
    "CalibrationFile",
    "Camera",
    "CameraCalibration",
    "Comparison",
    "DatasetSpec",
    "ExtractionSettings",
    "Extractor",
    "Eye",
    "EyeDirection",
    "EyeImage",
    "EyeModel",
    "EyeSpec",
    "EyerenderError",
    "Face",
    "Fissure",
    "Frame",
    "Frames",
    "Head",
    "HeadParts",
    "ImageFolder",
    "ImageObserver",
    "InputError",
    "LabelledImage",
    "Lashes",
    "Led",
    "LedRing",
    "Lens",
    "Lid",
    "Look",
    "Motion",
    "Observations",
    "Observer",
    "Opening",
    "Panel",
    "Picture",
    "PinholeCamera",
    "Population",
    "PupilMargin",
    "RadianceMap",
    "Region",
    "Rig",
    "RigGeometry",
    "Scene",
    "SceneSpec",
    "Screen",
    "Sensor",
    "Skin",
    "Status",
    "Subject",
    "Sun",
    "SyntEye",
    "SyntEyes",
    "Targets",
    "TearFilm",
    "TopographySpec",
    "__version__",
    "auto_exposed",
    "bench_extractors",
    "compare",
    "compare_folder",
    "detect",
    "estimate",
    "export",
    "export_scene",
    "extract",
    "gaze",
    "generate",
    "kappa_deg",
    "load_eye",
    "load_scene",
    "preview",
    "read_topography",
    "render",
    "render_folder",
    "render_windows",
    "run_quickstart",
    "sample",
    "shipped_scenes",
    "trace",
    "validate",
    "with_kappa",
    "write_report",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("eyerender")
    if name == "gaze":
        return import_module(".gaze", __name__)
    if name in _HOMES:
        return getattr(import_module(f".{_HOMES[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
