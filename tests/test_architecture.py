"""The layout's rules: imports point down, few rooms for mitsuba and cv2, `import eyerender` is light."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest

import eyerender

PACKAGE = Path(eyerender.__file__).resolve().parent

# Lower floors know nothing of higher ones; packages on one floor do not import each other.
FLOORS = {
    "base": 0,
    "backends": 1,
    "optics": 1,
    "eye": 2,
    "region": 2,
    "rig": 2,  # devices of owners; frame rates, shutters and pulses, for those who synchronise cameras
    "population": 3,
    "scene": 3,  # eyes, lids, pupils and rigs that move, for all who use sequences of frames
    "folders": 4,
    "analytic": 5,  # eyes behind lenses; features at the time of their own rows, for owners of rolling shutters
    "rendering": 5,
    "extraction": 5,
    "design": 6,
    "gaze": 7,
    "imaging": 8,  # eyes of cameras; moments of exposures, traces and EyeLink's text, for laboratories
    "report": 9,
    "dataset": 9,
    "torch": 10,
    "apps": 11,  # with studies of networks
    "cli": 12,
    "__init__": 13,
    "__main__": 13,
}
# The order of the packages that share a floor and use each other: each may import those before it.
ORDER = ["population", "scene"]
# The modules of `base`: each may import those before it.
BASE = [
    "errors",
    "arrays",
    "progress",
    "processes",
    "status",
    "storage",
    "arguments",
    "apart",
    "jit",
    "references",
    "spec",
    "versions",
]
# The sub-packages of the renderer: each may import those before it, and `renderer` all of them.
RENDERING = ["records", "scene", "materials", "hits", "transport", "glints", "integrator", "output", "renderer"]


@cache
def modules() -> list[Path]:
    return sorted(p for p in PACKAGE.rglob("*.py") if "data" not in p.relative_to(PACKAGE).parts)


def room(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[0]


class Facts(NamedTuple):
    """What the tests ask of a module."""

    imports: list[tuple[str, int]]  # (level-resolved dotted module, line), inside functions and TYPE_CHECKING too
    names: list[str]  # the same without lines, with the name that is imported, which may be a module, at its end
    sizes: list[tuple[str, int, int]]  # (name, lines of the body without docstring, parameters) of every function
    positional_records: list[str]  # dataclasses with more than four fields whose fields may be given in order
    aliases: list[tuple[str, str]]  # (name, definition) of the type aliases at the top
    classes: list[tuple[str, list[str]]]  # (name, names of its bases) of every class at the top


@cache
def facts(path: Path) -> Facts:
    """Parse a module, once for all tests."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = list(statements(tree))
    module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
    return Facts(
        imports=[found for node in nodes for found in imports_of(path, node)],
        names=[name for node in nodes for name in names_of(path, node)],
        sizes=[size for node in nodes for size in size_of(module, node)],
        positional_records=[node.name for node in nodes if isinstance(node, ast.ClassDef) and is_positional(node)],
        aliases=[alias for node in tree.body for alias in alias_of(node)],
        classes=[(c.name, [ast.unparse(b) for b in c.bases]) for c in tree.body if isinstance(c, ast.ClassDef)],
    )


def statements(node: ast.AST):
    """All statements below a node. Only they import and define, and there are far fewer of them than of nodes."""
    for block in ("body", "orelse", "finalbody", "handlers", "cases"):
        for inner in getattr(node, block, ()):
            yield inner
            yield from statements(inner)


def names_of(path: Path, node: ast.AST):
    if isinstance(node, ast.ImportFrom):
        for alias in node.names:
            yield f"{resolved(path, node)}.{alias.name}"
    elif isinstance(node, ast.Import):
        for alias in node.names:
            yield alias.name


def resolved(path: Path, node: ast.ImportFrom) -> str:
    """Dotted module that an import is from."""
    package = path.relative_to(PACKAGE.parent).with_suffix("").parts[:-1]
    base = package[: len(package) - node.level + 1] if node.level else ()
    return ".".join((*base, *((node.module or "").split(".") if node.module else ())))


def imports_of(path: Path, node: ast.AST):
    if isinstance(node, ast.ImportFrom) and node.module is not None and resolved(path, node) != "eyerender":
        yield resolved(path, node), node.lineno
    elif isinstance(node, (ast.Import, ast.ImportFrom)):
        for name in names_of(path, node):
            yield name, node.lineno


def size_of(module: str, node: ast.AST):
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
        body = node.body[1:] if ast.get_docstring(node, clean=False) is not None else node.body
        lines = body[-1].end_lineno - body[0].lineno + 1 if body else 0
        names = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
        yield f"{module}.{node.name}", lines, len(names) - (names[:1] in (["self"], ["cls"]))


