"""The ROS 2 side against an independent client of rmw_zenoh's protocol (PyPI zenoh-ros2-sdk), where installed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from mapping.scan import Scan
from service.clock import SystemClock
from service.outputs import GridOut, HealthOut, OdomOut, PoseOut, ScanOut
from service.publisher import Publisher
from service.ros import RosSettings
from service.zenoh_session import NetworkSettings
from tests.waiting import GIVE_UP_S, free_port

ROS_SIDE = """
import json, sys, threading, time
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Subscriber
from zenoh_ros2_sdk.qos import QosProfile, QosDurability
from zenoh_ros2_sdk.discovery import get_topic_names_and_types

port, wanted = int(sys.argv[1]), json.loads(sys.argv[2])
store = get_typestore(Stores.ROS2_JAZZY)
seen, lock = {}, threading.Lock()

def taker(topic):
    def take(message):
        with lock:
            seen.setdefault(topic, message)
    return take

def stamp(message):
    header = message.transforms[0].header if hasattr(message, "transforms") else message.header
    return [header.frame_id, header.stamp.sec > 1_000_000_000]

subscribers = []
for topic, kind in wanted.items():
    text = store.generate_msgdef(kind, ros_version=2)[0]
    late = QosProfile(durability=QosDurability.TRANSIENT_LOCAL) if topic == "/map" else None
    subscribers.append(ROS2Subscriber(topic, kind, taker(topic), msg_definition=text, router_port=port, qos=late,
                                      type_hash=store.hash_rihs01(kind), domain_id=0))
end = time.monotonic() + 60
while time.monotonic() < end and len(seen) < len(wanted):
    time.sleep(0.02)
result = {topic: stamp(message) for topic, message in seen.items()}
if "/map" in seen:
    result["cells"] = seen["/map"].data.tolist()
if "/scan" in seen:
    result["ranges"] = seen["/scan"].ranges.tolist()
names = dict(get_topic_names_and_types(domain_id=0, router_port=port))
print(json.dumps({"seen": result, "topics": names}), flush=True)
import os
os._exit(0)
"""

WANTED = {
    "/scan": "sensor_msgs/msg/LaserScan",
    "/map": "nav_msgs/msg/OccupancyGrid",
    "/odom": "nav_msgs/msg/Odometry",
    "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


@pytest.mark.skipif(find_spec("zenoh_ros2_sdk") is None, reason="needs zenoh-ros2-sdk from PyPI")
def test_an_independent_ros_client_sees_everything(tmp_path: Path) -> None:
    port = free_port()
    script = tmp_path / "ros_side.py"
    script.write_text(ROS_SIDE)
    network = NetworkSettings(listen=(f"tcp/127.0.0.1:{port}",))
    clock = SystemClock()
    publisher = Publisher("robots/r1", network, clock=clock, ros=RosSettings(lasers=("front",)))
    publisher.start()
    publisher.offer(GridOut(clock.now_ns(), 1, GridPatch(0.05, 0, 0, np.array([[0, 100], [-1, 50]], np.int8))))
    environment = {**os.environ, "HOME": str(tmp_path)}
    process = subprocess.Popen(
        [sys.executable, str(script), str(port), json.dumps(WANTED)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        while process.poll() is None:
            now = clock.now_ns()
            scan = Scan(now, 0.0, np.linspace(-1, 1, 3), np.array([1.0, 2.5, 4.0]), 0.1, 30.0)
            publisher.offer(ScanOut("front", scan, Pose2(), 0.0))
            publisher.offer(OdomOut(now, Pose2(1, 2, 3), np.eye(3), 0.1, 0.2))
            publisher.offer(PoseOut(now, Pose2(1, 2, 3), Pose2(), np.eye(3)))
            publisher.offer(HealthOut(now, 0, "fine", (), {"sent": 1}, {}))
            try:
                process.wait(0.05)
            except subprocess.TimeoutExpired:
                continue
        out, err = process.communicate()
    finally:
        process.kill()
        assert publisher.close(GIVE_UP_S)
    assert process.returncode == 0, err
    answer = json.loads(out.strip().splitlines()[-1])
    seen = answer["seen"]
    assert set(WANTED) <= set(seen), err
    assert seen["ranges"] == [1.0, 2.5, 4.0]
    assert seen["cells"] == [0, 100, -1, 50]  # published before the subscriber came
    assert all(recent for _frame, recent in (seen[topic] for topic in WANTED))
    assert {topic: [kind] for topic, kind in WANTED.items()}.items() <= answer["topics"].items()
