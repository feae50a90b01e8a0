"""What pydantic found wrong, in one line each that a person can act on."""

from __future__ import annotations

import copy
import difflib
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

KeyPath = tuple[str, ...]

EXPECTED = {
    "string_type": "expected a text in quotes",
    "int_type": "expected a whole number",
    "int_from_float": "expected a whole number",
    "float_type": "expected a number",
    "bool_type": "expected true or false",
    "tuple_type": "expected an array [...]",
    "dict_type": "expected a table",
    "model_type": "expected a table",
    "model_attributes_type": "expected a table",
    "finite_number": "expected a finite number",
}

_TAG_FAULTS = ("union_tag_not_found", "union_tag_invalid")


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing wrong: the key and the sentence about it, repair included."""

    path: KeyPath
    text: str


def faults_of(error: ValidationError, model: type[BaseModel], data: Mapping[str, Any]) -> list[Fault]:
    """The faults that pydantic found in `data` for `model`, in its order."""
    faults = []
    for detail in error.errors():
        path = _key_path(detail["loc"], data)
        if detail["type"] in _TAG_FAULTS:
            path = (*path, "driver")
        faults.append(Fault(path, _sentence(detail, path, model, data)))
    return faults


def without_faults(data: dict[str, Any], faults: Iterable[Fault]) -> dict[str, Any]:
    """A copy of the tables without the values that are at fault; a table that lacks a required key goes as a whole."""
    cleaned = copy.deepcopy(data)
    for fault in faults:
        path = tuple(step.partition("[")[0] for step in fault.path)  # of an array the whole goes
        while path:
            parent: Any = cleaned
            for key in path[:-1]:
                parent = parent.get(key) if isinstance(parent, dict) else None
            if isinstance(parent, dict) and path[-1] in parent:
                del parent[path[-1]]
                break
            path = path[:-1]
    return cleaned


def _key_path(location: tuple[int | str, ...], data: Mapping[str, Any]) -> KeyPath:
    """The keys as they stand in the file: without pydantic's union tags and `[key]`, array elements as `[2]`."""
    path: list[str] = []
    node: Any = data
    for position, step in enumerate(location):
        if isinstance(step, int):
            if isinstance(node, tuple | list) and step < len(node):
                path[-1:] = [f"{path[-1]}[{step}]"] if path else []
                node = node[step]
        elif isinstance(node, Mapping) and step in node:
            path.append(step)
            node = node[step]
        elif step != "[key]" and position == len(location) - 1 and isinstance(node, Mapping):
            path += [step] if step != node.get("driver") else []  # that is pydantic's tag of the kind, not a key
    return tuple(path)


def _sentence(detail: Any, path: KeyPath, model: type[BaseModel], data: Mapping[str, Any]) -> str:
    kind, context = detail["type"], detail.get("ctx", {})
    if kind == "extra_forbidden":
        return _unknown_key(path, model, data)
    if kind == "missing":
        return "is missing; add it"
    if kind == "value_error":
        return str(context["error"])
    if kind in _TAG_FAULTS:
        return (
            f"is {context['tag']!r}, must be one of {context['expected_tags']}"
            if "tag" in context
            else "is missing; add it"
        )
    if kind == "literal_error":
        return f"is {detail['input']!r}, must be {context['expected']}"
    if kind == "string_pattern_mismatch":
        return f"{detail['input']!r} is not a name; use lower case letters, digits, _ and -"
    sentence = EXPECTED.get(kind) or detail["msg"].replace("Input should", "should")
    return f"is {_short(detail['input'])}, {sentence}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _unknown_key(path: KeyPath, model: type[BaseModel], data: Mapping[str, Any]) -> str:
    known = sorted(fields_at(model, path[:-1], data))
    inside = [name for name in known if path[-1] in fields_at(model, (*path[:-1], name), data)]
    if "port" in known and "driver" in known:
        known = sorted((*known, "serial"))  # stands for the port
    near = difflib.get_close_matches(path[-1], known, n=1, cutoff=0.5)
    if inside:
        return f"unknown key; did you mean {inside[0]}.{path[-1]}?"
    if near:
        return f"unknown key; did you mean {near[0]}?"
    return f"unknown key; known here: {', '.join(known)}"


def fields_at(model: type[BaseModel], path: KeyPath, data: Mapping[str, Any]) -> set[str]:
    """The keys that may stand in the table at `path`; where drivers differ, those of the driver named in `data`."""
    kind: Any = model
    node: Any = data
    for step in path:
        key, indices = _split_indices(step)
        node = node.get(key) if isinstance(node, Mapping) else None
        kind = _member(kind, key, node)
        for index in indices:
            node = node[index] if isinstance(node, tuple | list) and index < len(node) else None
            kind = next((each for each in get_args(kind) if each is not Ellipsis), None)
    kind = _choose(kind, node)
    return set(kind.model_fields) if isinstance(kind, type) and issubclass(kind, BaseModel) else set()


def _split_indices(step: str) -> tuple[str, list[int]]:
    key, *rest = step.split("[")
    return key, [int(part.rstrip("]")) for part in rest]


def _member(kind: Any, key: str, node: Any) -> Any:
    kind = _choose(kind, None) if not isinstance(kind, type) else kind
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        field = kind.model_fields.get(key)
        return _choose(field.annotation, node) if field else None
    if get_origin(kind) is dict:
        return _choose(get_args(kind)[1], node)
    return None


def _choose(kind: Any, node: Any) -> Any:
    """Strip Annotated and Optional; of several models take the one whose `driver` the table names."""
    if get_origin(kind) is typing.Annotated:
        return _choose(get_args(kind)[0], node)
    if get_origin(kind) in (Union, types.UnionType):
        members = [_choose(each, None) for each in get_args(kind) if each is not type(None)]
        driver = node.get("driver") if isinstance(node, Mapping) else None
        return next((each for each in members if driver in _drivers_of(each)), members[0] if members else None)
    return kind


def _drivers_of(kind: Any) -> tuple[Any, ...]:
    field = kind.model_fields.get("driver") if isinstance(kind, type) and issubclass(kind, BaseModel) else None
    annotation = field.annotation if field else None
    return get_args(annotation) if get_origin(annotation) is Literal else ()
