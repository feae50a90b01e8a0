"""The table of every Zenoh key: payload, encoding, rate, priority, cache, meaning. docs/keys.md is made from it.

Keys stand below a base, `robots/<id>` by default. Names in angle brackets come from the configuration and match
`[a-z0-9_-]+`. Nothing here needs Zenoh: the session file turns the words into Zenoh's values.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum

JSON_SECTORS = "application/json;umfeld.sectors.v1"
JSON_RANGES = "application/json;umfeld.ranges.v1"
JSON_HEALTH = "application/json;umfeld.health.v1"
JSON_INFO = "application/json;umfeld.info.v1"
JSON_GRID = "application/json;umfeld.grid.v1"
JSON_LINES = "application/json;umfeld.lines.v1"
JSON_CALIBRATION = "application/json;umfeld.calibration.v1"
JSON_SCENES = "application/json;umfeld.scenes.v1"
JSON_GRAPH = "application/json;umfeld.graph.v1"
JSON_PLANES = "application/json;umfeld.planes.v1"
JSON_TOPO = "application/json;umfeld.topo.v1"
JSON_LOCALISATION = "application/json;umfeld.localisation.v1"
JSON_ELEVATION = "application/json;umfeld.elevation.v1"
JSON_ROOMS = "application/json;umfeld.rooms.v1"
JSON_PLAN = "application/json;umfeld.plan.v1"
JSON_AGREEMENT = "application/json;umfeld.agreement.v1"
JSON_REPLY = "application/json;umfeld.reply.v1"

_CHUNK = re.compile(r"[a-z0-9_-]+\Z")


class Priority(Enum):
    """Zenoh's priorities by name, most urgent first."""

    INTERACTIVE_HIGH = "INTERACTIVE_HIGH"
    INTERACTIVE_LOW = "INTERACTIVE_LOW"
    DATA_HIGH = "DATA_HIGH"
    DATA = "DATA"
    DATA_LOW = "DATA_LOW"
    BACKGROUND = "BACKGROUND"


class Lane(Enum):
    """Which thread sends a key: small and urgent things never wait for a grid."""

    STREAM = "stream"
    MAP = "map"


@dataclass(frozen=True, slots=True)
class Topic:
    """One row of the table.

    pattern: below the base, names in angle brackets.  payload: ROS 2 type or JSON schema name.  cached: a late
    AdvancedSubscriber receives the last value at once.  every_value: values queue up in order (a bounded queue)
    instead of the newest replacing the one before it.
    """

    pattern: str
    payload: str
    encoding: str
    rate: str
    meaning: str
    priority: Priority = Priority.DATA
    express: bool = False
    cached: bool = False
    lane: Lane = Lane.STREAM
    every_value: bool = False

    @property
    def is_cdr(self) -> bool:
        """The payload is a ROS 2 message."""
        return self.encoding.startswith("application/cdr")

    def matches(self, suffix: str) -> bool:
        """Whether a key below the base belongs to this row."""
        return _pattern_regex(self.pattern).fullmatch(suffix) is not None


def _pattern_regex(pattern: str) -> re.Pattern[str]:
    parts = ("[a-z0-9_-]+" if part.startswith("<") else re.escape(part) for part in pattern.split("/"))
    return re.compile("/".join(parts))


def cdr(ros_type: str) -> str:
    """The Zenoh encoding of a ROS 2 message, e.g. application/cdr;sensor_msgs/msg/LaserScan."""
    return f"application/cdr;{ros_type}"


LASER_SCAN = "sensor_msgs/msg/LaserScan"
CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
RANGE = "sensor_msgs/msg/Range"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
GRID = "nav_msgs/msg/OccupancyGrid"
GRID_UPDATE = "map_msgs/msg/OccupancyGridUpdate"
TF = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

