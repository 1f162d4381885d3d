"""Many random recordings of cameras through `boxplus inspect`, or through `boxplus vio`: right, or said what is wrong?

    python benchmarks/camera_campaign.py                               # 20 seeds
    python benchmarks/camera_campaign.py --seeds 1:101:2 --out odd.jsonl   # settings come from even seeds, odd ones report
    python benchmarks/camera_campaign.py --only fault=rolling_shutter --seeds 0:400
    python benchmarks/camera_campaign.py --vio --seeds 0:40            # the odometry in place of the data doctor
    python benchmarks/camera_campaign.py --vo --seeds 0:40             # direct odometry, without IMU, on recordings of its own
    python benchmarks/camera_campaign.py --vo --seeds 0:40 --fault wrong_focal_length
    python benchmarks/camera_campaign.py --merge odd.jsonl

A seed draws world, motion, light, cameras, IMU and, in three of five, one fault (vio_campaign/draws.py). Verdicts, of the
findings that are not ok:

- `right`: a sound recording of which nothing is said; `false alarm`: something is.
- `right cause`: a fault, and a finding with one of its words; `flagged`: other findings only.
- `unchecked`: nothing, and the findings say that camera and IMU could not be compared.
- `silent`: nothing. Faults that only an estimator can tell are counted apart, as `not for inspect`.

With `--vio` the verdicts are those of vio_campaign/judge.py, with `--vo` draws and verdicts those of vio_campaign/direct.py.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

from vio_campaign.direct import draw_direct, draw_direct_kinds, run_direct
from vio_campaign.draws import Draw, draw, draw_kinds

from boxplus import diagnose
from boxplus.recordings.info import Evidence

_OF_THE_IMU = ("imu_clock_offset", "other_imu", "rolling_shutter", "inverted_extrinsic", "gyro_in_deg", "flip_gyro")


def judge(drawn: Draw, found: Sequence[Evidence]) -> str:
    """The verdict on the findings of a recording."""
    wrong = [finding for finding in found if finding.verdict != "ok"]
    if drawn.kinds.light == "jumping":
        # Exposures that jump are part of what was recorded, and to be said.
        wrong = [finding for finding in wrong if not finding.key.endswith("_brightness")]
    if drawn.fault is None:
        return "false alarm" if wrong else "right"
    if drawn.fault.named_in(" ".join(f"{finding.value} {finding.text}" for finding in wrong)):
        return "right cause"
    if drawn.fault.witness == "estimator":
        return "not for inspect"
    if wrong:
        return "flagged"
    compared = any(finding.value == "unchecked" for finding in found)
    return "unchecked" if compared and drawn.kinds.fault in _OF_THE_IMU else "silent"


def run(seed: int) -> dict[str, Any]:
    """A line about a seed."""
    drawn = draw(seed)
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        diagnosis = diagnose(drawn.write(Path(folder) / "recording"))
    wrong = [[finding.key, finding.value, finding.text] for finding in diagnosis.evidence if finding.verdict != "ok"]
    verdict = judge(drawn, diagnosis.evidence)
    return {
        "seed": seed,
        **asdict(drawn.kinds),
        "verdict": verdict,
        "wrong": wrong,
        "time_s": round(time.perf_counter() - began, 1),
    }


def run_vio(seed: int, fault: str | None = None) -> dict[str, Any]:
    """A line about a seed through the odometry, with a fault of another name where one is given."""
    from vio_campaign.judge import judge_run, run_odometry

    drawn = draw(seed, fault)
    began = time.perf_counter()
    outcome, facts = run_odometry(drawn)
    error = None if outcome.error_m is None else round(outcome.error_m, 4)
    wrong = [["error_m", error, f"of {outcome.way_m:.1f} m"], ["not_ok", round(outcome.not_ok, 2), ""]]
    wrong += [["flag", "", text] for text in outcome.flags]
    verdict = judge_run(drawn, outcome)
    elapsed = round(time.perf_counter() - began, 1)
    about = "" if drawn.fault is None else drawn.fault.description
    return {"seed": seed, **asdict(drawn.kinds), "about": about, "verdict": verdict, "wrong": wrong, **facts, "time_s": elapsed}


def run_vo(seed: int, fault: str | None = None) -> dict[str, Any]:
    """A line about a seed through direct odometry, with a fault of another name where one is given."""
    drawn, began = draw_direct(seed, fault), time.perf_counter()
    told = run_direct(drawn)
    text = "" if drawn.fault is None else drawn.fault.description
    return {"seed": seed, **asdict(drawn.kinds), "about": text, **told, "time_s": round(time.perf_counter() - began, 1)}


def table(lines: list[dict[str, Any]]) -> str:
    """Verdicts by fault."""
    rows = []
    for fault in sorted({line["fault"] for line in lines}):
        counts = Counter(line["verdict"] for line in lines if line["fault"] == fault)
        rows.append(f"{fault:26}" + ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common()))
    total = Counter(line["verdict"] for line in lines)
    return "\n".join([*rows, f"{'all':26}" + ", ".join(f"{count} {verdict}" for verdict, count in total.most_common())])


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0:20", help="begin:end or begin:end:step")
    parser.add_argument("--only", action="append", default=[], help="KIND=VALUE, for example fault=darkness")
    parser.add_argument("--fault", help="in every recording, in place of what a seed draws; with --vio and --vo")
    parser.add_argument("--vio", action="store_true", help="run the odometry")
    parser.add_argument("--vo", action="store_true", help="run direct odometry")
    parser.add_argument("--out", type=Path, help="append a JSON line for each run")
    parser.add_argument("--merge", type=Path, nargs="+", help="tables of earlier runs; nothing is run")
    options = parser.parse_args(arguments)
    if options.fault is not None and not (options.vio or options.vo):
        parser.error("--fault needs --vio or --vo")
    only = dict(entry.split("=", 1) for entry in options.only)
    if options.merge:
        lines = [json.loads(row) for path in options.merge for row in path.read_text(encoding="utf-8").splitlines()]
        print(table([line for line in lines if all(line[key] == value for key, value in only.items())]))
        return
    kinds_of = draw_direct_kinds if options.vo else draw_kinds
    odometry = run_vo if options.vo else run_vio if options.vio else None
    lines = []
    for seed in range(*map(int, options.seeds.split(":"))):
        if not kinds_of(seed).matches(only):
            continue
        lines.append(run(seed) if odometry is None else odometry(seed, options.fault))
        line = lines[-1]
        said = "; ".join(f"{key} {value or text[:70]}" for key, value, text in line["wrong"])
        print(
            f"{seed:5} {line['world']:10}{line['motion']:13}{line['rig']:7}{line['fault']:24}{line['verdict']:14}{said}",
            flush=True,
        )
        if options.out is not None:
            with options.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
    print(table(lines))


if __name__ == "__main__":
    main()
