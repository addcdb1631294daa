"""Configuration of the documentation site; `scripts/docs` builds it."""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx import addnodes
from sphinx.application import Sphinx

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(ROOT))

import eyerender  # noqa: E402
from docs.tools import keys, origins, references, validation  # noqa: E402

project = "eyerender"
author = copyright = "eyerender contributors"
release = eyerender.__version__

# References are made from the code in each build; git does not hold them.
for tool in (keys, references, validation):
    tool.write(HERE / "generated")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "attrs_inline"]
myst_heading_anchors = 4
exclude_patterns = [
    "tools",
    "data",
    "generated/validation_tables.md",
    "generated/api_names.md",
    *(f"gallery/*.{kind}" for kind in ("ipynb", "py", "md5", "json", "zip")),
]
suppress_warnings = ["config.cache"]  # the options of the gallery hold no functions, but Sphinx does not look

autodoc_mock_imports = ["torch"]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_default_options = {"exclude-members": "model_config, model_post_init, POSITIONAL"}
autosummary_generate = False
napoleon_use_rtype = False
napoleon_attr_annotations = (
    False  # the docstrings state shapes, and NumPy's types with a final underscore are no references
)
default_role = "code"
smartquotes_action = "qe"  # options such as --json keep their two hyphens

html_theme = "furo"
html_title = "eyerender"
html_static_path = ["static"]
html_logo = html_favicon = "static/logo.svg"
html_css_files = ["site.css"]
html_js_files = ["unfold.js"]
html_theme_options = {"navigation_with_keys": True}
copybutton_prompt_text = "$ "


# Equations become MathML, which browsers draw themselves: the site loads nothing from elsewhere.
html_math_renderer = "mathml"


def inline_math(translator: Any, node: Any) -> None:
    """Write an equation inside a line."""
    translator.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def display_math(translator: Any, node: Any) -> None:
    """Write an equation with lines of its own."""
    translator.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def mark_origins(app: Sphinx, page: str, source: list[str]) -> None:
    """Say below a heading where its figures come from."""
    app.env.note_dependency(str(origins.DATA))
    source[0] = origins.mark(page, source[0])


def link_pages(app: Sphinx, kind: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    """Make links of the pages that a docstring names as files."""
    lines[:] = [re.sub(r"docs/(\w+)\.md", r":doc:`/\1`", line) for line in lines]


def fold_api(app: Sphinx, doctree: nodes.document, page: str) -> None:
    """Show the signature and the first paragraph of each public name, and fold the rest."""
    if not page.startswith("generated/api_"):
        return
    for name in doctree.findall(addnodes.desc):
        content = name.next_node(addnodes.desc_content)
        if isinstance(name.parent, addnodes.desc_content) or content is None or len(content) < 2:
            continue
        fold(content, 1)


LONG_PAGES = ("architecture", "formats", "rig_design", "studies_people_results")


def fold_sections(app: Sphinx, doctree: nodes.document, page: str) -> None:
    """Show heading and first paragraph of each section of a long page, and fold the rest."""
    if page not in LONG_PAGES:
        return
    for section in list(doctree.findall(nodes.section)):
        starts_with_sections = isinstance(section[1], nodes.section)
        inside = section.parent.parent if isinstance(section.parent, nodes.section) else None
        if inside is None or starts_with_sections:
            continue
        if isinstance(inside, nodes.section) and not isinstance(section.parent[1], nodes.section):
            continue
        texts = [k for k, child in enumerate(section[:4]) if isinstance(child, nodes.paragraph)]
        if len(section) > 1 + (start := 1 + max(texts[:1], default=0)):
            fold(section, start)


def fold(node: nodes.Element, start: int) -> None:
    """Fold what a node holds from a position on."""
    node.insert(start, nodes.raw("", "<details><summary>Details</summary>", format="html"))
    node.append(nodes.raw("", "</details>", format="html"))


def setup(app: Sphinx) -> None:
    """Register the writer of equations, the lines on the origin of figures, and the folds."""
    app.add_html_math_renderer("mathml", (inline_math, None), (display_math, None))
    app.connect("source-read", mark_origins)
    app.connect("autodoc-process-docstring", link_pages)
    app.connect("doctree-resolved", fold_api)
    app.connect("doctree-resolved", fold_sections)


# Links to GitHub and to journals change without our doing; `scripts/docs --check-links` lists those that do not answer.
linkcheck_timeout = 20
linkcheck_retries = 2
linkcheck_anchors = False

# The gallery: each example becomes a page and a notebook. EYERENDER_DOCS_EXAMPLES=0 leaves their pictures
# out, but for thumbnails that `scripts/tools/make_thumbnails.py` made.
EXAMPLES = ROOT / "examples"
if any(EXAMPLES.glob("[0-9]*_*.py")):
    extensions.append("sphinx_gallery.gen_gallery")
    run_examples = os.environ.get("EYERENDER_DOCS_EXAMPLES", "1") != "0"
    thumbnails = HERE / "gallery" / "images" / "thumb"
    thumbnails.mkdir(parents=True, exist_ok=True)
    for stored in (HERE / "data" / "thumbnails").glob("*.png"):  # replaced where the examples run
        shutil.copyfile(stored, thumbnails / f"sphx_glr_{stored.stem}_thumb.png")
    sphinx_gallery_conf = {
        "examples_dirs": str(EXAMPLES),
        "gallery_dirs": "gallery",
        "filename_pattern": r"/\d+_\w+\.py$",
        "plot_gallery": run_examples,
        "within_subsection_order": "FileNameSortKey",
        "remove_config_comments": True,
        "download_all_examples": False,
        "min_reported_time": 1,
        "write_computation_times": False,
        "abort_on_example_error": False,
    }
else:
    (HERE / "gallery").mkdir(exist_ok=True)
    (HERE / "gallery" / "index.rst").write_text("Examples\n========\n\nThere are none in this checkout.\n")
