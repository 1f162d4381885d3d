"""Whether a map of other lengths is named by what follows in it: right maps, and maps that are a factor too long or short.

    python benchmarks/map_lengths_campaign.py --worlds hall,city --seeds 3 --scales 1,1.01,0.98
    python benchmarks/map_lengths_campaign.py --worlds hall,city --seeds 3 --sensor narrow

Maps, days and sensors are those of `localization_campaign.py`; each drive of 10 s is followed from the truth on, so that what a
search does not find in a map of other lengths is compared all the same. A right map that is doubted is a false alarm; of the
others those are counted that are doubted at the end. Limits were chosen on even seeds.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

import numpy as np
from localization_campaign import AHEAD, NARROW_SENSOR, OTHER_SENSOR, SITES, another_day, map_of

from boxplus.manifolds import se3
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.runs.saved_map.saved_map import SavedMap
from boxplus.simulation.drifting_drive import DriftConfig, DriftingDrive, simulate_drifting_drive
from boxplus.systems.localization.config import LocalizationConfig
from boxplus.systems.localization.map_lengths import MapLengths
from boxplus.systems.localization.tracking import Tracker

START_SIGMA = np.repeat([0.01, 0.1], 3)


@dataclass(frozen=True)
class Followed:
    """What came of one drive: the map's lengths over those seen and σ of that [%], whether doubted, share of scans registered."""

    percent: float
    sigma: float
    is_doubted: bool
    share: float


def follow(saved: SavedMap, drive: DriftingDrive, scale: float, ahead: float) -> Followed:
    """One drive, from where it begins in the map."""
    config, lengths = LocalizationConfig(), MapLengths()
    T_start = drive.T_world_body[0].copy()
    T_start[4:] *= scale
    tracker = Tracker(saved, T_start, np.diag(START_SIGMA**2), config)
    tried_ns, tried, taken = -1, 0, 0
    for k, (time_ns, T, scan) in enumerate(zip(drive.time_ns.tolist(), drive.T_odo_body, drive.scans, strict=True)):
        if k:
            step = se3.compose(se3.inverse(drive.T_odo_body[k - 1]), T)
            tracker.predict(step, (time_ns - int(drive.time_ns[k - 1])) * 1e-9)
            lengths.walk(float(np.linalg.norm(step[4:])))
        if tried_ns >= 0 and (time_ns - tried_ns) * 1e-9 < config.track_interval:
            continue
        tried_ns, is_due = time_ns, lengths.is_due
        seen = scan[np.abs(np.arctan2(scan[:, 1], scan[:, 0])) <= ahead]
        matched = tracker.correct(seen, np.eye(3), with_lengths=is_due)  # these drives are level
        tried, taken = tried + 1, taken + (matched.measured > 0)
        if is_due and matched.measured:
            lengths.see(matched.lengths)
    log_ratio, sigma = lengths.log_ratio
    return Followed(100.0 * math.expm1(log_ratio), 100.0 * sigma, lengths.doubt is not None, taken / max(tried, 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default="hall,city,warehouse,storey,corridors,street,forest", help="comma-separated")
    parser.add_argument("--seeds", default="3", help="comma-separated")
    parser.add_argument("--scales", default="1,1.01,0.98", help="of the map, comma-separated")
    parser.add_argument("--sensor", choices=tuple(AHEAD), default="rings")
    parser.add_argument("--starts", type=int, default=2, help="drives in each world")
    options = parser.parse_args()
    doubted: dict[float, list[bool]] = {}
    for name in options.worlds.split(","):
        site = SITES[name]
        sensor = DriftConfig(**{**site.sensor, **(NARROW_SENSOR if options.sensor == "narrow" else OTHER_SENSOR)})
        for seed in map(int, options.seeds.split(",")):
            world = site.world(seed)
            mapped = simulate_drifting_drive(world, site.route, DriftConfig(**site.sensor), seed)
            drives = []
            for start in range(1000 * seed, 1000 * seed + options.starts):
                route = site.start(np.random.Generator(np.random.PCG64([start, 902])))
                drives.append(simulate_drifting_drive(another_day(world, start), route, sensor, start))
            for scale in map(float, options.scales.split(",")):
                saved = map_of(mapped, LocalMapConfig(max_range=50.0), "right" if scale == 1.0 else "scaled", scale)
                for number, drive in enumerate(drives):
                    found = follow(saved, drive, scale, AHEAD[options.sensor])
                    doubted.setdefault(scale, []).append(found.is_doubted)
                    said = "DOUBTED" if found.is_doubted else ""
                    print(f"{name:10s} {seed} {number} x {scale:g}: {found.percent:+.2f} ± {found.sigma:.2f} %, "
                          f"{100 * found.share:.0f} % of the scans registered {said}", flush=True)  # fmt: skip
    for scale, told in doubted.items():
        print(f"x {scale:g}: {sum(told)} of {len(told)} doubted", flush=True)


if __name__ == "__main__":
    main()
