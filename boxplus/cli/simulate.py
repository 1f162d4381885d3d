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
    format: Annotated[Literal["ros2", "ros1"], typer.Option(help="ROS 2 folder (MCAP) or ROS 1 bag.")] = "ros2",
    duration: Annotated[float | None, typer.Option(help="Only the first seconds [s].", min=0.1)] = None,
    list_all: Annotated[bool, typer.Option("--list", help="List the scenarios and the faults.")] = False,
) -> None:
    """Write a simulated recording, its exact ground truth (NAME.gt.tum) and its parameters (NAME.json)."""
    from boxplus.errors import InputError
    from boxplus.simulation.faults import FAULTS, make_fault
    from boxplus.simulation.scenarios import SCENARIOS

    if list_all:
        _print_table("scenarios", {name: description for name, (description, _) in SCENARIOS.items()})
        _print_table("faults", {name: make().description for name, make in FAULTS.items()})
        return
    if scenario is None:
        raise InputError(f"a scenario: {', '.join(SCENARIOS)}", "none", "for example: boxplus simulate walk -o recordings")

    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    from boxplus.simulation.recording_writer import write_recording
    from boxplus.simulation.simulation import simulate

    chosen = make_fault(fault) if fault is not None else None
    simulation = simulate(scenario, seed, duration_s=duration)
    name = scenario if fault is None else f"{scenario}_{fault}"
    columns = (TextColumn(name), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, transient=True) as bar:
        task = bar.add_task(name, total=1.0)
        path = write_recording(simulation, output / name, format, chosen, lambda share: bar.update(task, completed=share))
    seconds = simulation.config.duration_s
    typer.echo(f"{path}: {simulation.scan_count} scans, {seconds:.1f} s")
    typer.echo(f"{output / name}.gt.tum: exact pose of the IMU at 100 Hz")


def _print_table(title: str, rows: dict[str, str]) -> None:
    typer.echo(f"{title}:")
    for name, description in rows.items():
        typer.echo(f"  {name:20}{description}")
