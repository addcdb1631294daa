"""The strict, frozen base of all authored records: load, dump, digest, JSON Schema.

A file carries the version of its format (`format: 1`). Unknown keys, wrong types and non-finite numbers are refused
with the dotted path of the key (`lights.1.radius_mm: must be > 0`). YAML is loaded by the safe loader; nothing in a
spec is executed.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, Union, get_args

import numpy as np
import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    GetCoreSchemaHandler,
    Tag,
    ValidationError,
    field_validator,
)

from .errors import InputError, Problems
from .storage.files import MAX_FILE_BYTES, opened, read_text, shown

# Limits of a YAML file. Nodes are counted after expansion: an alias counts as much as the value that it repeats. A
# scene with a list of 20,000 targets has 80,000 nodes; reading 100,000 takes some five seconds.
MAX_YAML_BYTES, MAX_YAML_NODES, MAX_YAML_DEPTH = 2 * 2**20, 100_000, 64
# Python's time grows with the square of an integer's digits.
_LONGEST_NUMBER = 300

# Lengths are in mm, and a light at 1,000 km is infinitely far away for all purposes here. Fourth powers of numbers
# within these limits still fit into single precision, in which the renderer computes.
LARGEST, SMALLEST = 1e9, 1e-9


def _not_tiny(value: float) -> float:
    if value < SMALLEST:
        raise ValueError(f"must be >= {SMALLEST:g}")
    return value


Side = Literal["right", "left"]
EYES: tuple[Side, Side] = ("right", "left")
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Vec2 = tuple[Number, Number]
Vec3 = tuple[Number, Number, Number]
Positive = Annotated[float, Field(gt=0, le=LARGEST), AfterValidator(_not_tiny)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]


@dataclass(frozen=True, slots=True)
class ByKind:
    """Choose the member of a union of specs by their key `kind`: `Annotated[SphereSpec | ConicSpec, ByKind()]`."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        members = {str(get_args(member.model_fields["kind"].annotation)[0]): member for member in get_args(source)}
        *names, last = members
        kinds = Discriminator(
            _kind_tag,
            custom_error_type="unknown_kind",
            custom_error_message=f"kind must be {', '.join(names)} or {last}",
        )
        tagged = tuple(Annotated[member, Tag(f"[{kind}]")] for kind, member in members.items())
        return handler.generate_schema(Annotated[Union[tagged], kinds])  # noqa: UP007


def _kind_tag(value: object) -> str:
    """Return the tag by which pydantic selects a member of a union of specs, from its key `kind`."""
    return f"[{value.get('kind') if isinstance(value, Mapping) else getattr(value, 'kind', None)}]"


class KeyProblem(ValueError):
    """Error that a validator raises for one key of its record."""

    def __init__(self, path: str, reason: str) -> None:
        super().__init__(reason)
        self.path = path


