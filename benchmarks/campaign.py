"""Many random recordings through `boxplus lio`: is every run right, or does it say what is wrong?

    python benchmarks/campaign.py                             # 40 runs, 2 processes
    python benchmarks/campaign.py --nightly --out runs.jsonl  # 1000 runs
    python benchmarks/campaign.py --seeds 17:18 -v            # one, with all it says
    python benchmarks/campaign.py --only fault=clock_offset --only world=hall --seeds 0:1000
    python benchmarks/campaign.py --bag --seeds 0:20          # real bags through the real command line
    python benchmarks/campaign.py --real 20                   # real IMU and motion (needs the shared folder)
    python benchmarks/campaign.py --fast --seeds 0:40         # on roads, at up to 33 m/s
    python benchmarks/campaign.py --still --seeds 0:40        # platforms that hardly move: sway, hover, creep, pan
    python benchmarks/campaign.py --odd --seeds 0:40          # LiDARs, mountings and rates on which nothing has been chosen
    python benchmarks/campaign.py --rough --seeds 0:40        # with what real recordings have besides: rain, people, lost packets
    python benchmarks/campaign.py --merge a.jsonl b.jsonl     # tables of earlier runs, nothing is run; takes --only as well
    python benchmarks/campaign.py --nightly --against runs.jsonl  # and what ended otherwise than before

A seed draws world, motion, sensors, mounting and, in half of the runs, one fault. Every run ends `right`, flagged with the `right
cause`, `flagged`, or `silent`ly wrong; lio_campaign/judge.py says what these mean.
"""

from __future__ import annotations

import argparse
import functools
import json
import multiprocessing
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))  # a spawned process knows the script, not its folder

from lio_campaign.draws import VARIETIES, draw_kinds
from lio_campaign.real import why_not
from lio_campaign.report import against, describe, report
from lio_campaign.run import run_real, run_seed

_SMALL, _NIGHTLY = 40, 1000
_SHARED = Path(__file__).resolve().parents[1].parent / "shared"


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    options = _parse(arguments)
    if options.merge:
        earlier = [line for path in options.merge for line in _read(path)]
        chosen = [line for line in earlier if all(line[key] == value for key, value in options.only)]
        _report(chosen, options.against)
        return
    work = _work(options)
    if isinstance(work, str):
        print(work)
        return
    lines: list[dict[str, Any]] = []
    for line in _runs(*work, options):
        lines.append(line)
        if options.out is not None:
            with options.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
        if options.verbose:
            print(describe(line))
            print(json.dumps(line, indent=1), flush=True)
        else:
            print(f"[{len(lines)}/{len(work[1])}] {describe(line)}", flush=True)
    _report(lines, options.against)


def _report(lines: Sequence[dict[str, Any]], before: Path | None) -> None:
    lines = sorted(lines, key=lambda line: line["seed"])
    print(report(lines))
    if before is not None:
        print(against(lines, _read(before)))


def _read(path: Path) -> list[dict[str, Any]]:
    return [json.loads(row) for row in path.read_text(encoding="utf-8").splitlines()]


Run = Callable[[int], dict[str, Any]]


def _work(options: argparse.Namespace) -> tuple[Run, list[int]] | str:
    """What to do with which seeds, or why nothing can be done."""
    begin, end = options.seeds
    if options.real is None:
        kinds = functools.partial(draw_kinds, variety=options.variety)
        seeds = [seed for seed in range(begin, end) if kinds(seed).matches(dict(options.only))]
        how = {"command_line": options.bag, "rough": options.rough, "variety": options.variety}
        return functools.partial(run_seed, **how), seeds
    missing = why_not(options.shared)
    if missing is not None:
        return f"no recordings with a real IMU: {missing}"
    return functools.partial(run_real, shared=options.shared, rough=options.rough), list(range(begin, begin + options.real))


def _runs(run: Run, seeds: Sequence[int], options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Results as they come, from processes beside this one."""
    with ProcessPoolExecutor(options.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = {pool.submit(run, seed): seed for seed in seeds}
        for future in as_completed(futures):
            problem = future.exception()
            yield future.result() if problem is None else _crashed(futures[future], problem, options)


def _crashed(seed: int, problem: BaseException, options: argparse.Namespace) -> dict[str, Any]:
    """The line of a run that ended in an exception nobody raised on purpose: a user would see a traceback."""
    seen, real = "".join(traceback.format_exception(problem)), options.real is not None
    kinds = asdict(draw_kinds(seed, options.variety))
    if real:  # drawn with its recording, which may be what is missing
        kinds = dict.fromkeys(kinds, "unknown")
    how = {"real": real, "rough": options.rough, "variety": options.variety}
    facts = {"seed": seed, **how, **kinds, "detail": type(problem).__name__}
    verdict = {"verdict": "crashed", "reasons": ["no estimate"], "flags": [seen], "false_alarm": ""}
    return facts | verdict | {"worst_m": None, "falsely_weak_scans": [], "exit_code": 1, "cpu_s": 0.0}


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=_range, help=f"A:B, without B; default 0:{_SMALL}")
    parser.add_argument("--nightly", action="store_true", help=f"{_NIGHTLY} seeds")
    parser.add_argument("--only", type=_pair, action="append", default=[], metavar="KEY=VALUE", help="world, motion, fault …")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="processes")
    parser.add_argument("--bag", action="store_true", help="write bags and run the real command line")
    parser.add_argument("--real", type=int, metavar="N", help="N recordings with a real IMU and motion, from the first seed on")
    parser.add_argument("--rough", action="store_true", help="with rain, people, lost packets and the like")
    variety = parser.add_mutually_exclusive_group()
    for name in [name for name in VARIETIES if name != "usual"]:
        about = f"{VARIETIES[name].what}; not with --real"
        variety.add_argument(f"--{name}", dest="variety", action="store_const", const=name, help=about)
    parser.set_defaults(variety="usual")
    parser.add_argument("--against", type=Path, metavar="FILE", help="earlier lines of the same seeds: what ended otherwise")
    parser.add_argument("--shared", type=Path, default=_SHARED, help="folder with tools/make_lio_recording.py and data/imu")
    parser.add_argument("--out", type=Path, help="append one JSON line a run")
    parser.add_argument("--merge", type=Path, nargs="+", help="only tables, of these JSON lines")
    parser.add_argument("-v", "--verbose", action="store_true", help="all that is known about every run")
    options = parser.parse_args(arguments)
    if options.variety != "usual" and options.real is not None:
        parser.error(f"--{options.variety} makes recordings of its own: without --real")
    options.seeds = options.seeds or (0, _NIGHTLY if options.nightly else _SMALL)
    return options


def _range(text: str) -> tuple[int, int]:
    begin, _, end = text.partition(":")
    return int(begin), int(end or int(begin) + 1)


def _pair(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or key not in ("world", "motion", "sensor", "imu", "extrinsic", "fault", "bag"):
        raise argparse.ArgumentTypeError(f"expected KEY=VALUE with a known key – got {text!r}")
    return key, value


if __name__ == "__main__":
    main()
