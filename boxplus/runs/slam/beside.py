"""What stands beside the odometry of a run with loop closure: local maps and scans on disk, and the loop search."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol

import numpy as np

from boxplus.manifolds import quaternion
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.folder import LocalMapFolder
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.runs.slam.loop_search import Closure, LoopSearch
from boxplus.runs.slam.spool import ScanSpool, SpooledScan, SpoolMark
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate

_MOST_PENDING = 20  # scans that may wait for the thread; then the odometry waits, too


class LoopView(Protocol):
    """Something that shows loops as they close."""

    def show_loops(self, closure: Closure) -> None:
        """Show where the local maps are now, and the loops between them."""


class Beside:
    """Sees every estimate of the odometry (a `Companion` of its run): cuts local maps, keeps scans to be placed anew.

    A thread of its own does so, scan by scan in their order, so that the next scan does not wait for a local map to be cut.

    Args:
        config: how local maps are cut; maps: where they go.
        has_gravity: the odometry knows where down is; without an IMU the surfaces have to tell.
        spool: where scans go; None keeps none.
        search: told of every local map.
        view: shown loops; None shows none.
    """

    def __init__(
        self,
        config: LocalMapConfig,
        maps: LocalMapFolder,
        spool: ScanSpool | None,
        search: LoopSearch,
        view: LoopView | None,
        *,
        has_gravity: bool = True,
    ) -> None:
        self._builder, self._has_gravity = LocalMapBuilder(config), has_gravity
        self._maps, self._spool, self._search, self._view = maps, spool, search, view
        self._count = 0
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="boxplus-local-maps")
        self._pending: deque[Future[None]] = deque()

    def show(self, estimate: Estimate) -> None:
        """See `View`.

        Raises:
            OutputError: the disk is full, found out for this scan or one before.
            BoxplusError: the loop search has failed.
        """
        self._wait(_MOST_PENDING)
        self._pending.append(self._thread.submit(self._keep, estimate))
        closure = self._search.poll()
        if closure is not None and self._view is not None:
            self._view.show_loops(closure)

    def _wait(self, most: int) -> None:
        """Until at most so many scans are waiting."""
        while self._pending and (len(self._pending) > most or self._pending[0].done()):
            self._pending.popleft().result()

    def _keep(self, estimate: Estimate) -> None:
        state = estimate.state
        T_odo_imu = np.concatenate([quaternion.from_matrix(state.R_world_imu), state.p_world_imu])
        # The odometry's error of the position is along the world's axes; that of SE(3) is along the body's.
        turn = np.eye(6)
        turn[3:, 3:] = state.R_world_imu.T
        p_imu = (estimate.p_lidar @ state.R_imu_lidar.T.astype(np.float32) + state.p_imu_lidar.astype(np.float32)).astype(
            np.float32
        )
        if estimate.status == "lost":  # nobody knows where its points belong
            p_imu = p_imu[:0]
        covariance = turn @ estimate.pose_covariance @ turn.T
        up = -state.gravity_world if self._has_gravity else None
        made = self._builder.push(estimate.time_ns, T_odo_imu, 0.5 * (covariance + covariance.T), p_imu, up)
        if self._spool is not None and len(p_imu):
            self._spool.append(SpooledScan(estimate.time_ns, T_odo_imu, p_imu, estimate.intensity, estimate.lidar))
        self._take(made)

    def _take(self, made: Iterable[LocalMap]) -> None:
        for local_map in made:
            self._maps.write(local_map)
            self._search.give(local_map.number)
            self._count += 1
            if self._spool is not None:
                self._spool.forget()

    def snapshot(self) -> dict[str, object]:
        """See `Companion`."""
        self._wait(0)
        mark = None if self._spool is None else list(self._spool.mark())
        return {"builder": self._builder, "maps": self._count, "spool": mark}

    def restore(self, state: dict[str, Any]) -> None:
        """See `Companion`."""
        self._builder = state["builder"]
        if self._spool is not None:
            self._spool.cut(SpoolMark(*state["spool"]))
        self.give_again(state["maps"])

    def give_again(self, count: int) -> None:
        """Tell the loop search, which begins anew with every process, of the local maps that are there."""
        for number in range(count):
            self._search.give(number)
        self._count = count

    def finish(self) -> None:
        """See `Companion`."""
        self._wait(0)
        self._take(self._builder.flush())
        if self._spool is not None:
            self._spool.mark()

    def close(self) -> None:
        """End the thread; safe to call twice."""
        self._thread.shutdown(wait=True, cancel_futures=True)
