"""Child processes of the demo: started in order, watched together, ended by their own ids."""

from __future__ import annotations

import ctypes
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from service.errors import Trouble


@dataclass(slots=True)
class Child:
    """One running process. name: for people.  log: where its output goes."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def last_lines(self, count: int = 5) -> str:
        """The end of its output, for an error message."""
        text = self.log.read_text(errors="replace") if self.log.exists() else ""
        return "\n".join([line for line in text.splitlines() if line.strip()][-count:])


@dataclass(slots=True)
class Family:
    """Processes that live and end together; use as a context manager."""

    folder: Path
    children: list[Child] = field(default_factory=list)
    _files: list[IO[bytes]] = field(default_factory=list)

    def start(self, name: str, command: Sequence[str]) -> Child:
        """Start a process in a session of its own: a terminal's Ctrl-C reaches only us, and we end them in order."""
        log = self.folder / f"{name}.log"
        file = log.open("wb")
        self._files.append(file)
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=_end_with_parent,
        )
        child = Child(name, process, log)
        self.children.append(child)
        return child

    def check(self) -> None:
        """Raise Trouble if one of them has ended by itself."""
        for child in self.children:
            if (code := child.process.poll()) is not None:
                raise Trouble(f"{child.name} ended with code {code}: {child.last_lines()} (its output: {child.log})")

    def wait_for(self, what: str, ready: Callable[[], bool], *, seconds: float) -> None:
        """Poll until ready() holds; Trouble if a child ends or the time runs out."""
        deadline = time.monotonic() + seconds
        while not ready():
            self.check()
            if time.monotonic() > deadline:
                raise Trouble(f"{what} did not come within {seconds:.0f} s; the outputs are in {self.folder}")
            time.sleep(0.05)

    def __enter__(self) -> Family:
        return self

    def __exit__(self, *_: object) -> None:
        for child in reversed(self.children):
            _end(child.process)
        for file in self._files:
            file.close()


_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_LIBC = ctypes.CDLL(None)


def _end_with_parent() -> None:
    """In the child: be told to end when the parent dies, even by kill -9, so that no daemon is left behind."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _end(process: subprocess.Popen[bytes], *, patience_s: float = 6.0) -> None:
    """Ask, then insist."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(patience_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
