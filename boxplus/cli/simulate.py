"""`boxplus simulate`: write a simulated recording with its ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def simulate_command(
    scenario: Annotated[str | None, typer.Argument(help="What to simulate; --list shows the choice.")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write into.", metavar="DIR")] = Path(),
    seed: Annotated[int, typer.Option(help="Seed of world, motion and noise.", min=0)] = 0,
    fault: Annotated[str | None, typer.Option(help="What goes wrong; --list shows the choice.")] = None,
    format: Annotated[
        Literal["ros2", "ros1", "euroc", "tum"] | None,
        typer.Option(help="ROS 2 folder (MCAP) or ROS 1 bag; of cameras EuRoC or TUM RGB-D folder as well."),
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Only the first seconds [s].", min=0.1)] = None,
    camera: Annotated[
        Literal["mono", "stereo", "rgbd"] | None, typer.Option(help="Cameras and IMU in place of LiDAR and IMU.")
    ] = None,
    lens: Annotated[Literal["pinhole", "radtan", "equidistant"] | None, typer.Option(help="Lens of the cameras.")] = None,
    scale: Annotated[float, typer.Option(help="Factor on the 752 x 480 pixels of the cameras.", min=0.05, max=4.0)] = 1.0,
    rate: Annotated[float, typer.Option(help="Images a second [Hz].", min=1.0, max=200.0)] = 20.0,
    gnss: Annotated[
        Literal["good", "multipath", "late", "swapped"] | None,
        typer.Option(help="A satellite receiver beside LiDAR and IMU, and what is wrong with it."),
    ] = None,
    list_all: Annotated[bool, typer.Option("--list", help="List the scenarios and the faults.")] = False,
) -> None:
    """Write a simulated recording, its exact ground truth (NAME.gt.tum) and its parameters (NAME.json)."""
    from boxplus.errors import InputError
    from boxplus.simulation.cameras.faults import CAMERA_FAULTS
    from boxplus.simulation.cameras.scenarios import CAMERA_SCENARIOS
    from boxplus.simulation.faults import FAULTS
    from boxplus.simulation.scenarios import SCENARIOS

    if list_all:
        _print_table("scenarios", {name: description for name, (description, _) in SCENARIOS.items()})
        _print_table("faults", {name: make().description for name, make in FAULTS.items()})
        filmed = {name: description for name, (description, _) in CAMERA_SCENARIOS.items()}
        _print_table("scenarios of cameras (--camera), and those above", filmed)
        _print_table("faults of cameras", {name: make().description for name, make in CAMERA_FAULTS.items()})
        return
    if scenario is None:
        raise InputError(f"a scenario: {', '.join(SCENARIOS)}", "none", "for example: boxplus simulate walk -o recordings")
    if camera is None and scenario in CAMERA_SCENARIOS and scenario not in SCENARIOS:
        raise InputError("--camera with a scenario of cameras", "none", "add --camera stereo")
    if camera is None and (lens is not None or format in ("euroc", "tum")):
        raise InputError("--camera with --lens and with formats of cameras", "none", "add --camera stereo")
    if camera is not None and gnss is not None:
        raise InputError("--gnss with a LiDAR", "--camera", "leave one of them out")
    if camera is None:
        _simulate_lidar(scenario, output, seed, fault, "ros1" if format == "ros1" else "ros2", duration, gnss)
        return

    from boxplus.simulation.cameras import make_camera_fault, make_rig, simulate_cameras, write_camera_recording

    chosen = make_camera_fault(fault) if fault is not None else None
    simulation = simulate_cameras(scenario, seed, duration_s=duration, rig=make_rig(camera, lens, scale, rate))
    name = "_".join(part for part in (scenario, camera, fault) if part)
    wanted = format or ("tum" if camera == "rgbd" else "euroc")
    with _Progress(name) as progress:
        path = write_camera_recording(simulation, output / name, wanted, chosen, progress=progress.show)
    typer.echo(f"{path}: {simulation.image_count} x {len(simulation.names)} images, {simulation.config.duration_s:.1f} s")
    typer.echo(f"{output / name}.gt.tum: exact pose of the IMU at 100 Hz")
    typer.echo(f"{output / name}.calib.yaml: Kalibr camchain")


def _simulate_lidar(
    scenario: str,
    output: Path,
    seed: int,
    fault: str | None,
    format: Literal["ros2", "ros1"],
    duration: float | None,
    gnss: str | None,
) -> None:
    from boxplus.simulation.faults import make_fault
    from boxplus.simulation.gnss import RECEIVERS
    from boxplus.simulation.recording_writer import write_recording
    from boxplus.simulation.simulation import simulate

    chosen = make_fault(fault) if fault is not None else None
    simulation = simulate(scenario, seed, duration_s=duration)
    name = "_".join(part for part in (scenario, fault, gnss and f"gnss_{gnss}") if part)
    with _Progress(name) as progress:
        path = write_recording(simulation, output / name, format, chosen, progress.show, RECEIVERS[gnss] if gnss else None)
    typer.echo(f"{path}: {simulation.scan_count} scans, {simulation.config.duration_s:.1f} s")
    typer.echo(f"{output / name}.gt.tum: exact pose of the IMU at 100 Hz")


class _Progress:
    """A bar that goes away when the work is done."""

    def __init__(self, name: str) -> None:
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

        from boxplus.cli.terminal.console import make_console

        columns = (TextColumn(name), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        console = make_console()
        self._bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._bar.add_task(name, total=1.0)

    def __enter__(self) -> _Progress:
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def show(self, share: float) -> None:
        """The share that is done, 0 to 1."""
        self._bar.update(self._task, completed=share)


def _print_table(title: str, rows: dict[str, str]) -> None:
    width = max(20, max(map(len, rows)) + 2)
    typer.echo(f"{title}:")
    for name, description in rows.items():
        typer.echo(f"  {name:{width}}{description}")