class Spec(BaseModel):
    """Base of every authored record: frozen and strict; unknown keys and non-finite numbers are refused."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False, validate_default=True)

    POSITIONAL: ClassVar[tuple[str, ...]] = ()
    """Fields that the constructor also takes by position, in this order."""

    def __init__(self, *values: Any, **fields: Any) -> None:
        """Build a record from Python values; lists and NumPy arrays are accepted for tuples, mappings for records.

        `values`: fields by position, in the order of `POSITIONAL`; `fields`: fields by name. Raises InputError if a
        value does not fit; the message is the same as for a YAML file with this value.
        """
        named = dict(zip(self.POSITIONAL, values, strict=False))
        if len(named) < len(values) or named.keys() & fields.keys():
            raise TypeError(f"{type(self).__name__} takes {', '.join(self.POSITIONAL) or 'no values'} without a name")
        self._validated({**named, **fields}, into=self)

    # Pydantic then builds nested records without calling this constructor for each of them.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    def __setattr__(self, name: str, value: Any) -> None:
        try:
            super().__setattr__(name, value)
        except ValidationError:
            kind = type(self).__name__
            raise AttributeError(
                f"{kind}: cannot be changed; make a new {kind}, or a changed scene with scene.with_(...)"
            ) from None

    @classmethod
    def from_mapping(cls, data: object, *, source: str = "") -> Self:
        """Validate a plain mapping; InputError naming `source` and the path of the first wrong key."""
        if not isinstance(data, Mapping):
            raise InputError("must be a mapping of keys to values", source=source)
        return cls._validated(data, source=source)

    @classmethod
    def _validated(cls, data: Mapping[str, Any], *, into: Self | None = None, source: str = "") -> Self:
        try:
            # The data are passed as JSON, because only there does pydantic's strict mode accept a list for a tuple.
            text = json.dumps(cls.arranged(data), default=_plain)
            made: Self = cls.__pydantic_validator__.validate_json(text, self_instance=into)
            return made
        except InputError as error:
            raise error.placed(source=source) from None
        except RecursionError:
            raise InputError("is nested too deeply", source=source) from None
        except ValidationError as error:
            problems = Problems(source)
            for path, reason in _problems(error):
                problems.add(reason, path)
            raise problems.error() from None
        except (TypeError, ValueError) as error:
            raise InputError(f"holds a value that is not a number, text or list ({error})", source=source) from None

    @classmethod
    def arranged(cls, data: Mapping[str, Any]) -> Mapping[str, Any]:
        """Rearrange a mapping to the layout of a file before validation.

        Subclasses that accept other layouts from Python code override it.
        """
        return data

    def to_mapping(self) -> dict[str, Any]:
        """Convert to the plain mapping that `from_mapping` reads as an equal object."""
        return self.model_dump(mode="json", exclude_none=True)

    def replaced(self, option: str, changes: Mapping[str, Any]) -> Self:
        """Replace top-level values by command-line options; a None removes a key.

        Raises:
            InputError: a value does not fit; the message names the option, because the file itself is valid.
        """
        data = {key: value for key, value in {**self.to_mapping(), **changes}.items() if value is not None}
        try:
            return self.from_mapping(data)
        except InputError as error:
            raise InputError(error.reason, source=option) from None

    def digest(self) -> str:
        """Compute the SHA-256 of the canonical JSON: equal specs have equal digests on every machine."""
        text = json.dumps(self.to_mapping(), sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()

    @classmethod
    def json_schema(cls) -> dict[str, Any]:
        """Return the JSON Schema (2020-12) for editors."""
        schema = cls.model_json_schema()
        for record in (schema, *schema.get("$defs", {}).values()):
            if "description" in record:  # pydantic's is the whole docstring
                record["description"] = record["description"].partition(">>>")[0].strip()
        return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


class FileSpec(Spec):
    """Base of specs that are a YAML file of their own and state the version of their format."""

    FORMAT: ClassVar[int] = 1
    """The version that is read and written."""

    format: int = Field(default=FORMAT, description="version of this file format")

    @field_validator("format")
    @classmethod
    def _check_format(cls, found: int) -> int:
        if found != cls.FORMAT:
            raise ValueError(cls._other_format(found))
        return found

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a YAML file. Raises InputError, one line for anything that is wrong with it."""
        data = read_yaml(path)
        cls.refuse_other_kinds(data, source=str(path))
        if "format" not in data:
            raise InputError(f"missing; write 'format: {cls.FORMAT}'", source=str(path), path="format")
        cls.refuse_other_formats(data, source=str(path))
        try:
            data = cls.gathered(data, Path(path).parent)
        except InputError as error:
            raise error.placed(source=str(path)) from None
        return cls.from_mapping(data, source=str(path))

    @classmethod
    def refuse_other_formats(cls, data: Mapping[str, Any], *, source: str = "") -> None:
        """Raise an error for a mapping of another version, before its keys, which may differ, are checked.

        Raises:
            InputError: the version is not the one that is read.
        """
        found = data.get("format", cls.FORMAT)
        if found != cls.FORMAT or isinstance(found, bool):
            raise InputError(cls._other_format(found), source=source, path="format")

    @classmethod
    def _other_format(cls, found: object) -> str:
        return f"is {shown(found)}; this version reads format {cls.FORMAT}"

    @classmethod
    def gathered(cls, data: dict[str, Any], folder: Path) -> dict[str, Any]:
        """Merge the content of other files that belong to the spec into its mapping; paths are relative to `folder`."""
        return data

    @classmethod
    def from_mapping(cls, data: object, *, source: str = "") -> Self:
        """Validate a plain mapping.

        Raises:
            InputError: naming the wrong key; it also says so if the file is of another kind.
        """
        if isinstance(data, Mapping):
            cls.refuse_other_kinds(data, source=source)
            cls.refuse_other_formats(data, source=source)
        return super().from_mapping(data, source=source)

    @classmethod
    def refuse_other_kinds(cls, data: Mapping[str, Any], *, source: str = "") -> None:
        """Raise an error for a file of another kind, whose format has other version numbers.

        Raises:
            InputError: the mapping is of another kind.
        """

    def dump(self, path: str | Path) -> None:
        """Write YAML that `load` reads as an equal object."""
        Path(path).write_text(self.to_yaml(), encoding="utf-8")

    def to_yaml(self) -> str:
        """Write this spec as YAML."""
        return yaml.safe_dump(self.to_mapping(), sort_keys=False, allow_unicode=True, width=100)


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read a YAML file as a mapping, safely; InputError if it cannot be read."""
    return parse_yaml(read_text(path, limit=MAX_YAML_BYTES), str(path))


def parse_yaml(text: str, source: str, *, mapping_tags: tuple[str, ...] = ()) -> dict[str, Any]:
    """Parse the text of a YAML file as a mapping, safely; mappings may have the tags `!!TAG` of `mapping_tags`.

    Raises:
        InputError: it is not valid, or too large.
    """

    class Loader(_UniqueKeyLoader):
        pass

    for tag in mapping_tags:
        Loader.add_constructor(f"tag:yaml.org,2002:{tag}", _as_mapping)
    try:
        data = yaml.load(text, Loader=Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error).split("\n", 1)[0]
        raise InputError(f"not valid YAML: {problem}", source=source, path=where) from None
    except RecursionError:
        raise InputError("not valid YAML: nested too deeply", source=source) from None
    except ValueError as error:
        # The scanner converts the numbers of a %YAML directive with int(), which may raise ValueError.
        raise InputError(f"not valid YAML: {error}", source=source) from None
    if not isinstance(data, dict):
        raise InputError("must be a YAML mapping of keys to values", source=source)
    return data


def file_digest(path: Path, *, limit: int = MAX_FILE_BYTES) -> str:
    """Compute the SHA-256 of a regular file's bytes, at most `limit`; InputError if it cannot be read."""
    with opened(path, limit=limit) as file:
        try:
            return hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror or error})", source=str(path)) from None


