"""Images of a world without noise: what light falls on every pixel, and how far away it comes from."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from boxplus.simulation.cameras.raster import NOTHING, SURFACE_WIDTH, TILE, cast_pixels, list_solids, shade_pixels
from boxplus.simulation.cameras.sensor import CameraSensor
from boxplus.simulation.cameras.textures import KINDS, OFFSETS, SIDE, texture_pyramids
from boxplus.simulation.worlds.raycast import REFLECTIVITY
from boxplus.simulation.worlds.world import Solid, World

Floats = NDArray[np.float64]

FARTHEST_M = 2000.0


class Surfaces:
    """What the surfaces of a world look like; the same for every camera.

    Args:
        world: the solids.
        seed: of the pictures and of which solid bears which.
        pixel_m: side of a pixel of the pictures on the surfaces [m]; what is finer than that is smooth.
        contrast: 1 as usual, 0 for surfaces of one shade.
    """

    def __init__(self, world: World, seed: int = 0, pixel_m: float = 0.005, contrast: float = 1.0) -> None:
        self.solids = world.solids
        self.pixels_per_m = 1.0 / pixel_m
        self.pyramids = texture_pyramids(seed)
        self._seed, self._contrast = seed, contrast
        self.rows = self._rows(world.solids, 0)

    def _rows(self, solids: Floats, stream: int) -> Floats:
        random = np.random.Generator(np.random.PCG64([self._seed, 310 + stream]))
        count = len(solids)
        rows = np.empty((count, SURFACE_WIDTH))
        rows[:, 0] = random.integers(0, KINDS, count)
        rows[:, 1:3] = random.uniform(0.0, SIDE, (count, 2))
        rows[:, 3] = 0.22 + 0.55 * solids[:, REFLECTIVITY]
        rows[:, 4] = self._contrast * random.uniform(0.75, 0.95, count)
        angle = random.uniform(-0.5, 0.5, count) + 0.5 * np.pi * random.integers(0, 4, count)
        rows[:, 5], rows[:, 6] = np.cos(angle), np.sin(angle)
        return rows

    def with_movers(self, movers: Sequence[Solid]) -> tuple[Floats, Floats]:
        """Solids (S, 18) and surfaces (S, SURFACE_WIDTH) with further solids behind those of the world."""
        if not len(movers):
            return self.solids, self.rows
        added = np.stack(list(movers))
        rows = self._rows(added, 1)
        rows[:, 4] = 0.9  # something that moves is seen, whatever the walls are
        return np.concatenate([self.solids, added]), np.concatenate([self.rows, rows])


class Renderer:
    """One camera in a world.

    Args:
        sensor: lens, size, sharpness.
        surfaces: of the world.
    """

    def __init__(self, sensor: CameraSensor, surfaces: Surfaces) -> None:
        self.sensor, self._surfaces = sensor, surfaces
        model = sensor.lens.model()
        v, u = np.mgrid[-1 : sensor.height + 1, -1 : sensor.width + 1].astype(np.float64)
        bearings, found = model.bearings(np.stack([u, v], axis=-1))
        bearings = np.where(found[..., None], bearings, 0.0)
        inner = (slice(1, -1), slice(1, -1))
        self._directions = np.ascontiguousarray(bearings[inner])
        self._right = np.ascontiguousarray(0.5 * (bearings[1:-1, 2:] - bearings[1:-1, :-2]))
        self._down = np.ascontiguousarray(0.5 * (bearings[2:, 1:-1] - bearings[:-2, 1:-1]))
        whole = found[inner] & found[1:-1, 2:] & found[1:-1, :-2] & found[2:, 1:-1] & found[:-2, 1:-1]
        self._directions[~whole] = 0.0
        self.seen: NDArray[np.bool_] = whole
        """(H, W) pixels at which the lens shows something."""
        across, along = math.ceil(sensor.width / TILE), math.ceil(sensor.height / TILE)
        self._tiles = np.empty((2, across * along), np.uint32)
        self._tile_solids, self._tile_near = np.empty(64 * across * along, np.uint32), np.empty(64 * across * along)

    def _cast(self, R: Floats, p: Floats, solids: Floats) -> tuple[Floats, NDArray[np.uint32]]:
        scratch = np.empty(len(solids), np.uint32)
        while True:
            lists = (self._tiles[0], self._tiles[1], self._tile_solids, self._tile_near)
            needed = list_solids(self._directions, R, p, solids, *lists, scratch)
            if needed <= len(self._tile_solids):
                break
            self._tile_solids, self._tile_near = np.empty(2 * needed, np.uint32), np.empty(2 * needed)
        ranges, faces = np.empty(self.seen.shape), np.empty(self.seen.shape, np.uint32)
        cast_pixels(self._directions, R, p, solids, *lists, FARTHEST_M, ranges, faces)
        return ranges, faces

    def radiance(
        self, R_world_camera: Floats, p_world_camera: Floats, movers: Sequence[Sequence[Solid]] = ()
    ) -> NDArray[np.float32]:
        """Mean light (H, W) over the instants of an exposure; white in the light of day is about one.

        Args:
            R_world_camera, p_world_camera: (N, H, 3, 3), (N, H, 3) [m] poses of the camera, for N instants and every row.
            movers: for each instant, what else there is in the world.
        """
        total = np.zeros(self.seen.shape, np.float32)
        for n, (R, p) in enumerate(zip(R_world_camera, p_world_camera, strict=True)):
            R, p = np.ascontiguousarray(R), np.ascontiguousarray(p)
            solids, rows = self._surfaces.with_movers(movers[n] if len(movers) else ())
            ranges, faces = self._cast(R, p, solids)
            shade_pixels(
                self._directions, self._right, self._down, R, p, solids, rows, self._surfaces.pyramids, OFFSETS,
                self._surfaces.pixels_per_m, self._tiles[0], self._tiles[1], self._tile_solids, self._tile_near, FARTHEST_M,
                ranges, faces, total,
            )  # fmt: skip
        total /= len(R_world_camera)
        if self.sensor.sharpness_px > 0.0:
            total = gaussian_filter(total, self.sensor.sharpness_px, mode="nearest", truncate=3.0)
        return total

    def depth(self, R_world_camera: Floats, p_world_camera: Floats, movers: Sequence[Solid] = ()) -> Floats:
        """Exact depths along the optical axis (H, W) [m] at the pixels' centres, infinite where there is nothing.

        Args:
            R_world_camera, p_world_camera: (H, 3, 3), (H, 3) [m] pose of the camera for every row.
            movers: what else there is in the world.
        """
        solids, _ = self._surfaces.with_movers(movers)
        ranges, _ = self._cast(np.ascontiguousarray(R_world_camera), np.ascontiguousarray(p_world_camera), solids)
        with np.errstate(invalid="ignore"):
            depths = ranges * self._directions[..., 2]
        depths[~(np.isfinite(ranges) & self.seen)] = np.inf
        return depths


__all__ = ["FARTHEST_M", "NOTHING", "Renderer", "Surfaces"]
