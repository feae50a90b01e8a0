"""`umfeld view`: the live page, a process of its own and a client of the daemon like any other."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import threading
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.errors import Trouble

if TYPE_CHECKING:
    from service.relay import Sample
    from service.tls import TlsFiles
    from service.view import Relay
    from service.zenoh_session import Client

app = typer.Typer()

DEFAULT_PORT = 8765
DRAWN = ("scan/*", "range/*", "sectors/polar/*", "pose", "map/**", "health/json", "info")
"""What page.js takes. Each key more costs the daemon: a subscriber makes a put several times as dear."""
_TRY_S = 0.5
_END_S = 4.0  # undeclaring and closing the session
_RING = 256
_DRAIN = 64


@app.command()
def view(
    *,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0: a free one.")] = DEFAULT_PORT,
    connect: Annotated[
        str | None, typer.Option(help="The daemon's endpoint; default: that of the configuration.")
    ] = None,
    config: Annotated[Path | None, typer.Option("--config", "-c", help="The daemon's configuration file.")] = None,
    base: Annotated[str, typer.Option(help="Key of the robots to show; * stands for any.")] = "robots/*",
    allow_host: Annotated[
        list[str] | None, typer.Option(help="Another name for this page, e.g. of a reverse proxy before it.")
    ] = None,
) -> None:
    """The live page: map, robot, scan, sonar cones, sectors, devices. Read-only, on this machine only.

    Example: umfeld view --port 8765, and from a desk: ssh -L 8765:127.0.0.1:8765 robot
    """
    from service.config_files import daemon_endpoint, daemon_tls, find_config

    path = find_config(config)
    endpoint = connect or daemon_endpoint(path)
    try:
        asyncio.run(_serve(endpoint, daemon_tls(path), base, port, allow_host or []))
    except OSError as error:
        raise Trouble(f"the page's port {port} cannot be had ({error.strerror}): choose another with --port") from error


async def _serve(endpoint: str, tls: TlsFiles | None, base: str, port: int, allow_host: Sequence[str]) -> None:
    serve, loopback_names = _page_server()
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    for name in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(name, stop.set)
    troubles: list[Trouble] = []

    def give_up(trouble: Trouble) -> None:
        troubles.append(trouble)
        loop.call_soon_threadsafe(stop.set)

    await serve(
        lambda relay: _receive_when_there(endpoint, base, relay, give_up, tls=tls),
        port=port,
        on_ready=lambda address: print(address, flush=True),
        hosts=loopback_names | {name.lower() for name in allow_host},
        stop=stop,
    )
    if troubles:
        raise troubles[0]


def _page_server() -> tuple[Callable[..., Awaitable[None]], frozenset[str]]:
    """service.view, without the 80 ms in which aiohttp would read all certificate authorities: it calls nobody here."""
    before = os.environ.get("SSL_CERT_FILE")
    os.environ["SSL_CERT_FILE"] = os.devnull
    try:
        from service.view import LOOPBACK_NAMES, serve
    finally:
        if before is None:
            del os.environ["SSL_CERT_FILE"]
        else:
            os.environ["SSL_CERT_FILE"] = before
    return serve, frozenset(LOOPBACK_NAMES)


def _receive_when_there(
    endpoint: str, base: str, relay: Relay, give_up: Callable[[Trouble], None], *, tls: TlsFiles | None = None
) -> Callable[[], None]:
    """Receive as soon as a daemon answers, which is tried for ever; returns what ends it. Says in a line that it waits.

    give_up: told what no waiting mends, such as an address that is none. A daemon that goes and comes again is Zenoh's
    business: the session reaches it again by itself.
    """
    stopping = threading.Event()

    def run() -> None:
        try:
            client = _client_when_there(endpoint, tls, stopping)
        except Trouble as trouble:
            give_up(trouble)
            return
        if client is not None:
            with client, contextlib.ExitStack() as ending:
                ending.callback(_receive(client, base, relay))
                stopping.wait()

    receiving = threading.Thread(target=run, name="view-receive", daemon=True)
    receiving.start()

    def end() -> None:
        stopping.set()
        receiving.join(_END_S)

    return end


def _client_when_there(endpoint: str, tls: TlsFiles | None, stopping: threading.Event) -> Client | None:
    """The session, once it can be had; None if told to stop before."""
    from service.zenoh_session import Client, NoDaemon

    has_waited = False
    while not stopping.is_set():
        try:
            client = Client(endpoint, tls=tls)
        except NoDaemon:
            if not has_waited:
                typer.echo(
                    f"umfeld: no daemon answers at {endpoint} yet, the page waits for it: start one with `umfeld run`, "
                    "or name its address with --connect",
                    err=True,
                )
            has_waited = True
            stopping.wait(_TRY_S)
        else:
            if has_waited:
                typer.echo(f"umfeld: a daemon answers at {endpoint}", err=True)
            return client
    return None


def _receive(client: Client, base: str, relay: Relay) -> Callable[[], None]:
    """Subscribe to what the page draws and to the robots' coming and going; returns what ends it."""
    import zenoh

    from service.topics import ALIVE
    from service.view import Pump
    from service.zenoh_session import subscribe_liveliness

    samples = [client.subscribe_latched(f"{base}/{keys}", ring=_RING) for keys in DRAWN]
    tokens = subscribe_liveliness(client.session, f"{base}/{ALIVE}")

    def take(channel: Any) -> Sequence[Sample] | None:
        try:
            batch = [_plain(channel.recv())]
            while len(batch) < _DRAIN and (more := channel.try_recv()) is not None:
                batch.append(_plain(more))
        except zenoh.ZError:  # undeclared
            return None
        return batch

    def watch() -> Sequence[Sample] | None:
        try:
            token = tokens.handler.recv()
        except zenoh.ZError:
            return None
        relay.robot_from_thread(str(token.key_expr).removesuffix(f"/{ALIVE}"), str(token.kind) == "SampleKind.PUT")
        return ()

    # By their handlers: a subscriber that waits in recv() itself cannot be undeclared ("Already borrowed").
    pumps = [*(Pump(partial(take, each.handler), relay) for each in samples), Pump(watch, relay)]
    for pump in pumps:
        pump.start()

    def end() -> None:
        for subscriber in (*samples, tokens):
            with contextlib.suppress(zenoh.ZError):
                subscriber.undeclare()
        for pump in pumps:
            pump.join(1.0)

    return end


def _plain(sample: object) -> Sample:
    from service.relay import Sample
    from service.zenoh_session import received

    got = received(sample)  # type: ignore[arg-type]
    return Sample(got.key, got.payload, got.attachment or b"")
