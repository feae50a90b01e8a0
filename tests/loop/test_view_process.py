"""`umfeld view` as a process: it waits for its daemon, outlives it, and ends when it is told to."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import zenoh

from service.view import ALIVE_KEY
from service.zenoh_session import NetworkSettings, closing, open_router
from tests.waiting import GIVE_UP_S, START_S, free_port, wait_for


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
            publisher: Any = session.declare_publisher("robots/r1/info")
            wait_for("the page to receive", lambda: publisher.matching_status.matching)
            publisher.put("{}")  # what it takes comes while it waits, and while it ends
            if daemon_gone:
                session.close()  # type: ignore[no-untyped-call]
            view.send_signal(told)
            _, complaints = view.communicate(timeout=START_S)
    assert complaints == ""
    assert view.returncode == 0


async def robots_told(address: str, seen: Callable[[list[str]], None]) -> None:
    """Read a page's stream and hand on each list of living robots, until cancelled."""
    async with aiohttp.ClientSession() as http, http.ws_connect(f"{address}stream") as stream:
        async for message in stream:
            length = int.from_bytes(message.data[:2], "little")
            if message.data[2 : 2 + length] == ALIVE_KEY.encode():
                seen(json.loads(message.data[2 + length + 3 :]))


def test_the_page_waits_for_its_daemon_and_outlives_it(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    complaints = tmp_path / "stderr"

    async def watch(address: str) -> None:
        told: list[list[str]] = []
        page = asyncio.create_task(robots_told(address, told.append))

        async def until(robots: list[str]) -> None:
            async with asyncio.timeout(GIVE_UP_S):
                while told[-1:] != [robots]:
                    assert not page.done(), page
                    await asyncio.sleep(0.02)

        await until([])
        for _ in range(2):  # it comes, goes and comes again
            with closing(open_router(NetworkSettings(listen=(endpoint,)))) as session:
                token = session.liveliness().declare_token("robots/r1/alive")
                await until(["robots/r1"])
                del token
            await until([])
        page.cancel()

    with complaints.open("w") as file:
        view = subprocess.Popen(
            [sys.executable, "-m", "service", "view", "--port", "0", "--connect", endpoint],
            stdout=subprocess.PIPE,
            stderr=file,
            text=True,
        )
        with view:
            try:
                assert view.stdout is not None
                address = view.stdout.readline().strip()
                wait_for("the line that says it waits", lambda: "waits for it" in complaints.read_text())
                asyncio.run(watch(address))
                view.send_signal(signal.SIGINT)
                assert view.wait(START_S) == 0
            finally:
                view.kill()
    lines = complaints.read_text().splitlines()
    assert len(lines) == 2, lines
    assert "umfeld run" in lines[0]
    assert "--connect" in lines[0]
    assert "answers" in lines[1]


@pytest.mark.parametrize("wrong", ["robot", "tcp/127.0.0.1", "tcp/127.0.0.1:99999", "http://robot:7447"])
@pytest.mark.parametrize("command", ["view", "status"])
def test_an_address_that_is_none_is_refused(command: str, wrong: str) -> None:
    port = ["--port", "0"] if command == "view" else []
    done = subprocess.run(
        [sys.executable, "-m", "service", command, *port, "--connect", wrong],
        capture_output=True,
        text=True,
        timeout=START_S,
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line == f"umfeld: {wrong}: is no address of a daemon; one looks like tcp/127.0.0.1:7447 (--connect)"
