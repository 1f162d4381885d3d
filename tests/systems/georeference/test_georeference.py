"""A map laid onto the Earth: right where fixes are good, and a sentence where they are not."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given as drawn
from hypothesis import strategies as st

from boxplus.errors import SingularProblemError
from boxplus.manifolds import quaternion, se3
from boxplus.sensors.satellites.gnss import GnssFixes
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.gnss import GnssConfig
from boxplus.systems.georeference.attachment import AttachedFixes, attach
from boxplus.systems.georeference.config import GeoreferenceConfig
from boxplus.systems.georeference.doubts import contradiction_of, doubts_of, gated_stretches, told_delay
from boxplus.systems.georeference.fit import Fit, level
from boxplus.systems.georeference.georeference import Georeference, georeference
from boxplus.systems.georeference.heights import height_jump
from boxplus.systems.georeference.jump import jump_of
from boxplus.systems.georeference.plateau import plateau_of
from boxplus.systems.georeference.start import find_start
from tests.systems.georeference.drives import LAPS, ORIGIN, Drive, drive

LEVER = (0.8, -0.3, 1.1)
STEP = np.array([3.0, 0.0, 0.0])
GOOD = GnssConfig(sigma=0.3, slow_sigma=0.1, claimed=0.3, lever=LEVER)
USUAL = GOOD.model_copy(update={"sigma": 0.5, "slow_sigma": 0.5, "claimed": 0.7})
RTK = GOOD.model_copy(update={"sigma": 0.01, "slow_sigma": 0.01, "claimed": 0.02})
CONFIG = GeoreferenceConfig()


@pytest.fixture(scope="module")
def laps() -> Drive:
    return drive(LAPS)


def found(
    given: Drive, receiver: GnssConfig, config: GeoreferenceConfig | None = None, lever: tuple[float, ...] | None = LEVER
) -> Georeference:
    arm = None if lever is None else np.array(lever)
    return georeference(given.graph, given.fixes(receiver), given.time_ns, given.T_odo_imu, config, arm)


def test_a_map_lies_where_it_is_and_drifts_no_more(laps: Drive) -> None:
    result = found(laps, GOOD)
    assert result.refusal is None and result.fit is not None and result.warnings == []
    off = laps.off(result)
    assert off.max() < 4.0 * np.sqrt(2.0) * result.fit.sigma.max()
    assert result.used == len(result.attached)
    R = quaternion.to_matrix(result.fit.T_enu_map[:4])
    assert np.degrees(np.arccos(R[2, 2])) < 1.0  # up stays up
    assert np.degrees(np.sqrt(result.fit.covariance[2, 2])) < 0.5


def test_multipath_is_gated_and_counted(laps: Drive) -> None:
    result = found(laps, GOOD.model_copy(update={"multipath": 3, "multipath_s": 6.0}))
    assert result.refusal is None and result.fit is not None
    assert laps.off(result).max() < 4.0 * np.sqrt(2.0) * result.fit.sigma.max()
    gated = sum(count for reason, count in result.left_out.items() if reason.startswith("off "))
    assert gated == len(result.attached) - result.used and 6 <= gated <= 25
    assert all(metres > 5.0 for _, duration, metres in result.stretches if duration > 2.0)


@pytest.mark.parametrize(
    ("receiver", "sentence"),
    [
        ({"swapped": True}, "latitude and longitude are swapped: read so, 100 %"),
        ({"delay_s": 18.0}, "when -18.00 s are added"),
        ({"unit": "rad"}, "latitude and longitude are radians"),
        ({"jump": (30.0, 20.0, 0.0)}, "% of the fixes contradict the others"),
    ],
)
def test_what_is_wrong_with_the_fixes_is_refused_with_evidence(laps: Drive, receiver: dict[str, object], sentence: str) -> None:
    result = found(laps, GOOD.model_copy(update=receiver))
    assert result.refusal is not None and sentence in result.refusal
    assert result.fit is None and result.frame is None


PRECISE = {"sigma": 0.01, "slow_sigma": 0.01, "claimed": 0.02}


@pytest.mark.parametrize(
    "receiver",
    [
        {"sigma": 0.6, "slow_sigma": 0.5, "claimed": 1.0, "jump": (3.0, 2.0, 0.0)},
        {**PRECISE, "jump": (1.2, 0.9, 0.0)},  # so precise that it is gated on both sides of the jump
        {**PRECISE, "jump": (0.4, 0.3, 0.0)},
    ],
)
def test_a_map_between_two_datums_is_not_to_be_trusted(laps: Drive, receiver: dict[str, object]) -> None:
    jumped = found(laps, GOOD.model_copy(update=receiver))
    assert jumped.refusal is None and jumped.contradiction is not None
    assert jumped.contradiction.startswith("fixes jump by ") and "the map lies between the two" in jumped.contradiction


def test_a_step_far_beyond_noise_is_a_jump_whatever_the_fit_with_two_datums_gates() -> None:
    """That fit gated two fixes more than the one with one datum, at nearly the same cost: a map 5.7 standard deviations off."""
    jumped = found(drive(LAPS, 15), GOOD.model_copy(update={**PRECISE, "jump": (0.4, 0.3, 0.0)}))
    assert jumped.refusal is None and jumped.contradiction is not None and "fixes jump by " in jumped.contradiction


@pytest.mark.parametrize("seed", [2, 4])
def test_fixes_that_state_for_a_while_how_far_they_are_off_do_not_jump(seed: int) -> None:
    """A receiver that loses its fixed solution for 40 s says 0.5 m, and is 0.5 m off: the map is right."""
    given = drive(LAPS, seed, DriftConfig(speed=3.0))
    fixes = given.fixes(RTK)
    seconds = (fixes.time_ns - fixes.time_ns[0]) * 1e-9
    lost = (seconds >= 0.4 * seconds[-1]) & (seconds < 0.4 * seconds[-1] + 40.0)
    lat_lon_alt, covariance = fixes.lat_lon_alt.copy(), fixes.covariance.copy()
    lat_lon_alt[lost, 0] += 0.5 / 111_320.0
    covariance[lost] = 0.25 * np.eye(3)
    vague = replace(fixes, lat_lon_alt=lat_lon_alt, covariance=covariance)
    result = georeference(given.graph, vague, given.time_ns, given.T_odo_imu, None, np.array(LEVER))
    assert result.refusal is None and result.contradiction is None and result.fit is not None
    assert given.off(result).max() < 4.0 * np.sqrt(2.0) * result.fit.sigma.max()


def test_a_jump_is_as_long_as_two_datums_are_apart(laps: Drive) -> None:
    """Of the map that lies between them the errors step by less."""
    between = found(laps, GOOD.model_copy(update={**PRECISE, "jump": (1.2, 0.9, 0.0)}))
    assert between.fit is not None
    split = replace(between.fit, errors=np.zeros_like(between.fit.errors), datum_step=np.array([1.2, 0.9, -5.0]))
    jump = jump_of(between.attached, between.fit, lambda after: split)
    assert jump is not None and jump.metres == pytest.approx(1.5)


def of_one_map(attached: AttachedFixes, seconds: np.ndarray) -> AttachedFixes:
    """Fixes at other times (N,) [s], as exactly known and all where one local map is."""
    n = len(seconds)
    return replace(
        attached,
        time_ns=(seconds * 1e9).astype(np.int64),
        covariance=np.tile(attached.covariance[:1], (n, 1, 1)),
        map_of=np.zeros(n, np.intp),
        half_of=np.zeros(n, np.intp),
        drift=np.zeros(n),
        walked=np.zeros(n),
    )


def test_bursts_near_the_ends_do_not_hide_a_jump(laps: Drive) -> None:
    good = found(laps, GOOD.model_copy(update=PRECISE))
    assert good.fit is not None
    seconds, half = np.arange(300.0), 150.0
    fixes = of_one_map(good.attached, seconds)
    errors = np.where(seconds[:, None] >= half, [3.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    for begin in (12.0, 278.0):
        errors[(seconds >= begin) & (seconds < begin + 10.0)] += [20.0, 0.0, 0.0]
    bent = replace(good.fit, errors=errors, is_used=np.ones(300, dtype=bool))

    def refit(after: np.ndarray) -> Fit:
        """A datum from where the jump is takes 3 m away, and one from a burst on nothing."""
        right = abs(float(seconds[np.argmax(after)]) - half) < 1.5
        return replace(bent, errors=errors - 3.0 * np.outer(after, [1.0, 0.0, 0.0]) if right else errors, datum_step=STEP)

    jump = jump_of(fixes, bent, refit)
    assert jump is not None and jump.lasts and jump.seconds == pytest.approx(half, abs=1.5)


def test_bursts_elsewhere_are_no_half_of_a_jump(laps: Drive) -> None:
    """A burst of 34 m that was gated half a minute before another one made a jump of 32 m of that, in a drive that was right."""
    good = found(laps, USUAL)
    assert good.fit is not None
    seconds, random = np.arange(93.0), np.random.default_rng(1)
    fixes = of_one_map(good.attached, seconds)
    errors, used = random.normal(0.0, 0.5, (93, 3)), np.ones(93, dtype=bool)
    for begin, metres in ((11, [-28.9, 9.2, 0.0]), (23, [-1.5, -34.3, 0.0]), (55, [18.6, -10.8, 0.0])):
        errors[begin : begin + 6] += metres
        used[begin : begin + 6] = False
    right = replace(good.fit, errors=errors, is_used=used)
    assert jump_of(fixes, right, lambda after: replace(right, datum_step=np.array([0.4, -0.9, 0.0]))) is None


@pytest.mark.parametrize(
    ("metres", "wanders", "standing", "told"),
    [(12.0, 0.0, False, True), (12.0, 12.0, False, False), (12.0, 2.5, False, False), (12.0, 0.0, True, False)],
)
def test_fixes_that_are_off_by_the_same_for_long_contradict_the_others(
    laps: Drive, metres: float, wanders: float, standing: bool, told: bool
) -> None:
    """They were gated, and a map that may lie in the wrong one of two datums ended with code 0.

    But a wall that keeps the errors on one side, about which they wander, was taken for a datum, and so was multipath of a car
    that stood: what an odometry that stands makes of its speed came to a way of 20 m in half a minute.
    """
    good = found(laps, USUAL)
    assert good.fit is not None and plateau_of(good.attached, good.fit) is None
    seconds = (good.attached.time_ns - good.attached.time_ns[0]) * 1e-9
    inside = (seconds >= 20.0) & (seconds < 60.0)
    way = np.stack([np.cos(seconds), np.sin(seconds), 0.0 * seconds], axis=1)
    errors = good.fit.errors + inside[:, None] * (metres * np.array([0.8, 0.6, 0.0]) + wanders * way)
    used = ~inside
    used[np.flatnonzero(inside)[5]] = True  # by chance
    gated = replace(good.fit, errors=errors, is_used=used)
    attached = good.attached
    if standing:
        random, T = np.random.default_rng(1), np.repeat(attached.T_map_imu[:1], len(attached), axis=0)
        T[:, 4:] += random.normal(0.0, 0.03, (len(T), 3))
        v = random.normal(0.0, 0.03 * np.sqrt(2.0) / 0.1, (len(T), 3))
        attached = replace(attached, T_map_imu=T, v_map=v, map_of=np.zeros(len(T), dtype=np.intp))
    plateau = plateau_of(attached, gated)
    assert (plateau is not None) == told
    said = contradiction_of(None, plateau, gated)
    if not told:
        assert said is None
        return
    assert plateau is not None and plateau.metres == pytest.approx(metres, abs=1.0) and 36.0 < plateau.duration < 41.0
    assert said is not None and re.search("fixes lie 1[12].. m off for [34]. s from 2. s on, all by the same and longer", said)
    stretches = gated_stretches(attached, gated)
    assert not any(
        "longer than multipath" in text for text in doubts_of(attached, gated, True, stretches, None, plateau, None, CONFIG)
    )

    # In a long recording nearly all the others agree.
    time_ns = attached.time_ns.copy()
    time_ns[-1] += 600 * 10**9
    long = replace(attached, time_ns=time_ns)
    plateau = plateau_of(long, gated)
    assert plateau is not None and contradiction_of(None, plateau, gated) is None
    warnings = doubts_of(long, gated, True, gated_stretches(long, gated), None, plateau, None, CONFIG)
    assert [text for text in warnings if "longer than multipath" in text and text.endswith("which is not used")]


def test_a_long_jump_is_a_contradiction_wherever_it_begins(laps: Drive) -> None:
    there = drive([*LAPS, [0, 60], [0, 0], [120, 0]])

    def jumped(given: Drive, receiver: GnssConfig, begin: float, end: float, metres: list[float]) -> Georeference:
        fixes = given.fixes(receiver)
        seconds = (fixes.time_ns - fixes.time_ns[0]) * 1e-9
        moved = shifted(fixes, np.array(metres), (seconds >= begin * seconds[-1]) & (seconds < end * seconds[-1]))
        return georeference(given.graph, moved, given.time_ns, given.T_odo_imu, None, np.array(LEVER))

    long = jumped(there, USUAL, 0.3, 0.65, [9.6, 7.2, 0.0])
    assert long.fit is not None and long.contradiction is not None and "nobody knows which is right" in long.contradiction
    late = jumped(laps, GOOD.model_copy(update=PRECISE), 0.67, 2.0, [0.5, 0.3, 0.0])
    assert late.fit is not None and laps.off(late).max() > 3.0 * np.sqrt(2.0) * np.median(late.fit.sigma)
    assert late.contradiction is not None and "that lasts to the begin or the end" in late.contradiction


@pytest.mark.parametrize("seed", [6, 8])
def test_multipath_that_wanders_for_long_is_no_jump(seed: int) -> None:
    """The map rests on the fixes before and after it, and was said to lie between two datums 25 and 50 m apart."""
    there = drive([*LAPS, [0, 60], [0, 0], [120, 0]])
    fixes, random = there.fixes(USUAL, seed), np.random.default_rng(seed)
    seconds = (fixes.time_ns - fixes.time_ns[0]) * 1e-9
    off, wander = random.normal(0.0, 15.0, 2), np.zeros((len(seconds), 3))
    for k, step in enumerate(np.diff(seconds), 1):
        stays = np.exp(-step / 12.0)
        off = stays * off + np.sqrt(1.0 - stays**2) * random.normal(0.0, 15.0, 2)
        wander[k, :2] = off
    inside = (seconds >= 30.0) & (seconds < 68.0)
    moved = shifted(fixes, wander[inside], inside)
    result = georeference(there.graph, moved, there.time_ns, there.T_odo_imu, None, np.array(LEVER))
    assert result.fit is not None and there.off(result).max() < 3.0 * np.median(result.fit.sigma)
    assert result.contradiction is None and any("contradict the others and are not used" in text for text in result.warnings)


@pytest.mark.parametrize("given_back", [True, False])
def test_a_datum_that_gives_gated_fixes_back_is_one_under_any_burst(laps: Drive, given_back: bool) -> None:
    """With its burst the step looked like one, and a map 5 to 7 deviations off ended with code 0."""
    good = found(laps, USUAL)
    assert good.fit is not None
    seconds, random = np.arange(100.0), np.random.default_rng(1)
    fixes = of_one_map(good.attached, seconds)
    errors, used = random.normal(0.0, 0.5, (100, 3)), np.ones(100, dtype=bool)
    errors[50:58] += [9.0, -12.0, 0.0]
    used[46:64] = False
    between = replace(good.fit, errors=errors, is_used=used, sigma=np.full_like(good.fit.sigma, 0.5))
    kept = np.ones(100, dtype=bool)
    kept[50 : 58 if given_back else 66] = False
    moved = good.fit.T_enu_map + np.array([0.0, 0.0, 0.0, 0.0, -2.0, -1.5, 0.0])
    split = replace(between, is_used=kept, T_enu_map=moved, datum_step=np.array([4.0, 3.0, 0.0]))
    jump = jump_of(fixes, between, lambda after: split)
    assert (jump is not None) == given_back
    if jump is not None:
        assert jump.metres == pytest.approx(5.0) and jump.bend == pytest.approx(5.0) and jump.contradicts(between)


def test_a_datum_that_is_not_determined_is_none(laps: Drive) -> None:
    """And no reason to refuse the map, which is."""

    def undetermined(after: np.ndarray) -> Fit:
        raise SingularProblemError("nothing holds the second datum")

    between = found(laps, GOOD.model_copy(update={**PRECISE, "jump": (1.2, 0.9, 0.0)}))
    assert between.fit is not None and jump_of(between.attached, between.fit, undetermined) is None


@pytest.mark.parametrize(
    "receiver",
    [{}, PRECISE, {"multipath": 2, "multipath_s": 5.0}, {**PRECISE, "multipath": 2, "multipath_s": 5.0, "multipath_m": 0.5}],
)
def test_noise_and_multipath_do_not_contradict_a_map(laps: Drive, receiver: dict[str, object]) -> None:
    result = found(laps, GOOD.model_copy(update=receiver))
    assert result.refusal is None and result.contradiction is None


@pytest.mark.parametrize("seed", [2, 4, 8, 10])
@pytest.mark.parametrize("stops", [[(0.2, 60.0), (0.5, 60.0), (0.8, 60.0)], [(0.0, 90.0), (0.9, 90.0)]])
@pytest.mark.parametrize("speed", [2.0, 8.0])
def test_an_antenna_that_stands_makes_no_jump_of_what_the_odometry_drifts(
    seed: int, stops: list[tuple[float, float]], speed: float
) -> None:
    """Within a local map an odometry drifts by more than RTK is off, and all fixes of a stop are off by the same."""
    here = drive(LAPS, seed, DriftConfig(speed=speed), stops)
    result = georeference(here.graph, here.fixes(RTK, seed), here.time_ns, here.T_odo_imu, None, np.array(LEVER))
    assert result.fit is not None and result.contradiction is None
    assert (here.off(result) / (np.sqrt(2.0) * result.fit.sigma)).max() < 4.0


def test_fixes_of_another_vehicle_are_refused(laps: Drive) -> None:
    other = drive([[0, 0], [100, 0], [100, -120], [220, -120]], seed=4)
    result = georeference(laps.graph, other.fixes(GOOD), laps.time_ns, laps.T_odo_imu, None, np.array(LEVER))
    assert result.refusal is not None and "do not follow the odometry's path" in result.refusal


@pytest.mark.parametrize("delay", [0.4, -0.4])
def test_stamps_that_are_late_are_doubted_and_allowed_for(laps: Drive, delay: float) -> None:
    result = found(laps, GOOD.model_copy(update={"delay_s": delay}))
    assert result.fit is not None and 0.5 < result.fit.delay / delay < 1.1  # drawn to zero by what is known beforehand
    (warning,) = [text for text in result.warnings if "stamped" in text]
    assert ("late" in warning) == (delay > 0)
    told = re.search(r"stamped ([\d.]+) s .*\(± ([\d.]+) s\).*gnss.time_offset_s=(-?[\d.]+)", warning)
    assert told is not None and float(told[3]) == np.sign(-delay) * float(told[1])
    assert abs(float(told[1]) - abs(delay)) < 3.0 * float(told[2]) < 0.25  # what is to be corrected is all of it
    corrected = found(laps, GOOD.model_copy(update={"delay_s": delay}), GeoreferenceConfig(time_offset_s=-delay))
    assert corrected.warnings == []


@pytest.mark.parametrize(("delay", "before"), [(0.65, 0.0), (-1.4, 0.0), (1.9, -1.0), (18.4, 0.0), (18.0, -1.0)])
def test_the_offset_that_is_named_for_another_clock_is_what_corrects_it(laps: Drive, delay: float, before: float) -> None:
    late = RTK.model_copy(update={"delay_s": delay})
    refusal = found(laps, late, GeoreferenceConfig(time_offset_s=before)).refusal
    assert refusal is not None and "the clock of the receiver is another one" in refusal
    named = re.search(r"set gnss.time_offset_s=(-?[\d.]+)$", refusal)
    assert named is not None and float(named[1]) == pytest.approx(-delay, abs=0.06)
    corrected = found(laps, late, GeoreferenceConfig(time_offset_s=float(named[1])))
    assert corrected.refusal is None and laps.off(corrected).max() < 0.3


def test_what_fixes_tell_of_a_delay_is_not_drawn_to_zero() -> None:
    before, of_fixes, measured = 0.1, 0.06, 0.5
    information = 1.0 / before**2 + 1.0 / of_fixes**2
    fitted, sigma = measured / of_fixes**2 / information, information**-0.5
    assert told_delay(fitted, sigma, before) == pytest.approx((measured, of_fixes))
    assert told_delay(0.02, before, before) == (0.02, before)  # of fixes that tell nothing


def test_an_antenna_elsewhere_is_named_where_speeds_do_not_tell_it_from_a_delay(laps: Drive) -> None:
    result = found(laps, GOOD.model_copy(update={"delay_s": 0.4, "sigma": 0.02, "slow_sigma": 0.0, "claimed": 0.02}))
    fit = result.fit
    assert fit is not None

    def said(attached: AttachedFixes) -> str:
        (warning,) = [text for text in doubts_of(attached, fit, True, [], None, None, None, CONFIG) if "stamped" in text]
        return warning

    assert "farther back than the lever arm says would look the same" in said(result.attached)  # driven at one speed
    speeds = np.linspace(0.2, 1.8, len(result.attached))[:, None]
    assert "lever arm" not in said(replace(result.attached, v_map=speeds * result.attached.v_map))


def test_a_lever_arm_nobody_gave_is_estimated_and_said(laps: Drive) -> None:
    precise = GOOD.model_copy(update={"sigma": 0.02, "slow_sigma": 0.0, "claimed": 0.02})
    result = found(laps, precise, lever=None)
    assert result.fit is not None and any("lever arm" in text for text in result.warnings)
    off = np.abs(result.fit.lever - LEVER)[:2]
    assert (off < 4.0 * result.fit.lever_sigma[:2]).all()
    assert result.fit.lever_sigma[1] < 0.1  # sideways; ahead, a delay looks the same where the speed is


def test_claims_that_are_too_good_are_seen_through(laps: Drive) -> None:
    result = found(laps, GOOD.model_copy(update={"claimed": 0.03}))
    assert result.fit is not None and 5.0 < result.fit.noise_scale < 20.0
    assert any("scatter" in text for text in result.warnings)
    assert laps.off(result).max() < 4.0 * np.sqrt(2.0) * result.fit.sigma.max()


def northward(length: float) -> Drive:
    given = drive([[0, 0], [length, 0]], seed=1)
    yaw = 0.5 * np.pi - 2.0 * np.arctan2(given.T_enu_imu[0, 3], given.T_enu_imu[0, 0])
    turn = np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw), 0.0, 0.0, 0.0])
    return Drive(given.time_ns, se3.compose(turn, given.T_enu_imu), given.T_odo_imu, given.graph, given.at)


def test_a_straight_way_tells_the_heading_but_not_always_the_order_of_the_numbers() -> None:
    known = GeoreferenceConfig(delay_sigma=0.01)
    assert found(northward(250.0), GOOD, known).warnings == []  # swapped, the way would be 1 % shorter
    north = northward(150.0)
    result = found(north, GOOD.model_copy(update={"sigma": 1.5, "claimed": 1.5}))
    assert result.refusal is None and result.fit is not None
    assert any("swapped" in text for text in result.warnings)
    assert north.off(result).max() < 4.0 * np.sqrt(2.0) * result.fit.sigma.max()


@pytest.mark.parametrize("delay", [0.0, 1.0, -2.0])
def test_a_straight_and_steady_way_does_not_tell_the_clocks_apart_and_says_so(delay: float) -> None:
    straight = northward(250.0)
    result = found(straight, GOOD.model_copy(update={"delay_s": delay}))
    (warning,) = result.warnings
    told = re.search(r"each second of it moves the map by ([\d.]+) m", warning)
    assert told is not None and result.fit is not None
    off = float(np.median(straight.off(result)))
    assert abs(off - float(told[1]) * abs(delay)) < 3.0 * np.sqrt(2.0) * result.fit.sigma.max()


def test_standing_still_tells_no_heading() -> None:
    still = drive([[0, 0], [30, 0]], seed=1, config=DriftConfig(step_m=0.02, speed=0.02))
    few = slice(0, 60)
    graph = drive([[0, 0], [30, 0]], seed=1).graph
    fixes = still.fixes(GOOD.model_copy(update={"rate_hz": 1.0})).selected(np.arange(50))
    result = georeference(graph, fixes, still.time_ns[few], still.T_odo_imu[few], None, np.array(LEVER))
    assert result.refusal is not None and "heading of the map is not determined" in result.refusal


def test_fixes_outside_of_the_odometry_are_counted(laps: Drive) -> None:
    fixes = laps.fixes(GOOD)
    early = georeference(laps.graph, fixes.shifted(-(10**13)), laps.time_ns, laps.T_odo_imu)
    assert early.refusal is not None and f"{len(fixes)} outside of the odometry's time" in early.refusal
    gap = np.ones(len(laps.time_ns), dtype=bool)
    gap[100:150] = False
    attached = attach(fixes, laps.graph, laps.time_ns[gap], laps.T_odo_imu[gap], GeoreferenceConfig(interval=0.0))
    assert attached.left_out["in a gap of the odometry"] > 10
    assert len(attached) + sum(attached.left_out.values()) == len(fixes)
    again = se3.compose(laps.graph.T_odo[attached.map_of], attached.T_map_imu)
    p = np.column_stack([np.interp(attached.time_ns, laps.time_ns, laps.T_odo_imu[:, k]) for k in range(4, 7)])
    np.testing.assert_allclose(again[:, 4:], p, atol=0.05)  # along chords and not along arcs
    assert np.linalg.norm(attached.v_map, axis=1) == pytest.approx(8.0, abs=0.3)
    assert len(georeference(laps.graph, GnssFixes.from_arrays([], []), laps.time_ns, laps.T_odo_imu).attached) == 0


def test_the_start_stands_nearly_half_of_all_fixes_anywhere() -> None:
    random = np.random.default_rng(5)
    p = np.column_stack([random.uniform(-100.0, 100.0, (80, 2)), np.zeros(80)])
    c, s = np.cos(2.5), np.sin(2.5)
    q = p @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + [5.0, -3.0, 7.0]
    q[:36, :2] += random.uniform(-300.0, 300.0, (36, 2))
    start = find_start(p, q, np.full(80, 0.5))
    assert start is not None and start.yaw % (2.0 * np.pi) == pytest.approx(2.5, abs=1e-9)
    np.testing.assert_allclose(start.shift, [5.0, -3.0, 7.0], atol=1e-9)
    assert start.inliers[36:].all() and start.inliers[:36].sum() <= 1
    assert find_start(p[:1], q[:1], np.full(1, 0.5)) is None


def test_a_world_that_leans_is_set_upright() -> None:
    lean = np.concatenate([se3.exp([0.2, -0.1, 0.0, 0.0, 0.0, 0.0])[:4], np.zeros(3)])
    maps = se3.compose(lean, np.array([[1.0, 0, 0, 0, 1, 2, 3], [0.6, 0, 0, 0.8, 4, 5, 6]]))
    up = quaternion.to_matrix(maps[:, :4])[0, :, 2]
    R = level(maps)
    np.testing.assert_allclose(R @ up, [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(level(maps[:, :] * 1.0) @ R.T, np.eye(3), atol=1e-12)


def shifted(fixes: GnssFixes, metres: np.ndarray, at: np.ndarray) -> GnssFixes:
    p = ORIGIN.to_enu(fixes.lat_lon_alt)
    p[at] += metres
    return replace(fixes, lat_lon_alt=ORIGIN.to_geodetic(p))


def test_a_step_near_to_the_begin_is_said_and_none_that_is_gated(laps: Drive) -> None:
    """Multipath at the begin, or another datum: nobody knows, and the map is bent by it."""
    fixes = laps.fixes(GOOD.model_copy(update={"sigma": 0.5, "slow_sigma": 0.2, "claimed": 0.7}))
    early = (fixes.time_ns - fixes.time_ns[0]) * 1e-9 < 22.0
    for metres, is_bent in ((2.5, True), (40.0, False), (0.0, False)):
        moved = shifted(fixes, np.array([0.8 * metres, -0.6 * metres, 0.0]), early)
        result = georeference(laps.graph, moved, laps.time_ns, laps.T_odo_imu, None, np.array(LEVER))
        assert result.contradiction is None  # the few fixes bend it by less than it claims to be known
        said = [text for text in result.warnings if "multipath that lasts to the begin or the end" in text]
        assert len(said) == is_bent, (metres, result.warnings)


@pytest.mark.parametrize("seed", [14, 20, 24])
def test_a_usual_receiver_that_jumps_early_is_named(laps: Drive, seed: int) -> None:
    """The fit with two datums bends the odometry rather than let one of them jump, and left much of the step."""
    fixes = laps.fixes(USUAL, seed)
    seconds = (fixes.time_ns - fixes.time_ns[0]) * 1e-9
    moved = shifted(fixes, np.array([2.4, 1.8, 0.0]), seconds >= 0.3 * seconds[-1])
    result = georeference(laps.graph, moved, laps.time_ns, laps.T_odo_imu, None, np.array(LEVER))
    assert any("fixes jump by" in text for text in [*result.warnings, result.contradiction or ""])


@pytest.mark.parametrize("seed", [7, 14, 16, 23])
def test_bursts_too_small_to_be_gated_are_no_step(laps: Drive, seed: int) -> None:
    fixes = laps.fixes(USUAL.model_copy(update={"multipath": 3, "multipath_s": 6.0, "multipath_m": 1.5}), seed)
    result = georeference(laps.graph, fixes, laps.time_ns, laps.T_odo_imu, None, np.array(LEVER))
    assert not any("fixes jump by" in text for text in [*result.warnings, result.contradiction or ""])


def test_a_burst_that_a_fix_within_is_used_of_is_one() -> None:
    """What lay beyond that fix was left out, and the end of the burst was a jump to another datum: of a map that was right."""
    rounds = drive([[0, 0], [120, 0], [120, 90], [0, 90]] * 5 + [[0, 0], [60, 0]], seed=7)
    fixes = rounds.fixes(USUAL.model_copy(update={"multipath": 8, "multipath_s": 10.0, "multipath_m": 2.0}), 7)
    result = georeference(rounds.graph, fixes, rounds.time_ns, rounds.T_odo_imu, None, np.array(LEVER))
    assert result.fit is not None and (rounds.off(result) / result.fit.sigma).max() < 3.0
    assert not any("fixes jump by" in text for text in [*result.warnings, result.contradiction or ""])


HILLS = np.column_stack([np.array(LAPS, float), [0.0, 12.0, -3.0, 9.0, 0.0, 12.0, 3.0]])


@pytest.mark.parametrize(("unit", "says"), [(1.0, None), (0.3048, "they are in feet"), (np.inf, "the receiver gives none")])
@pytest.mark.parametrize("climbs", [True, False])
def test_heights_that_do_not_go_along_are_named_where_the_way_climbs(climbs: bool, unit: float, says: str | None) -> None:
    there = drive(HILLS if climbs else LAPS, seed=2)
    fixes = there.fixes(GOOD)
    lla = fixes.lat_lon_alt.copy()
    lla[:, 2] /= unit
    given = replace(fixes, lat_lon_alt=lla)
    result = georeference(there.graph, given, there.time_ns, there.T_odo_imu, None, np.array(LEVER))
    assert result.refusal is None
    said = [text for text in result.warnings if text.startswith("heights of the fixes go")]
    assert len(said) == (says is not None and climbs)
    assert all(says is not None and says in text for text in said)


@pytest.mark.parametrize("begin", [0.35, 0.5, 0.65])
@pytest.mark.parametrize("receiver", [{}, {**PRECISE}, {"sigma": 0.2, "slow_sigma": 0.2}])
def test_heights_of_another_reference_leave_places_as_they_are_and_are_named(
    laps: Drive, receiver: dict[str, object], begin: float
) -> None:
    """From the ellipsoid to the sea on the way: half of the fixes were gated, or all places believed less."""
    config = GOOD.model_copy(update=receiver)
    fixes = laps.fixes(config)
    lla, first = fixes.lat_lon_alt.copy(), int(begin * len(fixes.time_ns))
    lla[first:, 2] -= 47.0
    given = replace(fixes, lat_lon_alt=lla)
    result, sound = georeference(laps.graph, given, laps.time_ns, laps.T_odo_imu, None, np.array(LEVER)), found(laps, config)
    assert result.fit is not None and sound.fit is not None and sound.fit.height_scale == 1.0
    assert result.used >= 0.9 * len(result.attached)
    assert np.median(result.fit.sigma) < 2.0 * np.median(sound.fit.sigma)
    assert (laps.off(result) < 4.0 * np.sqrt(2.0) * result.fit.sigma).all()
    (said,) = [text for text in result.warnings if text.startswith("heights of the fixes scatter")]
    metres, seconds = map(float, re.search(r"they jump by ([-+.0-9]+) m at (\d+) s", said).groups())  # type: ignore[union-attr]
    assert abs(metres + 47.0) < 6.0 and abs(seconds - 1e-9 * (fixes.time_ns[first] - fixes.time_ns[0])) < 3.0


@drawn(
    level=st.floats(-5.0, 5.0), step=st.floats(0.5, 50.0), sign=st.sampled_from([-1.0, 1.0]), at=st.integers(5, 35),
    seed=st.integers(0, 99),
)  # fmt: skip
def test_a_jump_of_heights_is_found_where_it_is_and_noise_and_bursts_are_none(
    level: float, step: float, sign: float, at: int, seed: int
) -> None:
    noise = np.random.default_rng(seed).normal(0.0, 0.03, 40)
    rows = np.arange(40)
    found_at = height_jump(level + noise + sign * step * (rows >= at))
    assert found_at is not None and found_at[0] == at and abs(found_at[1] - sign * step) < 0.1
    assert height_jump(level + noise) is None
    assert height_jump(level + noise + sign * step * ((rows >= 14) & (rows < 27))) is None
    assert height_jump((level + noise)[:9]) is None and height_jump(np.full(40, level)) is None


@pytest.mark.parametrize("feet", [True, False])
def test_feet_over_low_hills_are_told_by_the_noise_that_is_stated(feet: bool) -> None:
    """Errors that stay for a minute leave the ratio to three of its standard deviations; in metres they scatter as stated."""
    there = drive(HILLS * [1.0, 1.0, 0.75], seed=2)
    for seed in (1, 2, 3):
        fixes = there.fixes(USUAL, seed)
        lla = fixes.lat_lon_alt.copy()
        lla[:, 2] /= 0.3048 if feet else 1.0
        given = replace(fixes, lat_lon_alt=lla)
        result = georeference(there.graph, given, there.time_ns, there.T_odo_imu, None, np.array(LEVER))
        assert any("they are in feet" in text for text in result.warnings) is feet, result.warnings


def test_a_lever_arm_with_the_wrong_sign_is_named(laps: Drive) -> None:
    precise = GOOD.model_copy(update={"sigma": 0.02, "slow_sigma": 0.0, "claimed": 0.02})
    wrong = found(laps, precise, lever=(-LEVER[0], -LEVER[1], LEVER[2]))
    said = [text for text in wrong.warnings if text.startswith("the lever arm is wrong")]
    assert len(said) == 1 and "given as (-0.80, 0.30) m" in said[0] and "look at its sign" in said[0]
    for right in (found(laps, precise), found(laps, precise.model_copy(update={"claimed": 0.002}))):
        assert not any(text.startswith("the lever arm is wrong") for text in right.warnings)
