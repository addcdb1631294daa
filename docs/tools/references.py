"""The pages of the commands and of the public names, made from the application's help and the package's `__all__`."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import eyerender as er
from docs.tools.keys import toctree
from eyerender.cli import main as _commands  # noqa: F401  (registers the commands)
from eyerender.cli.app import app
from eyerender.cli.examples import EXAMPLES

# A page of the API: its title, and the beginnings of the modules (below the package) whose names it holds.
GROUPS = {
    "api_scenes": (
        "Scenes, frames and subjects",
        ("scene", "imaging.capture", "imaging.images", "imaging.folder", "imaging.autoexposure"),
    ),
    "api_eyes": ("Eyes and the eye region", ("eye", "region")),
    "api_rigs": ("Rigs: cameras, lights, screens, sensors", ("rig",)),
    "api_design": ("Rig design: information, noise, fits of eyes", ("design",)),
    "api_observers": ("Observers, observations and comparison", ("",)),
    "api_datasets": ("Datasets and folders of images", ("dataset", "folders")),
}

# The namespaces whose names stand on each page, below the package's own.
NAMESPACES = {
    "api_eyes": ["eye", "region", "population"],
    "api_rigs": ["rig"],
    "api_design": ["design"],
    "api_observers": ["apps"],
    "api_datasets": ["dataset"],
}

# PyTorch need not be installed where the site is built.
TORCH = """# Datasets for PyTorch

[Training networks](../training.md) shows their use. `eyerender.torch` needs the extra `torch`.

```{eval-rst}
.. currentmodule:: eyerender.torch
.. autoclass:: FolderDataset
   :members:
.. autoclass:: StreamDataset
   :members:
.. autofunction:: collate
```
"""


# A page of commands: its title, and its commands.
COMMANDS = {
    "commands_scenes": (
        "Scenes and pictures",
        ("features", "render", "preview", "view", "eyes", "live", "schema", "export-scene", "quickstart"),
    ),
    "commands_datasets": ("Making datasets", ("generate", "sample", "status", "merge")),
    "commands_inspect": ("Looking into datasets, and exports", ("validate", "inspect", "realism", "export-dataset")),
    "commands_features": ("Features from pictures", ("extract", "compare", "bench-extractors")),
    "commands_gaze": ("Gaze", ("gaze", "fit-eye", "budget")),
    "commands_design": ("Rigs, people and studies", ("rig", "sweep", "population", "study")),
    "commands_setup": ("Set-up", ("doctor", "setup-llvm")),
}


def commands() -> dict[str, str]:
    """The pages of the commands: the help of each as the application prints it, and a page that lists them."""
    text = app.generate_docs(output_format="markdown")
    # Cyclopts names the program as it was started, which is here "python -m sphinx" or the like.
    text = re.sub(r"^(eyerender[\w -]*?) -m \w+", r"\1", text, flags=re.MULTILINE)
    text = re.sub(r"docs/(\w+)\.md", r"[\1](../\1.md)", text)
    # A code block in a language that Pygments does not know would be a warning.
    listed, *sections = re.split(r"^(?=## eyerender )", text.replace("```console", "```sh"), flags=re.MULTILINE)
    summaries = dict(re.findall(r"^\* \[`([\w-]+)`\]\(.*?\): (.*)$", listed, re.MULTILINE))
    helps = {section.split()[2]: section for section in sections}
    made = {}
    start = "# Commands\n\n`eyerender COMMAND --help` prints the same on a terminal. [Which command for which task]"
    start += "(../which_command.md) helps to choose.\n"
    for page, (title, names) in COMMANDS.items():
        start += f"\n## {title}\n\n| command | what it does |\n|---|---|\n"
        made[page] = f"# {title}: commands\n\nThe other [commands](commands.md).\n\n"
        for name in names:
            start += f"| [`{name}`]({page}.md#eyerender-{name}) | {summaries.pop(name)} |\n"
            examples = [line for key, lines in EXAMPLES.items() if key.split()[0] == name for line in lines]
            made[page] += helps[name] + "\n**Examples**:\n\n```sh\n" + "\n".join(examples) + "\n```\n\n"
    if summaries:
        raise ValueError(f"no page of commands holds {', '.join(summaries)}")
    return {"commands": start + toctree(made), **made}


def homes() -> dict[str, str]:
    """The page of each public name."""
    found = {}
    for name in er.__all__:
        if name == "__version__" or isinstance(getattr(er, name), ModuleType):
            continue
        home = getattr(er, name).__module__.removeprefix("eyerender.") + "."
        pages = [page for page, (_, starts) in GROUPS.items() if any(home.startswith(f"{s}.") for s in starts)]
        found[name] = pages[0] if pages else "api_observers"
    return found


def pages() -> dict[str, str]:
    """The pages of the commands and of the API by their names."""
    made = {**commands(), "api_names": ""}
    where = homes()
    for page, (title, _) in GROUPS.items():
        names = [name for name, its in where.items() if its == page]
        text = f"# {title}\n\n" + api_section("eyerender", names)
        made["api_names"] += f"## {title}\n\n" + summary("eyerender", names)
        for space in NAMESPACES.get(page, []):
            text += f"\n## In `er.{space}`\n\n" + api_section(f"eyerender.{space}", getattr(er, space).__all__)
        made[page] = text
    made["api_names"] += "## Gaze estimators, in `er.gaze`\n\n" + summary("eyerender.gaze", er.gaze.__all__)
    made["api_gaze"] = "# Gaze estimators\n\n" + api_section("eyerender.gaze", er.gaze.__all__)
    made["api_torch"] = TORCH
    return made


def summary(module: str, names: list[str]) -> str:
    """A table of names of one module, with a line for each."""
    table = "\n".join(f"   {name}" for name in names)
    return f"```{{eval-rst}}\n.. currentmodule:: {module}\n\n.. autosummary::\n   :nosignatures:\n\n{table}\n```\n\n"


def api_section(module: str, names: list[str]) -> str:
    """Names of one module: a table of all, then the docstring of each."""
    lines = [summary(module, names) + "```{eval-rst}", f".. currentmodule:: {module}", ""]
    for name in names:
        found = getattr(sys.modules[module], name)
        kind = "class" if isinstance(found, type) else "function" if callable(found) else "data"
        if isinstance(found, type) and issubclass(found, Exception):
            kind = "exception"
        lines += [f".. auto{kind}:: {name}", *(["   :members:"] if kind == "class" else []), ""]
    return "\n".join([*lines, "```", ""])


def write(folder: Path) -> None:
    """Write the pages."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in pages().items():
        (folder / f"{name}.md").write_text(text, encoding="utf-8")


def names_on(text: str) -> set[str]:
    """The public names that a page of the API documents."""
    return set(re.findall(r"^\.\. auto(?:class|function|exception|data):: (\w+)", text, re.MULTILINE))
