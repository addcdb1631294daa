"""Near-infrared eye images through refractive corneas, with exact labels.

The public names below are the whole interface. They load their modules on first use, so `import eyerender` loads
neither Mitsuba nor OpenCV.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from . import gaze
    from .analytic.observer import AnalyticObserver
    from .benchmark.protocol import Extractor
    from .benchmark.run import bench_extractors
    from .capture import render_windows
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
    from .eye.model import EyeModel
    from .eye.spec import EyeSpec
    from .imagefolder import ImageFolder
    from .imageobserver import ImageObserver
    from .observation import Observations
    from .quickstart import compare_folder, run_quickstart
    from .renderedfolder import export_scene, render_folder
    from .report.comparison import write_report
    from .rig.rig import RigGeometry
    from .scene import Scene, load_scene, shipped_scenes
    from .scenespec import SceneSpec
    from .status import Status

_HOMES = {
    "AnalyticObserver": "analytic.observer",
    "BackendError": "errors",
    "Comparison": "comparison",
    "DatasetSpec": "dataset.spec",
    "ExtractionSettings": "extraction",
    "Extractor": "benchmark.protocol",
    "EyeModel": "eye.model",
    "EyeSpec": "eye.spec",
    "EyerenderError": "errors",
    "ImageFolder": "imagefolder",
    "ImageObserver": "imageobserver",
    "InputError": "errors",
    "Observations": "observation",
    "RigGeometry": "rig.rig",
    "Scene": "scene",
    "SceneSpec": "scenespec",
    "Status": "status",
    "bench_extractors": "benchmark.run",
    "compare": "comparison",
    "compare_folder": "quickstart",
    "estimate": "dataset.estimate",
    "export": "dataset.export",
    "export_scene": "renderedfolder",
    "extract": "extraction",
    "generate": "dataset.run",
    "load_eye": "eye.catalogue",
    "load_scene": "scene",
    "preview": "dataset.sheet",
    "render_folder": "renderedfolder",
    "render_windows": "capture",
    "run_quickstart": "quickstart",
    "sample": "dataset.realise",
    "shipped_scenes": "scene",
    "validate": "dataset.validate",
    "write_report": "report.comparison",
}

__all__ = [
    "AnalyticObserver",
    "BackendError",
    "Comparison",
    "DatasetSpec",
    "ExtractionSettings",
    "Extractor",
    "EyeModel",
    "EyeSpec",
    "EyerenderError",
    "ImageFolder",
    "ImageObserver",
    "InputError",
    "Observations",
    "RigGeometry",
    "Scene",
    "SceneSpec",
    "Status",
    "__version__",
    "bench_extractors",
    "compare",
    "compare_folder",
    "estimate",
    "export",
    "export_scene",
    "extract",
    "gaze",
    "generate",
    "load_eye",
    "load_scene",
    "preview",
    "render_folder",
    "render_windows",
    "run_quickstart",
    "sample",
    "shipped_scenes",
    "validate",
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
