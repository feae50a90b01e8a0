"""`umfeld view` as a process: how it ends when it is told to, with the daemon there or gone."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from service.zenoh_session import NetworkSettings, closing, open_router
from tests.waiting import START_S, free_port


@contextmanager
def router() -> Iterator[tuple[str, zenoh.Session]]:
    """What a daemon is to the page: a router to be asked."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with closing(open_router(NetworkSettings(listen=(endpoint,)))) as session:
        yield endpoint, session


@pytest.mark.parametrize("told", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("daemon_gone", [False, True])
def test_the_page_ends_quietly(told: signal.Signals, daemon_gone: bool, tmp_path: Path) -> None:
    with router() as (endpoint, session):
        config = tmp_path / "umfeld.toml"
        config.write_text(f'[network]\nlisten = ["{endpoint}"]\n')  # where the daemon is, as for all commands
        view = subprocess.Popen(
            [sys.executable, "-m", "service", "view", "--port", "0", "--config", str(config)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        with view:
            assert view.stdout is not None
            assert view.stdout.readline().startswith("http://127.0.0.1:")
            session.put("robots/r1/info", "{}")  # what it takes comes while it waits, and while it ends
            if daemon_gone:
                session.close()  # type: ignore[no-untyped-call]
            view.send_signal(told)
            _, complaints = view.communicate(timeout=START_S)
    assert complaints == ""
    assert view.returncode == 0
