"""What is around the maps in the configuration: network, files, logging."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator, model_validator

from service.config_base import Name, Section
from service.config_files import DEFAULT_ENDPOINT


class Tls(Section):
    """Certificates for listening beyond this machine."""

    root_ca_certificate: str = Field(min_length=1, description="File: who signed the certificates we accept.")
    listen_certificate: str = Field(min_length=1, description="File: our certificate.")
    listen_private_key: str = Field(min_length=1, description="File: its key.")
    mutual: bool = Field(default=True, description="Ask clients for a certificate too.")


class Network(Section):
    """The Zenoh router inside the daemon."""

    listen: tuple[str, ...] = Field(
        default=(DEFAULT_ENDPOINT,),
        min_length=1,
        description="Where clients connect. Anything but loopback and unix sockets needs tls/ and [network.tls].",
    )
    connect: tuple[str, ...] = Field(default=(), description="Other routers to link to, for example a fleet's.")
    tls: Tls | None = Field(default=None, description="Certificates; needed for tls/ endpoints.")
    config: str | None = Field(
        default=None, description="File (JSON5) with further Zenoh settings, for example access rules."
    )

    @field_validator("listen", "connect")
    @classmethod
    def _endpoints(cls, endpoints: tuple[str, ...]) -> tuple[str, ...]:
        for endpoint in endpoints:
            protocol, slash, address = endpoint.partition("/")
            if protocol not in ("tcp", "udp", "tls", "quic", "ws", "unixsock-stream") or not slash or not address:
                raise ValueError(f"{endpoint!r} is not an endpoint; write it like {DEFAULT_ENDPOINT}")
        return endpoints

    @model_validator(mode="after")
    def _closed_to_strangers(self) -> Network:
        for endpoint in (*self.listen, *self.connect):
            if endpoint.startswith(("tls/", "quic/")) and self.tls is None:
                raise ValueError(f"{endpoint} needs certificates; add [network.tls], see deploy/ for an example")
        for endpoint in self.listen:
            if not is_local(endpoint) and not endpoint.startswith(("tls/", "quic/")):
                port = endpoint.rpartition(":")[2]
                raise ValueError(
                    f"{endpoint} would be open to everyone on the network; listen on tcp/127.0.0.1:{port}, or on tls/ "
                    "with [network.tls]"
                )
        return self


def is_local(endpoint: str) -> bool:
    """Whether only this machine reaches an endpoint."""
    protocol, _, address = endpoint.partition("/")
    if protocol == "unixsock-stream":
        return True
    host = address.partition("#")[0].partition("?")[0].rpartition(":")[0]
    return host in ("localhost", "[::1]") or (host.startswith("127.") and host.replace(".", "").isdigit())


class Ros(Section):
    """The same data for an unmodified ROS 2 system with rmw_zenoh."""

    enabled: bool = Field(default=False, description="Publish under ROS 2 names and tokens as well.")
    distro: Literal["humble", "iron", "jazzy", "kilted", "lyrical", "rolling"] = Field(
        default="jazzy", description="Whose type hashes to use."
    )
    domain_id: int = Field(default=0, ge=0, le=232, description="ROS_DOMAIN_ID.")


class Anchor(Section):
    """Where a map's origin lies on the earth (WGS 84), and how the map is turned."""

    latitude_deg: float = Field(ge=-90, le=90, description="Latitude of the map's origin.")
    longitude_deg: float = Field(ge=-180, le=180, description="Longitude of the map's origin.")
    height_m: float = Field(default=0.0, description="Height above the ellipsoid.")
    yaw_deg: float = Field(default=0.0, ge=-360, le=360, description="The map's x axis, counter-clockwise from east.")


class Store(Section):
    """The map on disk."""

    enabled: bool = Field(default=True, description="Keep the map across restarts.")
    path: str | None = Field(
        default=None, description="The map's file; default: ROBOT.umfeld in $STATE_DIRECTORY or ~/.local/share/umfeld."
    )
    snapshot_period_s: float = Field(
        default=5.0, ge=0.5, le=3600, description="At most this much is lost when power fails."
    )
    anchor: Anchor | None = Field(
        default=None, description="The map on the earth: kept in its file, for exports; default: the file's own."
    )


class Search(Section):
    """Where devices are looked for that are named by their serial number."""

    ports: tuple[str, ...] = Field(
        default=("/dev/serial/by-id/*", "/dev/serial/by-path/*", "/dev/ttyACM*", "/dev/ttyUSB*"),
        min_length=1,
        description="Patterns of port names.",
    )


class Mavlink(Section):
    """A polar sector map for an autopilot's obstacle avoidance: OBSTACLE_DISTANCE."""

    enabled: bool = Field(default=False, description="Send it.")
    map: Name | None = Field(default=None, description="The [sectors.polar.NAME] to send; default: the only one.")
    port: str = Field(
        default="udpout:127.0.0.1:14550",
        min_length=1,
        description="udpout:127.0.0.1:PORT, udpin:127.0.0.1:PORT, or a serial port.",
    )
    baud_bps: int = Field(default=57600, ge=1200, le=4000000, description="Line speed of a serial port.")
    rate_hz: float = Field(default=15.0, ge=10, le=50, description="Messages a second, on a steady beat.")
    system_id: int = Field(default=1, ge=1, le=255, description="That of the vehicle.")
    component_id: int = Field(default=196, ge=1, le=255, description="Ours; 196 is obstacle avoidance.")
    range_min_m: float = Field(default=0.1, gt=0, le=10, description="Nearer obstacles are told as this near.")
    range_max_m: float = Field(default=10.0, gt=0, le=600, description="Farther ones are not told.")

    @field_validator("port")
    @classmethod
    def _this_machine(cls, port: str) -> str:
        if port.startswith("/"):
            return port
        from drivers.udp_port import parse_udp

        if parse_udp(port) is None:
            raise ValueError(f"{port!r} is neither a serial port (/dev/...) nor like udpout:127.0.0.1:14550")
        return port

    @model_validator(mode="after")
    def _in_order(self) -> Mavlink:
        if self.range_min_m >= self.range_max_m:
            raise ValueError("range_min_m must be below range_max_m")
        return self


class RecordingSettings(Section):
    """What happened, byte by byte, for `umfeld replay`."""

    enabled: bool = Field(default=False, description="From the first byte; `umfeld record` does it on demand.")
    folder: str | None = Field(
        default=None, description="Where to; default: recordings in $STATE_DIRECTORY or ~/.local/share/umfeld."
    )
    published: bool = Field(default=True, description="Keep what is published too, not only what replay needs.")
    file_mb: float = Field(default=256.0, ge=1, le=100000, description="A file this large is ended and the next begun.")
    total_mb: float = Field(default=8000.0, ge=2, description="All recordings together; the oldest make room.")
    free_mb: float = Field(default=1000.0, ge=0, description="So much of the disk is left free for others.")

    @model_validator(mode="after")
    def _room_for_two(self) -> RecordingSettings:
        if self.total_mb < 2 * self.file_mb:
            raise ValueError("total_mb must hold at least two files of file_mb")
        return self


class Log(Section):
    """What is written to standard error."""

    level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="Least weight that is written."
    )
