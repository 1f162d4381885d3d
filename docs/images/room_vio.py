"""Draws room_vio.png, the picture of the README: `python docs/images/room_vio.py` (a minute; needs OpenCV).

A simulated hand-held stereo camera in a room: what the left camera sees, and the path and landmarks that visual-inertial odometry
finds, from above, with the true path below them.
"""

import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.formats.clouds.ply import read_ply
from boxplus.formats.trajectory import read_trajectory
from boxplus.recordings.cameras.open import open_camera_recording
from boxplus.sensors.images.camera_image import CameraImage

SHOWN = 330  # image to show


def run(*arguments: str) -> None:
    """One command of boxplus."""
    done = CliRunner().invoke(app, list(arguments))
    if done.exit_code:
        raise SystemExit(done.output)


with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    run("simulate", "room", "--camera", "stereo", "--scale", "0.5", "--rate", "15", "-o", str(folder))
    run("vio", str(folder / "room_stereo"), "--gt", str(folder / "room_stereo.gt.tum"), "-o", str(folder / "run"), "--no-report")
    path, truth = read_trajectory(folder / "run" / "trajectory.tum"), read_trajectory(folder / "room_stereo.gt.tum")
    landmarks = read_ply(folder / "run" / "landmarks.ply").points
    images = [
        event for event in open_camera_recording(folder / "room_stereo") if isinstance(event, CameraImage) and not event.camera
    ]
    image = images[SHOWN].grey()

# The truth in the frame of the estimate, which begins at zero: turned by the yaw and moved by the start of the path.
here = truth.p[np.searchsorted(truth.time_ns, path.time_ns).clip(max=len(truth.p) - 1)]
a, b = path.p[:, :2] - path.p[:, :2].mean(axis=0), here[:, :2] - here[:, :2].mean(axis=0)
yaw = np.angle(((b[:, 0] - 1j * b[:, 1]) * (a[:, 0] + 1j * a[:, 1])).sum())
turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
moved = (here[:, :2] - here[:, :2].mean(axis=0)) @ turn.T + path.p[:, :2].mean(axis=0)

figure = Figure(figsize=(9.0, 3.1), layout="constrained")
left, right = figure.subplots(1, 2, width_ratios=[1.35, 1.0])
left.imshow(image, cmap="gray", vmin=0, vmax=float(np.percentile(image, 99.5)))
left.set_axis_off()
heights = landmarks[:, 2]
order = np.argsort(heights)
right.scatter(landmarks[order, 0], landmarks[order, 1], s=1.0, c=heights[order], cmap="viridis", linewidths=0)
right.plot(moved[:, 0], moved[:, 1], color="#e09f3e", linewidth=2.6, label="truth")
right.plot(path.p[:, 0], path.p[:, 1], color="#22303c", linewidth=1.0, label="vio")
low, high = np.percentile(landmarks[:, :2], [1, 99], axis=0)
right.set(xlim=(low[0] - 0.3, high[0] + 0.3), ylim=(low[1] - 0.3, high[1] + 0.3), aspect="equal", xlabel="x [m]", ylabel="y [m]")
right.legend(fontsize=8, loc="upper right")
right.tick_params(labelsize=8)
figure.savefig(Path(__file__).with_suffix(".png"), dpi=85, pil_kwargs={"optimize": True})