def is_positional(node: ast.ClassDef) -> bool:
    made = [ast.unparse(d) for d in node.decorator_list if ast.unparse(d).startswith("dataclass")]
    fields = [n for n in node.body if isinstance(n, ast.AnnAssign) and "ClassVar" not in ast.unparse(n.annotation)]
    return bool(made) and len(fields) > 4 and "kw_only=True" not in made[0]


def alias_of(node: ast.AST):
    kinds = {"NDArray", "Callable", "Literal", "Annotated", "tuple", "list", "dict"}
    if isinstance(node, ast.Assign) and isinstance(node.value, (ast.Subscript, ast.BinOp)):
        definition = ast.unparse(node.value).replace("npt.", "")
        of_a_type = isinstance(node.value, ast.Subscript) and definition.split("[")[0] in kinds
        if of_a_type or " | " in definition:
            yield ast.unparse(node.targets[0]), definition


def test_imports_point_down():
    for path in modules():
        here = room(path)
        assert here in FLOORS, f"{here} has no floor"
        for name, line in facts(path).imports:
            parts = name.split(".")
            if parts[0] != "eyerender" or len(parts) < 2 or parts[1] in (here, "__version__") or here == "__init__":
                continue
            place, there = f"{path}:{line}: {here} imports {name}", parts[1]
            assert there in FLOORS, f"{place}, which has no floor"
            if FLOORS[there] == FLOORS[here]:
                assert {here, there} <= set(ORDER), f"{place}, its neighbour"
                assert ORDER.index(there) < ORDER.index(here), place
            else:
                assert FLOORS[there] < FLOORS[here], f"{place}, which is above it"


@pytest.mark.parametrize(("package", "order"), [("base", BASE), ("rendering", RENDERING)])
def test_parts_of_a_package_have_one_direction(package, order):
    for path in modules():
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if parts[0] != package or parts[1] == "__init__":
            continue
        for name, line in facts(path).imports:
            there = name.split(".")
            if there[:2] == ["eyerender", package] and there[2] != parts[1]:
                assert order.index(there[2]) < order.index(parts[1]), f"{path}:{line}: {name}"


def test_the_root_shows_the_architecture():
    entries = {p.name for p in PACKAGE.iterdir() if p.suffix == ".py" or (p.is_dir() and (p / "__init__.py").is_file())}
    assert len(entries - {"__init__.py", "__main__.py"}) <= 20


def test_nothing_imports_a_product_and_products_are_apart():
    """Only the command line, the public stub and entry points import `apps/`; its rooms do not import each other."""
    for path in modules():
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        for name, line in facts(path).imports:
            there = name.split(".")
            if there[:2] != ["eyerender", "apps"]:
                continue
            place = f"{path}:{line}: {name}"
            assert parts[0] in ("apps", "cli"), place
            assert parts[0] == "cli" or there[2] == parts[1], f"{place}, another product"


def circles(graph: dict[str, set[str]]) -> list[tuple[str, ...]]:
    """Modules that import each other by way of others: those left when all that import nothing left are taken away."""
    left = {name: set(used) for name, used in graph.items()}
    while ends := [name for name, used in left.items() if not used & set(left)]:
        for name in ends:
            del left[name]
    reach = {name: {name} for name in left}
    for _ in left:
        reach = {name: seen.union(*(left[n] & set(left) for n in seen)) for name, seen in reach.items()}
    return sorted(
        {tuple(sorted(n for n in left if n in reach[m] and m in reach[n])) for m in left} - {(m,) for m in left}
    )


def test_no_circle_of_imports_inside_packages():
    """Imports for types alone and those inside functions count. Commands register themselves at their application."""
    names = {
        ".".join(p.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): p for p in modules()
    }
    graph = {}
    for name, path in names.items():
        used = {found if found in names else found.rpartition(".")[0] for found in facts(path).names}
        graph[name] = {u for u in used if u in names and u != name}
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == [("b", "c")]
    assert [c for c in circles(graph) if not all(m.startswith("eyerender.cli") for m in c)] == []


def lines_of(package: str = "") -> int:
    kinds = (".py", ".pyi", ".js", ".j2")
    return sum(
        len(p.read_text(encoding="utf-8").splitlines()) for p in (PACKAGE / package).rglob("*") if p.suffix in kinds
    )


