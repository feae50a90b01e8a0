"""ALICE from bytes to map against the truth: twenty simulated minutes, 2 % drift of heading (S43)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from drivers.alice import AliceConversation
from drivers.readings import RingReading
from mapping.topology.alice import AliceMap, AliceRules
from sim_devices.alice import Alice

STEP_NS = 50_000_000
START = (1.0, 1.0)


@dataclass
class Drive:
    """What came of one."""

    topo: AliceMap
    robot: Alice
    truth: dict[int, list[tuple[float, float]]] = field(default_factory=dict)
    false_units: set[int] = field(default_factory=set)

    def errors_m(self) -> list[float]:
        """Of every unit, published or not: its place against the mean of where the robot truly met it."""
        return [math.dist(self.topo.position_m(n), np.mean(met, axis=0)) for n, met in self.truth.items()]


def drive(rules: AliceRules, *, minutes: float, false_looks: float, seed: int) -> Drive:
    robot, wire = Alice(seed=seed, false_looks=false_looks, drift_rad_per_m=0.02), AliceConversation()
    wire.connected(0)
    result = Drive(AliceMap(rules), robot)
    before: RingReading | None = None
    for now in range(STEP_NS, round(minutes * 60e9) + 1, STEP_NS):
        wire.requests(now)
        for reading in wire.receive(robot.step(now, b""), now):
            assert isinstance(reading, RingReading)
            way = (0.0, 0.0)
            if before is not None and reading.continuous:
                way = (reading.ahead_m - before.ahead_m, reading.left_m - before.left_m)
            before = reading
            known = len(result.topo)
            unit = result.topo.look(reading.light, reading.touch.astype(np.float64), way)
            result.truth.setdefault(unit, []).append((robot.x_m - START[0], robot.y_m - START[1]))
            if wire.counters.readings - 1 in robot.false_sequences and unit >= known:
                result.false_units.add(unit)
    assert wire.counters.drops == {}
    return result


def test_twenty_minutes_with_drift_and_false_looks() -> None:
    result = drive(AliceRules(), minutes=20.0, false_looks=0.01, seed=1)
    graph = result.topo.graph()
    assert len(graph.nodes) > 60
    assert len(graph.edges) > 60
    published = {node.number for node in graph.nodes}
    errors = [math.dist(result.topo.position_m(n), np.mean(result.truth[n], axis=0)) for n in published]
    assert float(np.median(errors)) < 0.3
    assert float(np.median(result.errors_m())) < 0.3
    assert len(result.robot.false_sequences) > 30
    assert len(result.false_units) > 30  # each became a unit of its own
    assert not published & result.false_units
    assert not any({a, b} & result.false_units for a, b, _, _ in graph.edges)
    lengths = [
        math.dist(np.mean(result.truth[a], axis=0), np.mean(result.truth[b], axis=0)) for a, b, *_ in graph.edges
    ]
    assert float(np.median(lengths)) < 0.5  # ways join places that lie beside each other


def test_without_the_light_positions_are_lost() -> None:
    result = drive(AliceRules(correct_heading=False), minutes=20.0, false_looks=0.0, seed=1)
    assert float(np.median(result.errors_m())) > 1.0