SCAN = Topic(
    "scan/<sensor>",
    LASER_SCAN,
    cdr(LASER_SCAN),
    "as measured",
    "One sweep of a laser, in the frame named like the sensor.",
    Priority.INTERACTIVE_HIGH,
    express=True,
)
CLOUD = Topic(
    "cloud/<mount>",
    CLOUD_TYPE,
    cdr(CLOUD_TYPE),
    "once a nod or turn",
    "What a nodding or turning laser saw, in base_link; if configured.",
    Priority.DATA_LOW,
    lane=Lane.MAP,
)
RANGES = Topic(
    "range/<sensor>",
    "umfeld.ranges.v1",
    JSON_RANGES,
    "as measured",
    "One round of an ultrasonic chain: every transducer with its pose, cone and range.",
    Priority.INTERACTIVE_HIGH,
    express=True,
)
RANGE_ONE = Topic(
    "range/<sensor>/<transducer>",
    RANGE,
    cdr(RANGE),
    "as measured",
    "The same, one transducer a key (numbered from 1 in the order of the chain), as ROS 2 knows it.",
    Priority.INTERACTIVE_HIGH,
    express=True,
)
POLAR = Topic(
    "sectors/polar/<name>",
    "umfeld.sectors.v1",
    JSON_SECTORS,
    "per reading, 10 to 40 Hz",
    "A polar sector map: nearest obstacle, state and age of every wedge of bearings.",
    Priority.INTERACTIVE_HIGH,
    express=True,
)
RECT = Topic(
    "sectors/rect/<name>",
    "umfeld.sectors.v1",
    JSON_SECTORS,
    "per reading, 10 to 40 Hz",
    "A rectangular sector map: the same for every square around the vehicle.",
    Priority.INTERACTIVE_HIGH,
    express=True,
)
POSE_KEY = Topic(
    "pose",
    POSE,
    cdr(POSE),
    "10 to 40 Hz",
    "The vehicle in the map frame.",
    Priority.DATA_HIGH,
)
ODOM = Topic(
    "odom",
    ODOMETRY,
    cdr(ODOMETRY),
    "as measured",
    "The vehicle in the odom frame, and its speed: by wheels, another estimator, or a laser's own sweeps.",
    Priority.DATA_HIGH,
)
TF_KEY = Topic(
    "tf",
    TF,
    cdr(TF),
    "with pose and odom",
    "Moving transforms: map to odom, odom to base_link.",
    Priority.DATA_HIGH,
    every_value=True,
)
TF_STATIC = Topic(
    "tf/static",
    TF,
    cdr(TF),
    "on change",
    "Fixed transforms: base_link to every sensor.",
    Priority.DATA,
    cached=True,
)
MAP_GRID = Topic(
    "map/grid",
    GRID,
    cdr(GRID),
    "at most 1 Hz, on change",
    "The whole occupancy grid. Attachment: its epoch.",
    Priority.DATA_LOW,
    cached=True,
    lane=Lane.MAP,
)
MAP_GRID_UPDATE = Topic(
    "map/grid/update",
    GRID_UPDATE,
    cdr(GRID_UPDATE),
    "at most 5 Hz, pieces of at most 32 KB",
    "A changed rectangle. Attachment: the epoch of the full grid it changes, and its number.",
    Priority.DATA,
    lane=Lane.MAP,
    every_value=True,
)
MAP_LOCAL = Topic(
    "map/local",
    GRID,
    cdr(GRID),
    "at most 5 Hz, on change",
    "A small grid around the vehicle that forgets what it leaves behind, always whole; if configured.",
    Priority.DATA_LOW,
    cached=True,
    lane=Lane.MAP,
)
MAP_ARTOS = Topic(
    "map/artos",
    GRID,
    cdr(GRID),
    "at most 5 Hz, on change",
    "The two-step map made from sector maps, always whole; if configured.",
    Priority.DATA_LOW,
    cached=True,
    lane=Lane.MAP,
)
MAP_CLEARANCE = Topic(
    "map/clearance",
    GRID,
    cdr(GRID),
    "at most 1 Hz, on change",
    "How near the next obstacle is, as a cost: 100 on it, evenly down to 0 at `reach_m`; if configured.",
    Priority.DATA_LOW,
    cached=True,
    lane=Lane.MAP,
)
MAP_LINES = Topic(
    "map/lines",
    "umfeld.lines.v1",
    JSON_LINES,
    "at most 1 Hz, on change",
    "Walls as straight lines with their uncertainty.",
    Priority.DATA_LOW,
    cached=True,
    lane=Lane.MAP,
)
MAP_SCENES = Topic(
    "map/scenes",
    "umfeld.scenes.v1",
    JSON_SCENES,
    "at most every 5 s, on change",
    "Scenes that can be recognised again: how many, and the newest.",
    Priority.DATA_LOW,
    cached=True,
    lane=Lane.MAP,
)
CALIBRATION = Topic(
    "calibration",
    "umfeld.calibration.v1",
    JSON_CALIBRATION,
    "at most every 10 s, on change",
    "What the wheels and the mounts of lasers really are, by the drive so far, beside what is configured.",
    Priority.BACKGROUND,
    cached=True,
    lane=Lane.MAP,
)
MAP_GRAPH = Topic(
    "map/graph",
    "umfeld.graph.v1",
    JSON_GRAPH,
    "at most 1 Hz, on change",
    "Where the robot came along, and which places it saw again; from a daemon that does SLAM.",
    Priority.DATA_LOW,
    cached=True,
    lane=Lane.MAP,
)
LOCALISATION = Topic(
    "localisation",
    "umfeld.localisation.v1",
    JSON_LOCALISATION,
    "at most 5 Hz",
    "Whether the robot knows its place in a given map: lost, searching or sure, how probable, and the candidates.",
    Priority.DATA_HIGH,
    cached=True,
)
MAP_PLANES = Topic(
    "map/planes",
    "umfeld.planes.v1",
    JSON_PLANES,
    "at most 1 Hz, with each cloud",
    "Planes of the newest cloud of each mount: walls, floor, table tops, with their outlines.",
    Priority.DATA_LOW,
    cached=True,
    lane=Lane.MAP,
)
MAP_ELEVATION = Topic(
    "map/elevation",
    "umfeld.elevation.v1",
    JSON_ELEVATION,
    "at most 1 Hz, with each cloud",
    "Heights, slope, steps and roughness of the ground around the vehicle, and where it can be driven on.",
    Priority.DATA_LOW,
    cached=True,
    lane=Lane.MAP,
)
MAP_TOPO = Topic(
    "map/topo",
    "umfeld.topo.v1",
    JSON_TOPO,
    "at most every 5 s, on change",
    "Regions of free space and passages, or places and the ways driven, or places and hallways; if configured.",
    Priority.DATA_LOW,
    cached=True,
    lane=Lane.MAP,
)
MAP_ROOMS = Topic(
    "map/rooms",
    "umfeld.rooms.v1",
    JSON_ROOMS,
    "at most every 5 s, seldomer on large maps, on change",
    "Rooms of the grid with ids and names that stay, and the doors between them; where a laser draws the grid.",
    Priority.DATA_LOW,
    cached=True,
    lane=Lane.MAP,
)
MAP_PLAN = Topic(
    "map/plan",
    "umfeld.plan.v1",
    JSON_PLAN,
    "after each answered `@rpc/plan`",
    "The way last planned, and its alternatives: what the caller was told.",
    Priority.DATA_LOW,
    cached=True,
    lane=Lane.MAP,
)
MAP_AGREEMENT = Topic(
    "map/agreement",
    "umfeld.agreement.v1",
    JSON_AGREEMENT,
    "at most every 2 s, on change",
    "Where the grid, the lines, the rooms and the regions contradict each other, counted by kind.",
    Priority.DATA_LOW,
    cached=True,
    lane=Lane.MAP,
)
HEALTH = Topic(
    "health",
    DIAGNOSTICS,
    cdr(DIAGNOSTICS),
    "1 Hz and on change",
    "State of the daemon and of every device, in words.",
    cached=True,
)
HEALTH_JSON = Topic(
    "health/json",
    "umfeld.health.v1",
    JSON_HEALTH,
    "1 Hz and on change",
    "The same as JSON, with every counter.",
    cached=True,
)
HEALTH_ONE = Topic(
    "health/<sensor>",
    DIAGNOSTICS,
    cdr(DIAGNOSTICS),
    "1 Hz and on change",
    "State of one device.",
    cached=True,
)
INFO = Topic(
    "info",
    "umfeld.info.v1",
    JSON_INFO,
    "at start and on change",
    "Who speaks: version, frames, sensors and where they sit, every key with its encoding and rate.",
    Priority.DATA_LOW,
    cached=True,
)
ALIVE = "alive"
"""The liveliness token below the base: there while the daemon is, gone at once when it ends."""

