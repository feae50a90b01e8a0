"""The forms that labelled maps are shown in are those maps."""

from __future__ import annotations

import numpy as np
import pytest

from bench.rooms_forms import FORMS, LATER, Form, drawn_as, gaps, salted, smoothed

RANDOM = np.random.default_rng(4)
FREE = np.kron(RANDOM.random((12, 17)) < 0.6, np.ones((9, 9))).astype(np.bool_)
TRUTH = np.where(FREE, np.arange(FREE.shape[1]) // 30 + 1, 0).astype(np.int32)


def test_a_map_as_it_is_is_itself_and_turned_by_right_angles_too() -> None:
    for share in (0.0, 0.5, 0.8):
        for quarters in range(4):
            free, truth = drawn_as(Form(turn_deg=90.0 * quarters, share=share), FREE, TRUTH, 1)
            assert any(np.array_equal(free, np.rot90(FREE, k)) and np.array_equal(truth, np.rot90(TRUTH, k))
                       for k in (quarters, -quarters))  # fmt: skip
    free, truth = drawn_as(FORMS["mirrored"], FREE, TRUTH, 1)
    assert np.array_equal(free, FREE[:, ::-1])
    assert np.array_equal(truth, TRUTH[:, ::-1])


@pytest.mark.parametrize("name", [*FORMS, *LATER])
def test_every_form_keeps_area_and_labels_to_a_few_per_cent(name: str) -> None:
    form = {**FORMS, **LATER}[name]
    free, truth = drawn_as(form, FREE, TRUTH, 1)
    assert free.shape == truth.shape
    assert free.sum() * form.cell_m**2 == pytest.approx(FREE.sum() * 0.05**2, rel=0.15)
    assert (free & (truth > 0)).sum() > 0.93 * free.sum()
    assert set(np.unique(truth)) == set(np.unique(TRUTH))
    again, _ = drawn_as(form, FREE, TRUTH, 1)
    assert np.array_equal(free, again)


def test_noise_turns_single_cells_gaps_and_smoothing_only_free_some() -> None:
    wide = np.zeros((200, 300), dtype=np.bool_)
    wide[10:190, 10:148] = wide[10:190, 152:290] = True
    noisy, cracked = salted(wide, np.random.default_rng(1)), gaps(wide, np.random.default_rng(1))
    assert 0 < (noisy != wide).sum() < 0.01 * wide.size
    assert not (wide & ~cracked).any()
    opened = cracked & ~wide
    assert 4 <= opened.sum() < 200
    assert opened[:, 148:152].sum() == opened.sum()  # through the wall between, not out of the map
    bumped = wide.copy()
    bumped[10, 50] = bumped[100, 60] = False
    assert np.array_equal(smoothed(bumped, np.random.default_rng(1)), wide)
