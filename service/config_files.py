"""Where configuration files are, and what stands on which line of them. Light: no pydantic, for the quick commands.

Layers, later ones win, tables merged key by key and everything else replaced: the file, the overlays beside it
(`umfeld.toml` has `umfeld.d/*.toml`, in the order of their names), environment variables, `--set` on the command line.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from service.errors import WrongUsage
from service.tls import TlsFiles

FILE_NAME = "umfeld.toml"
ENVIRONMENT_PREFIX = "UMFELD__"  # UMFELD__ROBOT__ID=artos sets robot.id
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

KeyPath = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Layers:
    """The merged tables, and for every key that was set where: `umfeld.toml:12`, `environment UMFELD__X`, `--set`."""

    data: dict[str, Any]
    origins: dict[KeyPath, str]
    tables: dict[KeyPath, str]  # where each table begins
    files: tuple[Path, ...]


@dataclass(slots=True)
class _Merge:
    data: dict[str, Any] = field(default_factory=dict)
    origins: dict[KeyPath, str] = field(default_factory=dict)
    tables: dict[KeyPath, str] = field(default_factory=dict)

    def add(self, table: Mapping[str, Any], keys: Mapping[KeyPath, str], tables: Mapping[KeyPath, str]) -> None:
        _merge_into(self.data, table)
        self.origins.update(keys)
        self.tables.update(tables)


def find_config(given: Path | None, *, home: Path | None = None, here: Path | None = None) -> Path | None:
    """The configuration file to use, or None for defaults only. Raises WrongUsage if a given file is not there."""
    if given is not None:
        if given.is_dir():
            raise WrongUsage(f"{given}: is a folder; name the file in it, e.g. {given / 'umfeld.toml'}")
        if not given.is_file():
            raise WrongUsage(f"{given}: no such configuration file; write one with `umfeld config init {given}`")
        return given
    candidates = (
        (here or Path.cwd()) / FILE_NAME,
        (home or Path.home()) / ".config" / "umfeld" / FILE_NAME,
        Path("/etc/umfeld") / FILE_NAME,
    )
    return next((path for path in candidates if path.is_file()), None)


def read_layers(
    path: Path | None, *, environment: Mapping[str, str] | None = None, settings: Sequence[str] = ()
) -> Layers:
    """Merge the file, its overlays, the environment and `KEY=VALUE` settings.

    Raises WrongUsage, one line per file that cannot be read or is not TOML.
    """
    merge = _Merge()
    faults: list[str] = []
    files = _files_of(path)
    for file in files:
        try:
            merge.add(*_read_file(file))
        except WrongUsage as fault:
            faults.extend(fault.lines)
    for name, text in sorted((os.environ if environment is None else environment).items()):
        if name.startswith(ENVIRONMENT_PREFIX):
            keys = tuple(part.lower() for part in name.removeprefix(ENVIRONMENT_PREFIX).split("__"))
            merge.add(*_single(keys, text, f"environment {name}"))
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            faults.append(f"--set {setting}: expected KEY=VALUE, for example --set robot.id=artos")
            continue
        merge.add(*_single(tuple(key.strip().split(".")), text.strip(), "--set"))
    if faults:
        raise WrongUsage(*faults)
    return Layers(merge.data, merge.origins, merge.tables, files)


def daemon_endpoint(path: Path | None) -> str:
    """Where a client on this machine reaches the daemon of this configuration: its first listen endpoint.

    Reads only what it needs, so that faults elsewhere in the file do not keep `status` from answering.
    """
    try:
        listen = read_layers(path).data["network"]["listen"]
        return str(listen[0])
    except (WrongUsage, LookupError, TypeError):
        return DEFAULT_ENDPOINT


def daemon_tls(path: Path | None) -> TlsFiles | None:
    """The certificate of [network.tls], for a client of this configuration's daemon; None if there is none."""
    try:
        named = read_layers(path).data["network"]["tls"]
        authority, certificate, key = (
            str(named[each]) for each in ("root_ca_certificate", "listen_certificate", "listen_private_key")
        )
        return TlsFiles(authority, certificate, key)
    except (WrongUsage, LookupError, TypeError):
        return None