class _UniqueKeyLoader(yaml.SafeLoader):
    """The safe loader, with errors for duplicate keys (instead of a silent override) and for too large content.

    An alias counts with the size of the node that it repeats, because later code processes the expanded tree (ten lines
    can expand to a thousand million nodes).
    """

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._nodes = 0
        self._depth = 0
        self._sizes: dict[str, int] = {}  # number of nodes of each complete anchored node

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        anchor: Any = event.anchor
        is_alias = isinstance(event, yaml.AliasEvent)
        if is_alias:
            # An incomplete node would contain itself; the safe loader itself reports a missing anchor.
            if anchor in self.anchors and anchor not in self._sizes:
                raise yaml.composer.ComposerError(None, None, f"{shown(anchor)} holds itself", event.start_mark)
            self._nodes += self._sizes.get(anchor, 0)
        self._nodes += 1
        self._depth += 1
        if self._nodes > MAX_YAML_NODES:
            raise yaml.composer.ComposerError(
                None, None, f"holds more than {MAX_YAML_NODES} values, aliases written out", event.start_mark
            )
        if self._depth > MAX_YAML_DEPTH:
            raise yaml.composer.ComposerError(None, None, "nested too deeply", event.start_mark)
        before = self._nodes
        node = super().compose_node(parent, index)
        self._depth -= 1
        if anchor is not None and not is_alias:
            self._sizes[anchor] = self._nodes - before
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        if isinstance(node, yaml.ScalarNode) and _SURROGATE.search(node.value):
            raise yaml.constructor.ConstructorError(None, None, "half of a surrogate pair", node.start_mark)
        if node.tag in _NUMBERS and isinstance(node, yaml.ScalarNode) and len(node.value) > _LONGEST_NUMBER:
            raise yaml.constructor.ConstructorError(
                None, None, f"a number of {len(node.value)} characters", node.start_mark
            )
        if node.tag in _NUMBERS and isinstance(node, yaml.ScalarNode) and _SURPRISING.match(node.value):
            raise yaml.constructor.ConstructorError(
                None,
                None,
                f"{shown(node.value)} is octal or base 60 in YAML; write a decimal number, or quotes around text",
                node.start_mark,
            )
        try:
            return super().construct_object(node, deep)
        except yaml.YAMLError:
            raise
        except Exception as error:
            # The safe loader's constructors raise whatever int(), date() and others raise for a scalar that does not
            # fit its tag or pattern.
            what = f"is no {node.tag.rpartition(':')[2]}"
            if isinstance(error, ValueError):
                what += f" ({error})"
            raise yaml.constructor.ConstructorError(None, None, what, node.start_mark) from None

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        if not isinstance(node, yaml.MappingNode):
            return super().construct_mapping(node, deep)  # which reports what it expects
        seen = set()
        for key_node, _ in node.value:
            key = (key_node.tag, str(key_node.value))
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {shown(key_node.value)} appears twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


