"""Tables of a campaign, from its lines of JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

VERDICTS = ("right", "right cause", "flagged", "silent", "crashed")
_KINDS = ("world", "motion", "sensor", "imu", "extrinsic", "fault", "bag", "nuisance")
_NAMED, _ALARMS = 0.9, 0.01
_ALIKE = 0.1  # two results whose errors are within this share of one another
Line = dict[str, Any]


def report(lines: Sequence[Line]) -> str:
    """Everything: even seeds (tuned) and odd seeds (untouched) apart, then every silent case with its command."""
    parts = []
    for name, half in (("even seeds (tuned)", 0), ("odd seeds (untouched)", 1)):
        mine = [line for line in lines if line["seed"] % 2 == half]
        if mine:
            parts += [f"== {name}: {len(mine)} runs ==", _summary(mine), *(_table(mine, kind) for kind in _KINDS)]
    parts += [_cases(lines, "silent", "silently wrong"), _cases(lines, "crashed", "crashed"), _alarms(lines)]
    return "\n".join(part for part in parts if part)


def against(lines: Sequence[Line], before: Sequence[Line]) -> str:
    """Runs beside earlier ones of the same recordings: whose verdict changed, and how the errors of sound right ones did."""
    earlier = {_recording(line): line for line in before}
    pairs = [(earlier[_recording(line)], line) for line in lines if _recording(line) in earlier]
    changed = [(old, new) for old, new in pairs if (old["verdict"], old["false_alarm"]) != (new["verdict"], new["false_alarm"])]
    rows = [f"== against {len(pairs)} earlier runs of the same recordings: {len(changed)} ended otherwise =="]
    rows += [f"was {old['verdict']}{' FALSE ALARM' if old['false_alarm'] else ''}, {describe(new)}" for old, new in changed]
    both = [pair for pair in pairs if all(line["fault"] == "none" and line["verdict"] == "right" for line in pair)]
    if both:
        ratios = np.array([(new["worst_m"] + 1e-3) / (old["worst_m"] + 1e-3) for old, new in both])
        better, worse = int(np.sum(ratios < 1.0 - _ALIKE)), int(np.sum(ratios > 1.0 + _ALIKE))
        mean = float(np.exp(np.log(ratios).mean()))
        rows.append(
            f"{len(both)} sound runs right before and now: {better} better, {worse} worse, largest errors {mean:.2f} times theirs"
        )
    return "\n".join(rows)


def _recording(line: Line) -> tuple[Any, ...]:
    return tuple(line[key] for key in ("seed", "real", "rough", "variety", "bag"))


def _summary(lines: Sequence[Line]) -> str:
    sound = [line for line in lines if line["fault"] == "none"]
    faulty = [line for line in lines if line["fault"] != "none"]
    texts = [_counts("sound", sound), _counts("faulty", faulty)]
    alarms = Counter(line["false_alarm"] for line in sound)
    texts.append(f"false alarms of {len(sound)} sound runs: {alarms['flagged']} flagged, {alarms['weak']} only called weak")
    judged = [line for line in sound if line["worst_m"] is not None]
    if judged:
        for key, unit, name in (("worst_m", "m", "largest position error"), ("worst_deg", "deg", "largest rotation error")):
            median, high = np.percentile([line[key] for line in judged], [50, 95])
            texts.append(f"sound, {name}: median {median:.3f} {unit}, 95 % {high:.3f} {unit}")
        median, high = np.percentile([line["nees"] for line in judged], [50, 95])
        texts.append(f"sound, NEES a degree of freedom (1 is consistent): median {median:.2f}, 95 % {high:.2f}")
    jumped = [line.get("jumped", 0.0) for line in lines]
    if any(jumped):
        texts.append(f"ground truth that jumps: {np.mean(jumped):.1%} of the scans, whose covariance is not judged")
    cpu = [line["cpu_s"] for line in lines]
    texts.append(f"processor time a run: median {np.median(cpu):.1f} s, most {max(cpu):.1f} s")
    return "\n".join([*texts, *_bars(lines, sound, faulty)])


def _bars(lines: Sequence[Line], sound: Sequence[Line], faulty: Sequence[Line]) -> list[str]:
    """What a campaign has to reach, and whether it did. A fault that left a run right needs no name."""
    silent = sum(line["verdict"] in ("silent", "crashed") for line in lines)
    texts = [f"bar: none silently wrong or crashed: {silent} of {len(lines)}, {_met(silent == 0)}"]
    wrong = [line for line in faulty if line["verdict"] != "right"]
    if wrong:
        causes = sum(line["verdict"] == "right cause" for line in wrong)
        named, well = causes / len(wrong), 1.0 - (len(wrong) - causes) / len(faulty)
        text = f"bar: the cause named in {_NAMED:.0%} of the faulty runs that are not right: {named:.1%}, {_met(named >= _NAMED)}"
        texts.append(f"{text} (named or right: {well:.1%} of all faulty ones)")
    if sound:
        alarms = sum(bool(line["false_alarm"]) for line in sound) / len(sound)
        texts.append(f"bar: at most {_ALARMS:.0%} of the sound runs a false alarm: {alarms:.1%}, {_met(alarms <= _ALARMS)}")
    return texts


def _met(met: bool) -> str:
    return "met" if met else "NOT MET"


def _counts(name: str, lines: Sequence[Line]) -> str:
    counts = Counter(line["verdict"] for line in lines)
    sure = sum(line["verdict"] == "silent" and line["reasons"] == ["covariance"] for line in lines)
    text = ", ".join(f"{counts[verdict]} {verdict}" for verdict in VERDICTS)
    return f"{name}: {len(lines)} runs, {text}" + (f" ({sure} of them only too sure of themselves)" if sure else "")


def _table(lines: Sequence[Line], kind: str) -> str:
    rows = [f"{kind:22s} {'runs':>5s} " + " ".join(f"{verdict:>11s}" for verdict in VERDICTS) + f" {'false alarm':>11s}"]
    drawn = [line.get(kind, "none").split("+") for line in lines]
    for value in sorted({name for names in drawn for name in names}):
        mine = [line for line, names in zip(lines, drawn, strict=True) if value in names]
        counts = Counter(line["verdict"] for line in mine)
        cells = " ".join(f"{counts[verdict]:11d}" for verdict in VERDICTS)
        rows.append(f"  {value:20s} {len(mine):5d} {cells} {sum(bool(line['false_alarm']) for line in mine):11d}")
    return "\n".join(rows)


def describe(line: Line) -> str:
    """One run in one line."""
    error = "no estimate"
    if line["worst_m"] is not None:
        error = f"{line['worst_m']:.2f} m of {line['way_m']:.1f} m, {line['worst_deg']:.1f} deg, {line['worst_sigmas']:.0f} sigma"
    alarm = f" FALSE ALARM ({line['false_alarm']})" if line["false_alarm"] else ""
    what = f"{line['world']}, {line['motion']}, {line['sensor']}, {line['imu']} IMU, {line['extrinsic']}"
    fault = "sound" if line["fault"] == "none" else f"{line['fault']} ({line['detail']})"
    via = "" if line["bag"] == "false" else f", by {'command' if line['bag'] == 'command' else 'bag'}"
    return f"{line['seed']:5d} {line['verdict']}{alarm}: {what}; {fault}{via}; {error}"


def _cases(lines: Sequence[Line], verdict: str, name: str) -> str:
    cases = [line for line in lines if line["verdict"] == verdict]
    rows = [f"== {name}: {len(cases)} =="]
    for line in sorted(cases, key=lambda line: (line["fault"], line["seed"])):
        rows += [f"{describe(line)} [{', '.join(line['reasons'])}]", f"      {command(line)}"]
    return "\n".join(rows)


def command(line: Line) -> str:
    """What repeats a run."""
    how = " --real 1" if line["real"] else " --bag" if line["bag"] == "command" else ""
    how += " --rough" if line["rough"] else ""
    how += "" if line["variety"] == "usual" else f" --{line['variety']}"
    return f"python benchmarks/campaign.py --seeds {line['seed']}:{line['seed'] + 1} -v{how}"


def _alarms(lines: Sequence[Line]) -> str:
    cases = [line for line in lines if line["false_alarm"]]
    if not cases:
        return ""
    rows = [f"== false alarms: {len(cases)} =="]
    for line in cases:
        why = line["flags"][:1] or [f"called weak where the LiDAR saw enough: {line['falsely_weak_scans'][:2]}"]
        rows.append(f"{describe(line)}\n      {why[0][:200]}")
    return "\n".join(rows)
