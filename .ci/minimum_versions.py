"""Whether the oldest versions that pyproject.toml declares really do: installs exactly those, and runs a little of everything.

    python .ci/minimum_versions.py

The test suite runs with the newest versions; this is the other end. Exit code 0 also where the package index cannot be reached,
which is said; 1 where a version cannot be installed or something fails with it. A few minutes.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
UNREACHABLE = re.compile(r"NewConnectionError|Max retries|ConnectTimeout|ReadTimeout|name resolution|ProxyError|SSLError")

SMOKE = """
import sys
from pathlib import Path
import cv2, fsspec, numpy as np, pyproj, ray, rerun, velodyne_decoder
import boxplus
from boxplus.cli import app
from boxplus.formats.clouds.cloud_file import cloud_writer, read_cloud
from boxplus.formats.geotiff import write_geotiff
from boxplus.recordings import open_recording
from boxplus.simulation import SpinningLidar, simulate, write_recording

folder = Path(sys.argv[1])
small = simulate("walk", duration_s=1.0, lidar=SpinningLidar(azimuth_steps=100))
for kind in ("ros1", "ros2"):
    with open_recording(write_recording(small, folder / kind, kind)) as recording:
        assert sum(isinstance(event, boxplus.Scan) for event in recording) > 5, kind
edges = "".join(f"EDGE_SE2 {i} {(i + 1) % 4} 1 0 1.5708 100 0 0 100 0 400\\n" for i in range(4))
poses = "".join(f"VERTEX_SE2 {i} 0 0 {1.5 * i}\\n" for i in range(4))
(folder / "square.g2o").write_text(poses + edges)
commands = (
    ["demo", "--duration", "5", "-o", str(folder / "demo")],
    ["pgo", str(folder / "square.g2o"), "-o", str(folder / "graph")],
    ["inspect", str(next(folder.glob("ros1*")))],
)
points = np.arange(30.0).reshape(10, 3)
for ending in ("las", "laz", "e57"):
    with cloud_writer(folder / f"a.{ending}") as writer:
        writer.append(points, points[:, 0])
    cloud = read_cloud(folder / f"a.{ending}")
    assert np.allclose(cloud.points, points) and np.allclose(cloud.intensity, points[:, 0]), ending
write_geotiff(folder / "a.tif", points, 0.5, (0.0, 0.0), projection="+proj=tmerc +lat_0=48 +lon_0=11 +datum=WGS84")
for command in commands:
    try:
        app(command, prog_name="boxplus")
    except SystemExit as end:
        assert not end.code or command[0] == "inspect" and end.code == 1, command
"""


EXTRAS = ("report", "las", "e57", "geo", "view", "sensors", "vision", "fleet", "gnss")
"""Optional dependencies that the smoke test uses, or at least imports, as well."""


def minima() -> list[str]:
    """The declared dependencies and those of `EXTRAS`, each at its lower bound."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pinned = []
    for requirement in sum((project["optional-dependencies"][name] for name in EXTRAS), project["dependencies"]):
        bound = re.fullmatch(r"([\w.-]+)\s*>=\s*([\w.]+)((?:\s*,[^;]*)?)\s*(;.*)?", requirement)
        if bound is None:
            sys.exit(f"pyproject.toml: expected NAME>=VERSION - got {requirement!r} - declare a lower bound")
        pinned.append(f"{bound[1]}=={bound[2]}{bound[4] or ''}")
    return pinned


def main() -> int:
    """Install, run, say what came out."""
    if sys.version_info[:2] != (3, 11):
        print(f"minimum versions: skipped, they are tested with Python 3.11 and this is {sys.version.split()[0]}")
        return 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        venv.create(folder / "venv", with_pip=True)
        python = str(folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python")
        pinned = minima()
        install = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *pinned]
        done = subprocess.run(install, capture_output=True, text=True, check=False)
        if done.returncode and UNREACHABLE.search(done.stderr):
            print("minimum versions: skipped, the package index cannot be reached")
            return 0
        if done.returncode:
            print(f"minimum versions: cannot be installed: {', '.join(pinned)}\n{done.stdout}{done.stderr}")
            return 1
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "BOXPLUS_CACHE_DIR": str(folder / "cache")}
        done = subprocess.run(
            [python, "-c", SMOKE, temporary], cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        if done.returncode:
            print(f"minimum versions: something fails with {', '.join(pinned)}\n{done.stdout[-3000:]}{done.stderr[-5000:]}")
            return 1
    print(f"minimum versions: all is well with {', '.join(pinned)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
