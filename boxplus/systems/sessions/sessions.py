"""Sessions that do not know of each other in, where they are in one world out. Derivations: docs/sessions.md.

alignment = align_sessions([Session.of("monday", maps, T_session_map), Session.of("friday", …)])
for world in alignment.worlds:            # sessions that met; those that met nobody are a world of their own
    …
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np

from boxplus._arguments import as_settings
from boxplus._chi_square import chi_square_quantile
from boxplus.errors import InputError
from boxplus.manifolds import se3
from boxplus.sparse.graphs.components import connected_components
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.encounter import Encounter, Meeting
from boxplus.systems.sessions.graph import JoinedGraph, join
from boxplus.systems.sessions.meeting import meet
from boxplus.systems.sessions.places import Places
from boxplus.systems.sessions.session import Session
from boxplus.systems.slam.loop import Floats
from boxplus.systems.slam.odometry_chain import mahalanobis

IN_DOUBT = "joined in doubt only: "  # begins why `place_surely` keeps two sessions apart
_START = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class JointWorld:
    """Sessions in one world, whose frame is that of the first of them.

    Attributes:
        members: numbers of the sessions, ascending.
        T_world_session: (s, 7) the session's own frame in the world; covariance: (s, 6, 6) of [w, v] [rad, m] on its right.
        T_world_map: for each session (n, 7), its local maps.
        encounters: what the result rests on, numbers of sessions as they were given.
        scale: (s, 2) what each session's lengths would be multiplied by to fit the others, and its standard deviation.
    """

    members: tuple[int, ...]
    T_world_session: Floats
    covariance: Floats
    T_world_map: list[Floats]
    encounters: list[Encounter]
    scale: Floats


@dataclass(frozen=True, slots=True, eq=False)
class SessionAlignment:
    """Where sessions are.

    Attributes:
        sessions: as they were given.
        worlds: the largest first; a session that met nobody is a world of its own.
        meetings: of every pair that was looked at, with what spoke against it.
    """

    sessions: Sequence[Session]
    worlds: list[JointWorld]
    meetings: list[Meeting]

    def why_apart(self, session: int) -> list[str]:
        """What spoke against joining a session with each of the others, as sentences."""
        names = [own.name for own in self.sessions]
        return [
            f"{names[m.query_session]} and {names[m.place_session]}: {m.refusal}"
            for m in self.meetings
            if m.refusal is not None and session in (m.place_session, m.query_session)
        ]

    def doubtful_joins(self, held: int) -> dict[int, list[str]]:
        """Sessions of the largest world that only meetings with a doubt join with the rest of it, and these in sentences.

        What sound meetings bear out, through whichever sessions, is no longer in doubt.

        Args:
            held: so many sessions, the first that were given, are known to be in one world.
        """
        members, names = self.worlds[0].members, [own.name for own in self.sessions]
        joined = [m for m in self.meetings if m.refusal is None and {m.place_session, m.query_session} <= set(members)]
        sound = [(m.place_session, m.query_session) for m in joined if m.doubt is None]
        known = [number for number in members if number < held]
        pairs = [*sound, *pairwise(known)]
        _, group = connected_components(len(names), *np.array(pairs, dtype=np.int64).reshape(-1, 2).T)
        own = group[members[0]] if known else max((group[k] for k in members), key=lambda g: np.count_nonzero(group == g))
        return {
            number: [
                f"{names[m.query_session]} and {names[m.place_session]} {m.doubt}"
                for m in joined
                if m.doubt is not None and number in (m.place_session, m.query_session)
            ]
            for number in members
            if group[number] != own
        }

    def slips(self, held: int) -> list[str]:
        """Where the odometry of a session of the largest world slipped, in sentences, unless both sessions were held before.

        Other sessions bear out where it is before the slip, or after it, not both.
        """
        members = set(self.worlds[0].members)
        slipped = [(m.slip, {m.place_session, m.query_session}) for m in self.meetings if m.refusal is None]
        return [text for text, pair in slipped if text is not None and pair <= members and max(pair) >= held]


def align_sessions(
    sessions: Sequence[Session],
    config: SessionsConfig | None = None,
    *,
    pairs: Iterable[tuple[int, int]] | None = None,
    progress: Callable[[Meeting], None] | None = None,
) -> SessionAlignment:
    """Find out which sessions met, and place those that did in one world.

    Args:
        sessions: two at least.
        config: settings; each has a default.
        pairs: of numbers of sessions that are looked at; all of them if left out.
        progress: called with every pair.

    Raises:
        InputError: fewer than two sessions, two of one name; OpenCV, the extra `vision`, is not installed.

    Example: docs/sessions.md.
    """
    config = as_settings(SessionsConfig, config)
    names = [session.name for session in sessions]
    if len(sessions) < 2 or len(set(names)) < len(names):
        raise InputError("two sessions at least, of different names", f"{names}", "name each of them once")
    places = [Places(session, config.slam) for session in sessions]
    wanted = combinations(range(len(sessions)), 2) if pairs is None else sorted({(min(p), max(p)) for p in pairs})
    meetings = []
    for a, b in wanted:
        meetings.append(meet(places[a], places[b], config, (a, b)))
        if progress is not None:
            progress(meetings[-1])
    return place_sessions(sessions, meetings, config)


def worlds_of(count: int, meetings: Iterable[Meeting]) -> list[list[int]]:
    """Numbers of so many sessions by the worlds that meetings leave, the largest first, before these are held against each other.

    Example:
        >>> worlds_of(2, [])
        [[0], [1]]
    """
    met = [(m.place_session, m.query_session) for m in meetings if m.refusal is None]
    number, world = connected_components(count, *np.array(met, dtype=np.int64).reshape(-1, 2).T)
    members = [np.flatnonzero(world == k).tolist() for k in range(number)]
    return sorted(members, key=lambda own: (-len(own), own))


def place_sessions(sessions: Sequence[Session], meetings: Sequence[Meeting], config: SessionsConfig) -> SessionAlignment:
    """One world for the sessions that met, directly or through others.

    Meetings are taken by the number of their encounters. One between sessions that others have joined already has to agree with
    them, and at least half of its encounters with the graph of all; otherwise it is refused.
    """
    decided = list(meetings)
    while True:
        anchored, decided = _anchored(len(sessions), decided, config)
        worlds, doubted = [], set[int]()
        for members in sorted(anchored.groups(), key=lambda group: (-len(group), group)):
            world, doubts = _world(sessions, members, decided, anchored, config)
            worlds.append(world)
            doubted |= doubts
        if not doubted:
            return SessionAlignment(tuple(sessions), worlds, decided)
        why = "most of its encounters contradict those with other sessions"
        decided = [_apart(meeting, why) if k in doubted else meeting for k, meeting in enumerate(decided)]


def place_surely(sessions: Sequence[Session], meetings: Sequence[Meeting], config: SessionsConfig) -> SessionAlignment:
    """As `place_sessions`, but sessions that only meetings with a doubt join with the rest of the largest world stay apart.

    The refusal of such meetings begins with `IN_DOUBT`.
    """
    decided = list(meetings)
    while True:
        alignment = place_sessions(sessions, decided, config)
        out = alignment.doubtful_joins(0).keys()
        if not out:
            return alignment
        decided = [
            _apart(m, f"{IN_DOUBT}the two {m.doubt}")
            if m.refusal is None and m.doubt is not None and out & {m.place_session, m.query_session}
            else m
            for m in alignment.meetings
        ]


class _Anchors:
    """Where sessions are in the frame of the one that each of them has been joined with, covariances on the right."""

    def __init__(self, count: int) -> None:
        self.root = list(range(count))
        self._members = {number: [number] for number in range(count)}
        self.T = [_START] * count
        self.covariance = [np.zeros((6, 6))] * count

    def groups(self) -> list[tuple[int, ...]]:
        return [tuple(sorted(members)) for members in self._members.values()]

    def between(self, a: int, b: int) -> tuple[Floats, Floats]:
        """T_a_b of two sessions of one root, and its covariance, as if both had been placed independently."""
        T = se3.compose(se3.inverse(self.T[a]), self.T[b])
        Ad = se3.adjoint(se3.inverse(T))
        return T, Ad @ self.covariance[a] @ Ad.T + self.covariance[b]

    def unite(self, a: int, b: int, T_a_b: Floats, covariance: Floats) -> None:
        """Move all that b is joined with to a's root."""
        root, old = self.root[a], self.root[b]
        members = self._members.pop(old)
        self._members[root] += members
        moved = {}
        for k in members:
            T_b_k, S_b_k = self.between(b, k) if k != b else (_START, np.zeros((6, 6)))
            T_a_k = se3.compose(T_a_b, T_b_k)
            A_a, A_b = se3.adjoint(se3.inverse(T_a_k)), se3.adjoint(se3.inverse(T_b_k))
            S = A_a @ self.covariance[a] @ A_a.T + A_b @ covariance @ A_b.T + S_b_k
            moved[k] = se3.compose(self.T[a], T_a_k), S
        for k, (T, S) in moved.items():
            self.root[k], self.T[k], self.covariance[k] = root, T, S