# Most lines (code, stubs, scripts of pages, templates) of each package and of the whole, "". A bound rises only in the
# commit that brings a capability, with a sentence here that says for whom.
BOUNDS = {
    "": 98740,  # eyes in time: motion, cameras, clips, traces; glasses; people, for makers and trainers
    "analytic": 1150,  # eyes behind spectacles, and the lenses' own reflections, for trackers of people who wear them
    "apps": 19040,  # users' own studies, a rule for each sentence of a paper; two rigs compared, for their makers
    "backends": 940,  # a hook that chooses libLLVM before any import of drjit, for users of mitsuba
    "base": 2620,  # one door for child processes and stored files; arguments checked; bodies of triangles, for all
    "cli": 2640,  # tables of features, targets and gaze; units, intervals, jitter of films, for readers of reports
    "dataset": 11700,  # the codes that cameras stored, labels with validity, mirroring and augmentation, for trainers
    "design": 3930,  # tolerances of units, lids that shade LEDs, blur and motion, LEDs stuck on, for makers of rigs
    "extraction": 6080,
    "eye": 4560,  # spectacle lenses, their frames, legs of rays, for the same; eyes from biometry, for laboratories
    "folders": 1810,  # compressed depth, normals, lens reflections, for those who train; what damaged videos lack
    "gaze": 5290,  # tables of other trackers; intervals of budgets; precision, for laboratories
    "imaging": 3560,  # one line of metadata for all folders; eyes of cameras; lenses, and the glints they hide
    "optics": 5210,
    "population": 2480,  # children who become more myopic as they grow, for trackers of children
    "region": 4280,  # heads from STL and GLB files, with all mistakes named at once; frames of spectacles before eyes
    "rendering": 12620,  # pictures through spectacles and of their frames, reflections and masks of them, for the same
    "report": 970,
    "rig": 4620,  # fisheyes, measured fall-off, flipped pictures, files of devices, for owners of headsets
    "scene": 4370,  # people, times and lens reflections in records; cameras past lenses; refusals where written
    "torch": 820,  # a small network for gaze, which an example and a study share, for trainers
}


@pytest.mark.parametrize("package", BOUNDS)
def test_growth_pays(package):
    assert lines_of(package) <= BOUNDS[package]


def test_every_package_has_a_bound():
    assert {p.name for p in PACKAGE.iterdir() if (p / "__init__.py").is_file()} == BOUNDS.keys() - {""}


def test_names_of_classes_have_one_meaning():
    """A class name stands for one thing in the whole package; private ones, which no other module sees, may repeat."""
    names = [name for path in modules() for name, _ in facts(path).classes if not name.startswith("_")]
    assert {n for n in names if names.count(n) > 1} == set()


def test_authored_types_alone_end_in_spec():
    bases = {name: bases for path in modules() for name, bases in facts(path).classes}

    def is_authored(name: str) -> bool:
        return name == "Spec" or any(is_authored(base) for base in bases.get(name, []))

    assert [name for name in bases if name.endswith("Spec") and not is_authored(name)] == []


def test_every_function_has_types():
    found = [p.name for p in modules() if re.search(r"no-untyped-def", p.read_text(encoding="utf-8"))]
    assert found == []


# Why a function or a record may be larger than the limits of `test_functions_and_records_are_of_a_size_to_read`.
LARGE = {
    # Every option of a public call is a keyword, and the command line gives them by name.
    "dataset.run.generate": "options of a run",
    "dataset.export.__init__.export": "options of an export",
    "torch.__init__.__init__": "options of a loader",
    "analytic.features.features": "options of an observation",
    # Kernels take arrays, not records.
    "optics.fermat_kernels.connect_all": "a kernel",
    "optics.fermat_kernels.store": "a kernel",
    "optics.graph_kernels.crossings": "a kernel",
    "analytic.view_kernels.project_all": "a kernel",
    "report.eye_section._curve": "a curve and its style",
    "report.overlay.eye_picture": "a picture and its style",
    # Each is one list: of fields of a file, or of cases of a search.
    "population.synteyes.eye_file": "fields of an eye file",
}
# Records that are rebuilt from a tuple of their fields (batches of surfaces, results of compiled functions), or whose
# first fields users give in order.
POSITIONAL = {
    "Biconic", "BoundaryPixels", "CalibrationErrors", "DeviceSurface", "EyeImage", "EyePicture",
    "Finding", "FunctionErrors", "GradientMedium", "GridSurface", "GuestrinEizenman", "LashPlan", "Patch", "Quadric",
    "RegionLayout", "RigGeometry",
    "Regression", "Scene", "Score", "Stop", "Table", "ZernikeSurface", "_Table",
}  # fmt: skip


def test_functions_and_records_are_of_a_size_to_read():
    """Bodies of at most 60 lines, at most 8 parameters (but for commands), and large records by keyword."""
    found = [one for path in modules() for one in facts(path).sizes]
    long = {name for name, lines, _ in found if lines > 60}
    wide = {name for name, _, count in found if count > 8 and not name.startswith("cli.")}
    assert long | wide == LARGE.keys()
    assert {name for path in modules() for name in facts(path).positional_records} == POSITIONAL


