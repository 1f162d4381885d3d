"""Read a recording as a stream of scans and IMU samples, in constant memory.

    python read_recording.py [RECORDING]

RECORDING is a ROS 1 bag, a ROS 2 folder or file, an MCAP file, a KITTI raw folder or a vendor capture. Without an argument a
short one is simulated and written first.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from boxplus import RecordingOptions, Scan, open_recording, simulate
from boxplus.simulation import write_recording

with tempfile.TemporaryDirectory() as folder:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else write_recording(simulate("walk", duration_s=2.0), Path(folder) / "walk")
    with open_recording(path, RecordingOptions(min_range=1.0)) as recording:
        # What was found out about it, and why: topics, units, point times, extrinsic.
        for finding in recording.info.evidence:
            print(f"{finding.verdict:8}{finding.key:24}{finding.value}")
        scans, samples = 0, 0
        for event in recording:
            if isinstance(event, Scan):
                scans += 1
                median_range = np.median(np.linalg.norm(event.p_lidar, axis=1))
                if scans % 10 == 1:
                    print(f"scan {scans}: {len(event)} points, median range {median_range:.1f} m, {recording.progress:.0%} read")
            else:
                samples += len(event)
        print(f"{scans} scans, {samples} IMU samples; left out: {recording.rejected or 'nothing'}")