def origin_of(origins: Mapping[KeyPath, str], path: KeyPath) -> str:
    """Where a value came from: its own origin, else that of the array around it, else `default`."""
    for length in range(len(path), 0, -1):
        if path[:length] in origins:
            return origins[path[:length]]
    return "default"


def _files_of(path: Path | None) -> tuple[Path, ...]:
    if path is None:
        return ()
    overlays = path.with_suffix(".d")
    return (path, *sorted(overlays.glob("*.toml"))) if overlays.is_dir() else (path,)


def _read_file(path: Path) -> tuple[dict[str, Any], dict[KeyPath, str], dict[KeyPath, str]]:
    try:
        text = path.read_text(encoding="utf-8")
        table = tomllib.loads(text)
    except OSError as error:
        raise WrongUsage(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
    except UnicodeDecodeError as error:
        raise WrongUsage(f"{path}: is not UTF-8 text (byte {error.start}); save it as UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        raise WrongUsage(f"{path}: is not valid TOML: {error}") from error
    keys, tables = lines_of_keys(text)
    return (
        table,
        {key: f"{path}:{line}" for key, line in keys.items()},
        {key: f"{path}:{line}" for key, line in tables.items()},
    )


def lines_of_keys(text: str) -> tuple[dict[KeyPath, int], dict[KeyPath, int]]:
    """The lines (from 1) on which the keys of a valid TOML text are set, and those of the tables' headers.

    The standard parser tells no positions, so statements are cut off one by one: a header is one line, and a
    `key = value` ends where the lines so far parse.
    """
    found: dict[KeyPath, int] = {}
    tables: dict[KeyPath, int] = {}
    table: KeyPath = ()
    lines = text.splitlines()
    index = 0
    while index < len(lines):
        start = index
        statement = lines[index]
        index += 1
        if not statement.strip() or statement.lstrip().startswith("#"):
            continue
        while (parsed := _try_parse(statement)) is None and index < len(lines):
            statement += "\n" + lines[index]
            index += 1
        if parsed is None:
            continue
        if re.match(r"\s*\[", statement):
            table = _only_path(parsed)
            tables.setdefault(table, start + 1)
        else:
            for keys in _leaf_paths(parsed):
                found[table + keys] = start + 1
    return found, tables


def _try_parse(text: str) -> dict[str, Any] | None:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return None


def _only_path(table: Any) -> KeyPath:
    """The keys of a header that was parsed alone: nested tables (or arrays of one table) of one key each."""
    path: list[str] = []
    while table:
        if isinstance(table, list):
            table = table[0]
            continue
        key, table = next(iter(table.items()))
        path.append(key)
    return tuple(path)


def _leaf_paths(table: Mapping[str, Any], before: KeyPath = ()) -> list[KeyPath]:
    paths: list[KeyPath] = []
    for key, value in table.items():
        if isinstance(value, dict) and value:
            paths.extend(_leaf_paths(value, (*before, key)))
        else:
            paths.append((*before, key))
    return paths


def _single(keys: KeyPath, text: str, origin: str) -> tuple[dict[str, Any], dict[KeyPath, str], dict[KeyPath, str]]:
    """One value from outside a file; text that is not a TOML value is taken as a string."""
    parsed = _try_parse(f"value = {text}")
    value: Any = text if parsed is None else parsed["value"]
    for key in reversed(keys):
        value = {key: value}
    return value, {keys: origin}, {}


def _merge_into(target: dict[str, Any], extra: Mapping[str, Any]) -> None:
    for key, value in extra.items():
        if isinstance(value, dict) and isinstance(target.get(key), dict):
            _merge_into(target[key], value)
        else:
            target[key] = value
