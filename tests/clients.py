"""Zenoh clients of tests: as the program's own, but with the patience of a test."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from service.zenoh_session import Client, NetworkTrouble, Received
from tests.waiting import GIVE_UP_S, START_S, wait_for


class PatientClient(Client):
    """A client whose questions wait as long as a stalled machine may need; answers come as soon as they are there."""

    def bases(self, *, timeout_s: float = GIVE_UP_S) -> list[str]:
        return super().bases(timeout_s=timeout_s)

    def get(self, selector: str, *, timeout_s: float = GIVE_UP_S) -> list[Received]:
        return super().get(selector, timeout_s=timeout_s)

    def call(
        self, base: str, name: str, arguments: Mapping[str, object] | None = None, *, timeout_s: float = GIVE_UP_S
    ) -> Any:
        return super().call(base, name, arguments, timeout_s=timeout_s)


def document(client: Client, key: str) -> Any:
    """The JSON that a key has now; None if it has none yet."""
    found = client.get(key)
    return json.loads(found[0].payload) if found else None


def connected(endpoint: str, base: str) -> PatientClient:
    """A client of the robot of that base, once its daemon says that it is there."""

    def attempt() -> PatientClient | None:
        try:
            client = PatientClient(endpoint)
        except NetworkTrouble:
            return None
        if base in client.bases():
            return client
        client.close()
        return None

    return wait_for(f"the daemon of {base}", attempt, START_S, every_s=0.1)
