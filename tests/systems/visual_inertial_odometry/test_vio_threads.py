"""The same bits for any number of threads: those of BLAS and those of OpenCV."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from boxplus.systems.visual_inertial_odometry import VioConfig
from boxplus.systems.visual_inertial_odometry.corners.tracking import FeatureTracker
from tests.systems.visual_inertial_odometry.simulated_rays import PIXEL_SIGMA, Flight, rig, run


def _digest_of_a_run() -> str:
    """Of everything that a run from rest, through start, window and priors, says."""
    _, estimates = run(Flight(3, 4.5), rig(), VioConfig(pixel_sigma=PIXEL_SIGMA, keyframes=5))
    assert sum(e.status == "ok" for e in estimates) > 40
    digest = hashlib.sha256()
    for e in estimates:
        for values in (e.T_world_imu, e.velocity_world, e.gyro_bias, e.accel_bias, e.covariance, e.landmarks, e.landmark_sigmas):
            digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


@pytest.mark.slow
@pytest.mark.skipif(bool(os.environ.get("NUMBA_DISABLE_JIT")), reason="too slow without the compiler")
def test_the_threads_of_blas_change_no_bit() -> None:
    root = str(Path(__file__).parents[3])
    found = set()
    for threads in ("1", "3"):
        limits = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), threads)
        environment = {**os.environ, **limits, "PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])}
        code = f"from {__name__} import _digest_of_a_run; print(_digest_of_a_run())"
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=root, check=False
        )
        assert done.returncode == 0, done.stderr
        found.add(done.stdout.strip())
    assert len(found) == 1


def test_the_threads_of_opencv_change_no_bit() -> None:
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(5)
    texture = cv2.GaussianBlur(rng.integers(0, 256, (520, 800)).astype(np.uint8), (0, 0), 2.0)
    its = rig()
    images = [[np.ascontiguousarray(texture[k : k + 480, 2 * k + s : 2 * k + s + 752]) for s in (8, 0)] for k in range(4)]
    before = cv2.getNumThreads()
    found = []
    try:
        for threads in (1, 4):
            cv2.setNumThreads(threads)
            tracker = FeatureTracker(VioConfig(), its)
            bits = []
            for k, (left, right) in enumerate(images):
                tracks = tracker.detect(tracker.track(k * 50_000_000, {0: left, 1: right}, np.eye(3)))
                assert len(tracks) > 50
                bits.append((tracks.ids.tobytes(), tracks.pixels.tobytes(), tracks.rays.tobytes()))
            found.append(bits)
    finally:
        cv2.setNumThreads(before)
    assert found[0] == found[1]
