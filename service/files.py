"""Files that are whole or not there: written beside, synced, renamed, read back."""

from __future__ import annotations

import fcntl
import glob
import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from service.errors import Trouble

_BLOCK = 1 << 20
_PART = ".part"


class FileTrouble(Trouble):
    """A file could not be written or read; names the file, the reason and the repair."""


@dataclass(frozen=True, slots=True)
class Receipt:
    """Proof of a file that was written: taken from the file itself after it had its final name."""

    path: Path
    size: int
    sha256: str
    saved_at: str  # ISO 8601, UTC

    def document(self) -> dict[str, object]:
        """As replies and --json give it."""
        return {"path": str(self.path), "bytes": self.size, "sha256": self.sha256, "saved_at": self.saved_at}


def write_whole(path: Path, data: bytes) -> Receipt:
    """Write a file so that at any instant it is the old one or the new one, and check what the disk gives back."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)
    receipt = receipt_of(path)
    if receipt.sha256 != hashlib.sha256(data).hexdigest():
        raise FileTrouble(f"{path}: the disk gave back other bytes than were written; check the disk, save elsewhere")
    return receipt


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path in the same folder; what is written there takes the place of path at the end, synced.

    On an error nothing is left behind and path is as it was. OSErrors become FileTrouble. It is locked meanwhile: see
    remove_abandoned.
    """
    try:
        descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=_PART, dir=path.parent)
    except OSError as error:
        raise _cannot_write(path, error) from error
    temporary = Path(name)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        sync(temporary)
        temporary.replace(path)
        sync(path.parent)
    except OSError as error:
        raise _cannot_write(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)
        os.close(descriptor)


def remove_abandoned(folder: Path, name_part: str) -> int:
    """Remove temporary files of replacing() whose process was killed, and what SQLite put beside them; how many bytes.

    name_part: in the name of the file that was to be replaced. What another process still writes is locked, and stays.
    """
    removed = 0
    for temporary in folder.glob(f".*{name_part}*{_PART}"):
        with suppress(OSError), temporary.open("rb") as file:  # gone meanwhile, another's, or locked
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            for each in (temporary, *folder.glob(f"{glob.escape(temporary.name)}[-.]*")):
                removed += each.stat().st_size
                each.unlink()
    return removed


def sync(path: Path) -> None:
    """fsync a file or a folder."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def receipt_of(path: Path) -> Receipt:
    """Size, hash and time of a file, read from it."""
    digest, size = hashlib.sha256(), 0
    try:
        with path.open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
                size += len(block)
            modified = os.fstat(file.fileno()).st_mtime
    except OSError as error:
        raise FileTrouble(f"{path}: cannot be read back: {error.strerror}") from error
    saved_at = datetime.fromtimestamp(modified, UTC).isoformat(timespec="seconds")
    return Receipt(path.resolve(), size, digest.hexdigest(), saved_at)


def _cannot_write(path: Path, error: OSError) -> FileTrouble:
    repair = {
        "No space left on device": "free some space or save elsewhere",
        "Permission denied": f"allow writing to {path.parent}, or save elsewhere",
        "No such file or directory": f"make the folder {path.parent} first",
        "Read-only file system": "save elsewhere",
    }.get(error.strerror or "", "save elsewhere")
    return FileTrouble(f"{path}: cannot be written: {error.strerror or error}; {repair}")


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask
