"""What the local maps of a session look like, and their surfaces: made once, met by many other sessions."""

from __future__ import annotations

import numpy as np

from boxplus._extras import require
from boxplus.manifolds import se3
from boxplus.maps.descriptors.features import Features
from boxplus.maps.descriptors.place_index import PlaceIndex
from boxplus.maps.descriptors.scan_context import ScanContext, ScanContextIndex, scan_context
from boxplus.maps.local_maps.registration import Surface, surface_distance
from boxplus.systems.sessions.session import Session
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.proposals import Proposal, described, seen, turned

_KEPT_SURFACES = 48  # trees over local maps are built again where they are older
_CONTEXTS = 3  # places looked at that have a similar scan context


class Places:
    """A session that can be recognised, and that recognises.

    Args:
        session: its local maps.
        config: how they are described.

    Raises:
        InputError: OpenCV, the extra `vision`, is not installed and density images are wanted.
    """

    def __init__(self, session: Session, config: SlamConfig) -> None:
        if config.appearance == "density":
            require("cv2", "which describes density images")
        self.session, self._config = session, config
        self.chain = session.chain()
        self.features: list[Features] = []
        self._contexts: list[ScanContext] = []
        self._densities, self._context_index = PlaceIndex(config.descriptor), ScanContextIndex()
        for local_map in session.maps:
            if config.appearance == "density":
                self.features.append(described(local_map, config))
                self._densities.add(self.features[-1])
            if config.appearance != "none":
                self._contexts.append(scan_context(local_map.points, config.context_range))
                self._context_index.add(self._contexts[-1])
        self._surfaces: dict[int, Surface] = {}
        self._rms: dict[int, float] = {}

    def __len__(self) -> int:
        return len(self.session.maps)

    def proposals(self, query: Places, number: int) -> list[Proposal]:
        """Where local map `number` of another session may be in this one, by what it looks like."""
        if not len(query.session.maps[number].points):
            return []
        found: list[Proposal] = []
        if self._config.appearance == "density":
            found = [seen(candidate) for candidate in self._densities.candidates(query.features[number], seed=number)]
        if not found and self._config.appearance != "none":
            alike = self._context_index.candidates(query._contexts[number], count=_CONTEXTS)
            maps = query.session.maps[number], self.session.maps
            found = [
                turned(maps[0], maps[1][place], place, yaw, self._config)
                for place, far, yaw in alike
                if far <= self._config.context_distance and len(maps[1][place].points)
            ]
        return found

    def surface(self, number: int) -> Surface:
        """The points of a local map and a tree over them."""
        if number not in self._surfaces:
            if len(self._surfaces) >= _KEPT_SURFACES:
                del self._surfaces[next(iter(self._surfaces))]
            self._surfaces[number] = Surface.of(self.session.maps[number].points)
        return self._surfaces[number]

    def rms(self, number: int) -> float:
        """How well a map fits the one before it: what the odometry's own errors make of surfaces [m]."""
        if number not in self._rms:
            a, b = (0, 1) if number == 0 and len(self) > 1 else (number - 1, number)
            found = None
            if a >= 0:
                T = self.session.T_session_map
                start = se3.compose(se3.inverse(T[a]), T[b])
                found = surface_distance(self.surface(b), self.surface(a), start, self._config.registration)
            self._rms[number] = 0.0 if found is None else found
        return self._rms[number]

    def way(self, first: int, second: int) -> float:
        """Way between two of its maps [m]."""
        return float(np.abs(self.session.maps[second].path_m - self.session.maps[first].path_m))