def _anchored(count: int, meetings: list[Meeting], config: SessionsConfig) -> tuple[_Anchors, list[Meeting]]:
    """A first placement along the meetings with most encounters, and the meetings that contradict it refused."""
    anchors, decided = _Anchors(count), list(meetings)
    limit = float(np.sqrt(chi_square_quantile(config.slam.innovation, 6)))
    for k in sorted(range(len(meetings)), key=lambda k: (-len(meetings[k].accepted), k)):
        meeting = meetings[k]
        if meeting.T_place_query is None or meeting.covariance is None:
            continue
        a, b = meeting.place_session, meeting.query_session
        if anchors.root[a] != anchors.root[b]:
            anchors.unite(a, b, meeting.T_place_query, meeting.covariance)
            continue
        T, S = anchors.between(a, b)
        xi = se3.log(se3.compose(se3.inverse(meeting.T_place_query), T))
        far = mahalanobis(xi, config.slam.odometry_scale**2 * (S + meeting.covariance))
        if far > limit:
            decided[k] = _apart(meeting, f"lies {far:.0f} standard deviations from where other sessions put the two")
    return anchors, decided


def _world(
    sessions: Sequence[Session], members: tuple[int, ...], meetings: list[Meeting], anchors: _Anchors, config: SessionsConfig
) -> tuple[JointWorld, set[int]]:
    """The joint graph of some sessions, and the meetings most of whose encounters it does not keep."""
    if len(members) == 1:
        T = sessions[members[0]].T_session_map
        return JointWorld(members, _START[None], np.zeros((1, 6, 6)), [T], [], np.array([[1.0, 0.0]])), set()
    row = {number: k for k, number in enumerate(members)}
    start = np.stack([anchors.between(members[0], number)[0] if number != members[0] else _START for number in members])
    encounters, source = [], []
    for k, meeting in enumerate(meetings):
        if meeting.place_session in row and meeting.query_session in row:
            encounters += meeting.accepted
            source += [k] * len(meeting.accepted)
    own = [replace(e, place_session=row[e.place_session], query_session=row[e.query_session]) for e in encounters]
    graph: JoinedGraph = join([sessions[number] for number in members], own, start, config.slam.gravity_sigma)
    of, kept = np.array(source), graph.is_kept
    doubted = {k for k in set(source) if np.count_nonzero(kept[of == k]) < 0.5 * np.count_nonzero(of == k)}
    chosen = [e for e, is_kept in zip(encounters, kept, strict=True) if is_kept]
    world = JointWorld(members, graph.T_world_session, graph.covariance, graph.T_world_map, chosen, graph.scale)
    return world, doubted


def _apart(meeting: Meeting, why: str) -> Meeting:
    return replace(meeting, refusal=why, T_place_query=None, covariance=None)
