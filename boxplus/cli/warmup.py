"""`boxplus warmup`: compile the kernels of the main job before they are needed."""

from __future__ import annotations


def warmup() -> None:
    """Compile everything now, so that the first run does not have to. Takes half a minute, once."""
    import tempfile
    import time
    from pathlib import Path

    from rich.console import Console

    from boxplus._jit import cache_root
    from boxplus.simulation import SpinningLidar, simulate
    from boxplus.simulation.live_recording import as_recording
    from boxplus.systems.odometry_run import Progress, run_odometry
    from boxplus.systems.run_config import load_run_config

    console = Console(highlight=False)
    began = time.perf_counter()
    # A car in a map box so small that it slides: every kernel of a run is called.
    odometry = {"threads": 2, "box_side": 40.0, "detection_range": 5.0, "extrinsic_estimation": "on"}
    recording = as_recording(simulate("moving_start", duration_s=3.0, lidar=SpinningLidar(azimuth_steps=500)))
    with console.status("compiling kernels …") as status, tempfile.TemporaryDirectory() as folder:

        def show(progress: Progress) -> None:
            if progress.compiling is not None:
                status.update(f"compiling kernels … {progress.compiling}")

        summary = run_odometry(recording, Path(folder) / "run", load_run_config(overrides={"odometry": odometry}), progress=show)
    compiled = summary.timing.compiled_kernels
    what = f"{compiled} kernels compiled" if compiled else "nothing to compile, all kernels were ready"
    console.print(f"{what} in {time.perf_counter() - began:.1f} s, kept in {cache_root()}", soft_wrap=True)