DAEMON = "@daemon"
"""The chunk before each daemon's own liveliness token: its Zenoh id, host and process."""

RPC = "@rpc"
"""The chunk before the names of calls. `*` and `**` never match it, so a wildcard get() calls nothing."""

TOPICS: tuple[Topic, ...] = (
    SCAN,
    CLOUD,
    RANGES,
    RANGE_ONE,
    POLAR,
    RECT,
    POSE_KEY,
    ODOM,
    TF_KEY,
    TF_STATIC,
    MAP_GRID,
    MAP_GRID_UPDATE,
    MAP_LOCAL,
    MAP_ARTOS,
    MAP_CLEARANCE,
    MAP_LINES,
    MAP_SCENES,
    CALIBRATION,
    MAP_GRAPH,
    LOCALISATION,
    MAP_PLANES,
    MAP_ELEVATION,
    MAP_TOPO,
    MAP_ROOMS,
    MAP_PLAN,
    MAP_AGREEMENT,
    HEALTH,
    HEALTH_JSON,  # before health/<sensor>: the exact key wins
    HEALTH_ONE,
    INFO,
)

RESERVED_SENSOR_NAMES = frozenset({"json"})
"""A device of this name would collide with health/json."""


def topic_of(suffix: str) -> Topic:
    """The row of a key below the base; KeyError if the table has none."""
    for topic in TOPICS:
        if topic.matches(suffix):
            return topic
    raise KeyError(f"no topic for the key {suffix!r}: add it to service/topics.py")


