"""umfeld bench and what it makes of its measurements."""

from __future__ import annotations

import json

import numpy as np
import pytest

from service.commands import bench

PERIOD = 25_000_000
SWEEP = 19_000_000


@pytest.fixture(scope="module")
def latency() -> object:
    return bench._program("latency")


def scans(count: int) -> tuple[list[int], list[int]]:
    """When scans began, and when their last byte had gone out."""
    began = [10**9 + k * PERIOD for k in range(count)]
    return began, [stamp + SWEEP + 1_000_000 for stamp in began]


def test_each_scan_is_held_against_its_own_last_byte(latency: object) -> None:
    began, ends = scans(100)
    late = [2_000_000 + 1_000_000 * (k % 40) for k in range(100)]  # up to 41 ms: more than a period
    samples = [(end + late[k], began[k]) for k, end in enumerate(ends)]
    found = latency.latencies_ms([0, 5, *ends], samples)  # type: ignore[attr-defined]
    assert found == pytest.approx([each / 1e6 for each in late])


def test_a_map_sent_again_is_not_a_scan_and_a_lost_scan_is_no_latency(latency: object) -> None:
    began, ends = scans(4)
    samples = [
        (ends[0] + 3_000_000, began[0]),
        (ends[0] + 20_000_000, began[0] + 400_000),  # ages are rounded to milliseconds
        (ends[3] + 5_000_000, began[3]),
    ]
    assert latency.latencies_ms(ends, samples) == pytest.approx([3.0, 5.0])  # type: ignore[attr-defined]


@pytest.mark.parametrize("off_ns", [-30_000_000, -11_000_000, 11_000_000, 40_000_000])
def test_a_fit_of_the_clock_that_is_off_moves_no_scan_to_another(latency: object, off_ns: int) -> None:
    began, ends = scans(50)
    late = [2_000_000 + 1_000_000 * (7 * k % 30) for k in range(50)]
    samples = [(end + late[k], stamp + off_ns + 10_000 * k) for k, (end, stamp) in enumerate(zip(ends, began))]
    found = latency.latencies_ms(ends, samples)  # type: ignore[attr-defined]
    assert found == pytest.approx([each / 1e6 for each in late])


def test_no_last_byte_counts_twice(latency: object) -> None:
    began, ends = scans(3)
    samples = [(ends[0] + 2_000_000, began[0]), (ends[0] + 9_000_000, began[0] + 12_600_000)]
    assert latency.latencies_ms(ends, samples) == pytest.approx([2.0])  # type: ignore[attr-defined]


def test_percentiles_are_of_what_was_measured(latency: object) -> None:
    values = [float(v) for v in range(1, 101)]
    assert latency.percentile(values, 0.5) == 51.0  # type: ignore[attr-defined]
    assert latency.percentile(values, 0.99) == 100.0  # type: ignore[attr-defined]


def test_figures_of_numpy_become_json() -> None:
    kept = bench._figure("x", np.float64(1.5), "us", 2.0)
    missed = bench._figure("x", np.float64(2.5), "us", 2.0)
    assert json.loads(json.dumps([kept, missed])) == [
        {"name": "x", "value": 1.5, "unit": "us", "budget": 2.0, "ok": True},
        {"name": "x", "value": 2.5, "unit": "us", "budget": 2.0, "ok": False},
    ]
    assert bench.machine()["cores"]
