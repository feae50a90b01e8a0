"""Other daemons with our robot's id, which Zenoh reaches through linked routers: readers would get both robots' values.

Each daemon puts up a token of its own, `<base>/@daemon/<zenoh id>/<host>/<process>`, and listens for those of others.
"""

from __future__ import annotations

import logging
import os
import re
import socket
from typing import Any

from service import zenoh_session
from service.topics import DAEMON

_LOG = logging.getLogger(__name__)

BELIEVED_AFTER_NS = 7_000_000_000
"""A token of our own earlier self behind another router lives for a lease of 3 s after power was cut."""


class Namesakes:
    """Their tokens, as far as they were heard. trouble() is for one thread."""

    def __init__(self, session: Any, base: str) -> None:
        self._base = base
        self._own_id = str(session.info.zid())
        self._ours = f"{base}/{DAEMON}/{self._own_id}/{_chunk(socket.gethostname())}/{os.getpid()}"
        self._token = session.liveliness().declare_token(self._ours)
        self._heard = zenoh_session.subscribe_liveliness(session, f"{base}/{DAEMON}/**")
        self._since_ns: dict[str, int] = {}
        self._told: frozenset[str] = frozenset()

    def trouble(self, now_ns: int) -> str | None:
        """Who else has our robot's id, in words with the repair; told in the log as well, once."""
        self._hear(now_ns)
        others = sorted(who for who, since in self._since_ns.items() if now_ns - since >= BELIEVED_AFTER_NS)
        if not others:
            self._told = frozenset()
            return None
        robot = self._base.rpartition("/")[2]
        text = (
            f"another daemon calls itself {robot} too ({', '.join(map(_words, others))}) and the Zenoh routers are "
            "linked: readers get the values of both, mixed; give one of them another [robot] id"
        )
        if self._told != frozenset(others):
            self._told = frozenset(others)
            _LOG.error("%s", text)
        return text

    def _hear(self, now_ns: int) -> None:
        while (sample := self._heard.try_recv()) is not None:
            who = str(sample.key_expr).removeprefix(f"{self._base}/{DAEMON}/")
            if who.partition("/")[0] == self._own_id:
                continue
            if "PUT" in str(sample.kind):
                self._since_ns.setdefault(who, now_ns)
            else:
                self._since_ns.pop(who, None)


def _chunk(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]", "-", name) or "unknown"


def _words(who: str) -> str:
    _zenoh_id, _, rest = who.partition("/")
    host, _, process = rest.partition("/")
    return f"process {process or 'unknown'} on {host or 'unknown'}"