def check_base(base: str) -> str:
    """The base as it is; ValueError names what is wrong with it."""
    if not base or not all(_CHUNK.match(chunk) for chunk in base.split("/")):
        raise ValueError(
            f"key base {base!r}: chunks of lower-case letters, digits, _ and - joined by /, such as robots/artos"
        )
    return base


def markdown_table() -> str:
    """The table for docs/keys.md."""
    lines = [
        "| key below `robots/<id>/` | payload | encoding | rate | priority | cached | meaning |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for topic in TOPICS:
        priority = topic.priority.value + (", express" if topic.express else "")
        cached = "last value" if topic.cached else "no"
        lines.append(
            f"| `{topic.pattern}` | {topic.payload} | `{topic.encoding}` | {topic.rate} | {priority} | {cached}"
            f" | {topic.meaning} |"
        )
    lines.append(f"| `{ALIVE}` | | | | | liveliness token | There while the daemon is; gone at once when it ends. |")
    lines.append(
        f"| `{DAEMON}/<zenoh id>/<host>/<process>` | | | | | liveliness token"
        " | Of each daemon, so that two of one id are noticed. `*` and `**` never match it. |"
    )
    lines.append(
        f"| `{RPC}/<name>` | JSON in, JSON out | `{JSON_REPLY}` | | | no"
        " | Calls, by get() with a payload. `*` and `**` never match them. |"
    )
    return "\n".join(lines) + "\n"
