"""Local maps on disk: the same bits back, the same bytes again, and damage is named."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.maps.local_maps.folder import LocalMapFolder
from boxplus.maps.local_maps.local_map import LocalMap


def some_map(number: int) -> LocalMap:
    random = np.random.default_rng(number)
    points = random.normal(0.0, 9.0, (50 * number, 3)).astype(np.float32)
    T = np.concatenate([[0.6, 0.0, 0.0, 0.8], random.normal(size=3)])
    return LocalMap(number, 10**18 + number, 10**18, 10**18 + 9, T, np.eye(6) * 0.1, 0.1 * number, points, 7, number != 3)


def test_maps_come_back_as_they_were(tmp_path: Path) -> None:
    folder = LocalMapFolder(tmp_path / "maps")
    assert len(folder) == 0
    for number in (0, 1, 3):
        folder.write(some_map(number))
    assert len(folder) == 2  # number 2 is missing
    before = folder.file(3).read_bytes()
    folder.write(some_map(3))
    assert folder.file(3).read_bytes() == before
    for number in (0, 1, 3):
        expected, found = some_map(number), folder[number]
        for field in fields(LocalMap):
            one, other = getattr(found, field.name), getattr(expected, field.name)
            assert np.array_equal(one, other) and np.asarray(one).dtype == np.asarray(other).dtype, field.name


def test_what_is_no_map_is_named(tmp_path: Path) -> None:
    folder = LocalMapFolder(tmp_path)
    folder.write(some_map(1))
    for number, spoil in ((0, lambda file: None), (1, lambda file: file.write_bytes(file.read_bytes()[:-200]))):
        spoil(folder.file(number))
        with pytest.raises(InputError, match=rf"expected a local map .version 2 .*{number:06d}.npz"):
            folder[number]
    folder.write(some_map(1))
    folder.file(1).rename(folder.file(2))
    with pytest.raises(InputError, match=r"000002.npz: arrays of another shape, or another number"):
        folder[2]