def _as_mapping(loader: Any, node: Any) -> Any:
    return loader.construct_mapping(node, deep=True)


# YAML 1.1 reads 010 as 8 and 66:40 as 4000; nobody who writes them means that.
_SURPRISING = re.compile(r"^[-+]?(0[0-9_]+$|[0-9_]+:)")
_SURROGATE = re.compile("[\ud800-\udfff]")  # an escape may name one, but no file could hold it
_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
# YAML 1.1 reads 1e-3 as text, but everybody means the number.
_UniqueKeyLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(?:[0-9][0-9_]*)(?:\.[0-9_]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def _problems(error: ValidationError) -> list[tuple[str, str]]:
    """Return the path and reason of each problem, the most informative one first.

    Each branch of a union reports its own failure, so a problem above a deeper one, or at the same path, is often only
    its consequence. Such problems are left out.
    """
    problems = error.errors(include_url=False)
    places = [tuple(part for part in p["loc"] if not _is_branch(part)) for p in problems]
    deepest = max(problems, key=lambda p: (len(p["loc"]), p["type"] != "missing"))
    first = problems.index(deepest)
    taken: set[tuple[int | str, ...]] = set()
    kept = []
    above = {place[:k] for place in places for k in range(len(place))}
    for k in sorted(range(len(problems)), key=lambda k: k != first):
        if k == first or (places[k] not in taken and places[k] not in above):
            taken.add(places[k])
            kept.append(_described(problems[k], ".".join(map(str, places[k]))))
    return kept


def _described(problem: Mapping[str, Any], path: str) -> tuple[str, str]:
    """Return one problem as (dotted path, reason)."""
    context = problem.get("ctx", {})
    kind = problem["type"]
    if kind == "extra_forbidden":
        return path, "unknown key"
    if kind == "missing":
        return path, "missing"
    if kind in ("greater_than", "less_than", "greater_than_equal", "less_than_equal"):
        sign = {"greater_than": ">", "less_than": "<", "greater_than_equal": ">=", "less_than_equal": "<="}[kind]
        return path, f"must be {sign} {next(iter(context.values())):g}, not {shown(problem['input'])}"
    if kind in ("too_short", "too_long"):
        bound = context.get("min_length", context.get("max_length"))
        return path, f"needs at {'least' if kind == 'too_short' else 'most'} {bound} entries"
    if kind == "finite_number":
        return path, "must be a finite number"
    if kind == "value_error":
        cause = context.get("error", problem["msg"])
        inner = cause.path if isinstance(cause, KeyProblem) else ""
        return ".".join(filter(None, (path, inner))), str(cause)
    if kind in ("tuple_type", "list_type"):
        return path, f"must be a list, not {shown(problem['input'])}"
    message = problem["msg"]
    message = message.replace("Input should be", "must be")
    value = problem.get("input")
    if isinstance(value, str | int | float | bool):
        message += f", not {shown(value)}"
    return path, message


def _plain(value: Any) -> Any:
    """Convert a Python value to JSON types."""
    if isinstance(value, Spec):
        return value.to_mapping()
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not allowed")


def _is_branch(part: object) -> bool:
    """Return whether a part of pydantic's error location names a union's branch, not a key of the user's file."""
    return isinstance(part, str) and ("[" in part or part.endswith("Spec"))
