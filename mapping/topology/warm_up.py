"""Load or compile every kernel of the topological maps: a first call takes up to some seconds."""

from __future__ import annotations

import numpy as np

from mapping.topology.nearest import FLAT_BELOW
from mapping.topology.neural_gas import FritzkeGas, FritzkeRules, GasRules, NeuralGas


def warm_up() -> None:
    """Learn enough vectors for every way of searching."""
    scenes = np.linspace(0.0, 1.0, 2 * FLAT_BELOW)[:, None].repeat(2, axis=1)
    gas = NeuralGas(2, GasRules(new_node_distance=1e-3))
    fritzke = FritzkeGas(2, FritzkeRules(max_nodes=3))
    for scene in scenes:
        gas.learn(scene)
        fritzke.learn(scene)
    gas.nearest(scenes[0] * [1.0, 0.5])
