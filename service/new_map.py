"""A map file that begins anew: what it holds is kept under a name beside it first."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from service.files import Receipt
from service.store import SUFFIX, MapStore, StoreNotWritten, StoreTrouble

_LOG = logging.getLogger(__name__)

REPLACED = "replaced"
"""Name of the map that was live before another was loaded."""

_GONE_WITH_THE_MAP = {"pose": None, "anchor": None}


def keep_and_empty(store: MapStore, name: str | None, *, wall_ns: int) -> dict[str, Any]:
    """Save the map as NAME beside itself, then leave nothing in it; in the words of the call `new_map`.

    name: None is one made of the time.  wall_ns: now.  StoreTrouble, with the map as it was, if it cannot be kept; a
    name that is there already is not replaced. A map with nothing in it is not kept.
    """
    kept: dict[str, Any] | None = None
    if any(store.layers().values()):
        path = _path_of(store.path, name, wall_ns)
        kept = {"name": path.stem, **_saved(store, path).document()}
    try:
        store.snapshot(dict.fromkeys(store.layers(), ()), _GONE_WITH_THE_MAP, replace=True)
    except StoreNotWritten as trouble:
        if kept is not None:  # a copy of what goes on: it would only take what little room there is, and the name
            Path(kept["path"]).unlink(missing_ok=True)
        raise StoreTrouble(f"the old map goes on: {trouble}") from trouble
    try:
        store.keep_generation()  # else a file that breaks would be replaced by the map of another place
    except StoreNotWritten as trouble:
        _LOG.warning("%s: the older generations are of the map before: %s", store.path, trouble)
    return {"kept": kept, "path": str(store.path)}


def keep_replaced(store: MapStore) -> str | None:
    """Save the map as REPLACED, over the one of that name, before another is loaded; None if it holds nothing."""
    if not any(store.layers().values()):
        return None
    store.save_as(store.path.with_name(f"{REPLACED}{SUFFIX}"))
    return REPLACED


def told(document: Mapping[str, Any]) -> str:
    """The answer of new_map in a line."""
    kept = document["kept"]
    if kept is None:
        return "a new map begins; the one before held nothing"
    name = kept["name"]
    return f"a new map begins; the one before is kept as {name} (umfeld map load {name}): {kept['path']}"


def _path_of(live: Path, name: str | None, wall_ns: int) -> Path:
    if name is not None:
        path = live.with_name(f"{name}{SUFFIX}")
        if path.exists():
            what = "the live map's own file" if path == live else "there already"
            raise StoreTrouble(
                f"{name}: is {what}; NAME is what the map so far shall be kept as: choose another, or leave it out"
            )
        return path
    stem = time.strftime("until-%Y%m%d-%H%M%S", time.gmtime(wall_ns // 1_000_000_000))
    path, number = live.with_name(f"{stem}{SUFFIX}"), 1
    while path.exists():
        number += 1
        path = live.with_name(f"{stem}-{number}{SUFFIX}")
    return path


def _saved(store: MapStore, path: Path) -> Receipt:
    try:
        return store.save_as(path)
    except StoreNotWritten as trouble:
        raise StoreTrouble(f"the old map goes on, since it cannot be kept: {trouble}") from trouble
