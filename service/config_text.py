"""Configuration as text for people: effective values with their origin, a commented example, the reference of keys."""

from __future__ import annotations

import json
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from service.config import Config, Loaded
from service.config_files import KeyPath


@dataclass(frozen=True, slots=True)
class Effective:
    """One value as the daemon would use it."""

    path: KeyPath
    value: Any
    origin: str

    @property
    def text(self) -> str:
        """As TOML."""
        return f"{'.'.join(self.path)} = {toml_value(self.value)}"


def effective_values(loaded: Loaded) -> list[Effective]:
    """Every value of the configuration with where it came from, in the order of the reference."""
    return [
        Effective(path, value, loaded.origin(path)) for path, value in _leaves(loaded.config.model_dump(mode="python"))
    ]


def toml_value(value: Any) -> str:
    """A value as TOML; None, which TOML lacks, as the word (unset)."""
    if value is None:
        return "(unset)"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, tuple | list):
        return "[" + ", ".join(toml_value(each) for each in value) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {toml_value(each)}" for key, each in value.items()) + " }"
    return repr(value)


def _leaves(table: Mapping[str, Any], before: KeyPath = ()) -> Iterator[tuple[KeyPath, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, (*before, key))
        else:
            yield (*before, key), value


# --- the reference ----------------------------------------------------------------------------------------------------


def reference() -> str:
    """Markdown: a table of keys for every section, made from the models."""
    return "\n".join(_section_text(Config, ()))


def _section_text(model: type[BaseModel], path: KeyPath) -> Iterator[str]:
    rows: list[str] = []
    inner: list[tuple[type[BaseModel], KeyPath]] = []
    for key, field in model.model_fields.items():
        models, named = _models_in(field.annotation)
        if models and not named and _is_plain_table(field.annotation):
            inner.append((models[0], (*path, key)))
            if path:
                rows.append(_row(key, field))
        elif models and named:
            inner.extend((each, (*path, key, "NAME")) for each in models)
        else:
            rows.append(_row(key, field))
            inner.extend((each, (*path, key)) for each in models)
    if path:
        driver = _driver_of(model)
        title = f"[{'.'.join(path)}]" + (f" with driver = {json.dumps(driver)}" if driver else "")
        yield from (f"### `{title}`", "", (model.__doc__ or "").strip(), "")
        if rows:
            yield from ("| key | default | meaning |", "| --- | --- | --- |", *rows, "")
    for each, where in inner:
        yield from _section_text(each, where)


def _row(key: str, field: FieldInfo) -> str:
    required = field.default is PydanticUndefined
    if isinstance(field.default, BaseModel):
        default = "see below"
    elif required:
        default = "required"
    else:
        default = "unset" if field.default is None else f"`{toml_value(field.default)}`"
    choices = _choices(field.annotation)
    allowed = f" One of: {', '.join(f'`{toml_value(each)}`' for each in choices)}." if len(choices) > 1 else ""
    return f"| `{key}` | {default} | {field.description or ''}{_limits(field)}{allowed} |"


def _limits(field: FieldInfo) -> str:
    words = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    found = [f"{words[name]} {getattr(each, name)}" for each in field.metadata for name in words if hasattr(each, name)]
    return f" ({', '.join(found)})" if found else ""


def _choices(kind: Any) -> tuple[Any, ...]:
    return get_args(kind) if get_origin(kind) is Literal else ()


def _driver_of(model: type[BaseModel]) -> str | None:
    field = model.model_fields.get("driver")
    choices = _choices(field.annotation) if field else ()
    return choices[0] if choices else None


def _is_plain_table(kind: Any) -> bool:
    return get_origin(kind) not in (tuple, list)


def _models_in(kind: Any) -> tuple[list[type[BaseModel]], bool]:
    """(the models that a field holds, whether they stand under names of the user's choice)."""
    origin = get_origin(kind)
    if origin is Annotated:
        return _models_in(get_args(kind)[0])
    if origin is dict:
        return _models_in(get_args(kind)[1])[0], True
    if origin in (Union, types.UnionType, tuple):
        return [model for each in get_args(kind) for model in _models_in(each)[0]], False
    return ([kind], False) if isinstance(kind, type) and issubclass(kind, BaseModel) else ([], False)


# --- a file to begin with ---------------------------------------------------------------------------------------------

EXAMPLE = """\
# Configuration of umfeld. Every value has a default; lines with # show what else can be said.
# `umfeld check` tells what is wrong with it, `umfeld config show` what every value is and where it came from.
# Lengths in metres, angles in degrees counter-clockwise from forward; x points forward, y to the left.

[robot]
id = "robot"                            # all Zenoh keys begin with robots/<id>
# The outline, corners in order, seen from the base's origin (between the wheels on a differential drive).
footprint_m = [[0.25, 0.20], [-0.25, 0.20], [-0.25, -0.20], [0.25, -0.20]]

# --- a laser on USB: `umfeld devices list` shows the ports -------------------------------------------------
# [lasers.front]
# driver = "hokuyo"
# port = "/dev/ttyACM0"                 # better a name that stays: /dev/serial/by-id/...
# mount = { x_m = 0.20, y_m = 0.0, z_m = 0.25, yaw_deg = 0.0 }

# --- wheels: two CANopen encoders --------------------------------------------------------------------------
# [can.main]
# interface = "socketcan"               # or "slcan": an adapter on a serial port
# channel = "can0"                      # the adapter's port with slcan: "/dev/ttyACM1"
# bitrate_bps = 1000000
#
# [wheels.drive]
# driver = "cia406"
# can = "main"
# node_left = 0x20
# node_right = 0x21
#
# [drive]
# source = "drive"
# wheel_radius_left_m = 0.10
# wheel_radius_right_m = 0.10
# track_width_m = 0.50
# ticks_per_turn_left = 4096.0          # negative if the count falls when rolling forward
# ticks_per_turn_right = -4096.0

# --- an ultrasonic chain ------------------------------------------------------------------------------------
# [sonars.bumper]
# driver = "usboard"
# can = "main"
# base_id = 0x400
# cone_deg = 30.0                       # full opening angle
# range_max_m = 3.0
# transducers = [
#     { channel = 1, x_m = 0.25, y_m = 0.10, yaw_deg = 20.0 },
#     { channel = 2, x_m = 0.25, y_m = -0.10, yaw_deg = -20.0 },
# ]

# --- maps: sectors answer "how far is the next thing in this direction?" ------------------------------------
# [sectors.polar.laser]
# sources = ["front"]
# sector_deg = 5.0
# start_deg = -120.0
# stop_deg = 120.0
#
# [sectors.rect.around]
# sources = ["front", "bumper"]
# size_m = [4.0, 4.0]
# sector_m = 0.25

[grid]
resolution_m = 0.05

[network]
listen = ["tcp/127.0.0.1:7447"]         # only this machine; other addresses need [network.tls]

[store]
snapshot_period_s = 5.0                 # at most this much of the map is lost when power fails
"""
