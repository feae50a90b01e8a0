"""Load or compile every kernel of the feature maps before a device is opened: a first call takes up to some seconds."""

from __future__ import annotations

import numpy as np

from mapping.features.anchors import AnchorFinder
from mapping.features.graph import anchor_graph, compare
from mapping.features.histograms import square_scene
from mapping.features.range_image import segment_ranges


def warm_up() -> None:
    """Look at an empty room and recognise it."""
    bearing = np.linspace(-np.pi, np.pi, 180, endpoint=False)
    ranges = 2.0 / np.maximum(np.abs(np.cos(bearing)), np.abs(np.sin(bearing)))
    segment_ranges(ranges)
    square_scene(np.stack((ranges * np.cos(bearing), ranges * np.sin(bearing)), axis=-1))
    graph = anchor_graph(AnchorFinder(bearing).find(ranges))
    compare(graph, graph)