@pytest.mark.parametrize(
    ("libraries", "homes"),
    [
        (("mitsuba", "drjit"), {"rendering", "backends"}),
        (("cv2",), {"extraction", "dataset", "folders"}),
        (("skimage",), {"dataset"}),
    ],
)
def test_heavy_libraries_stay_in_their_packages(libraries, homes):
    users = {room(p) for p in modules() for name, _ in facts(p).imports if name.split(".")[0] in libraries}
    assert users == homes


def test_datasets_use_opencv_for_nothing_but_videos():
    users = [p.name for p in modules() if room(p) == "dataset" and "cv2" in {name for name, _ in facts(p).imports}]
    assert users == ["video.py"]


@pytest.mark.parametrize("observer", ["analytic", "image"])
def test_observers_are_siblings(observer):
    """Neither observer uses the other; what composes both stands above them."""
    image = {"rendering", "extraction", "capture", "imageobserver", "videoobserver"}
    own, other = ({"analytic"}, image) if observer == "analytic" else (image, {"analytic"})
    used = {
        name.split(".")[1]
        for p in modules()
        if room(p) in own
        for name, _ in facts(p).imports
        if name.startswith("eyerender.")
    }
    assert not used & other


def test_what_reproduces_a_papers_software_stays_in_the_studies():
    switches = "placed_by|tilt_order|index_rate|visual_axis|sum_of_errors|minimum_norm|E5-published"
    core = [p for p in modules() if room(p) != "cli" and "study" not in p.parts]
    found = [p.name for p in core if re.search(rf"\b({switches})\b", p.read_text(encoding="utf-8"))]
    assert found == []
    own = {"E1", "E2", "E3", "E4", "E5", "adult", "artificial", "keratoconus"}
    assert {p.stem for p in (PACKAGE / "eye" / "catalogue").glob("*.yaml")} == own
    assert not list((PACKAGE / "report").rglob("*study*"))


def test_a_type_alias_is_defined_once():
    found = [alias for path in modules() for alias in facts(path).aliases]
    assert {"Floats", "Bools", "Progress", "Window"} <= {name for name, _ in found}
    names = [name for name, _ in found]
    assert sorted({n for n in names if names.count(n) > 1}) == []
    shared = [d for _, d in found if d.startswith(("NDArray", "Callable", "Literal"))]
    assert sorted({d for d in shared if shared.count(d) > 1}) == []


def test_import_is_light():
    heavy = ("mitsuba", "drjit", "cv2", "skimage", "matplotlib", "torch", "pyarrow", "numba")
    uses = {"None": heavy, "eyerender.gaze": (*heavy, "scipy", "pydantic"), "eyerender.gaze.Regression": heavy}
    # Every worker of a run pays for what the renderer imports.
    renderer = (
        "from eyerender.backends.choose import choose_backend; choose_backend(); import eyerender.rendering.renderer"
    )
    uses[renderer] = ("scipy.signal", "scipy.stats", "trimesh", "matplotlib")
    for use, banned in uses.items():
        code = f"import sys, eyerender; {use}; print([m for m in {banned} if m in sys.modules])"
        out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert out.stdout.strip() == "[]"


def test_features_need_no_extractor(tmp_path):
    """`eyerender features` runs compiled ray optics, which it loads, but must not wait for OpenCV and the extractor."""
    code = f"""import sys
from eyerender.cli.main import main
try:
    main(["features", "headset", "--json", {str(tmp_path / "out.json")!r}])
except SystemExit as end:
    assert not end.code
assert not [m for m in ("eyerender.extraction.pupil", "cv2", "mitsuba") if m in sys.modules]
"""
    subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (tmp_path / "out.json").stat().st_size > 0


def public_modules() -> dict[str, ModuleType]:
    spaces = [name for name in eyerender.__all__ if isinstance(getattr(eyerender, name), ModuleType)]
    return {"eyerender": eyerender} | {name: getattr(eyerender, name) for name in spaces}


def test_public_names_stand_in_one_place_and_few_at_the_root():
    names = [name for package in public_modules().values() for name in package.__all__]
    assert sorted({n for n in names if names.count(n) > 1}) == []
    assert len(eyerender.__all__) <= 70


@pytest.mark.parametrize("name", public_modules())
def test_every_public_name_of_the_stub_loads(name):
    package = public_modules()[name]
    stub = Path(package.__file__).with_suffix(".pyi")
    imports = [node for node in ast.parse(stub.read_text()).body if isinstance(node, ast.ImportFrom)]
    names = [alias.name for node in imports for alias in node.names]
    assert package.__all__ == dir(package) == sorted(set(names))
    assert len(names) == len(set(names)) > 1
    for name in names:
        assert getattr(package, name) is not None


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = eyerender.no_such_name  # type: ignore[attr-defined]
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = eyerender.gaze.no_such_name  # type: ignore[attr-defined]
