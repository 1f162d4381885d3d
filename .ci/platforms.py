"""Whether every dependency has a wheel on the platforms that the README names: nobody should need a compiler.

    python .ci/platforms.py

Asks pip what it would install, for each platform and Python, without installing or building anything. Exit code 0 also where the
package index cannot be reached, which is said; 1 where something has no wheel. Two minutes.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
UNREACHABLE = re.compile(r"NewConnectionError|Max retries|ConnectTimeout|ReadTimeout|name resolution|ProxyError|SSLError")
PLATFORMS = {
    "Windows x86-64": ["win_amd64"],
    "Linux x86-64": ["manylinux_2_28_x86_64", "manylinux_2_17_x86_64"],
    "Linux aarch64 (Jetson, Raspberry Pi)": ["manylinux_2_28_aarch64", "manylinux_2_17_aarch64"],
    "macOS 14 on Apple silicon": [f"macosx_{version}_0_arm64" for version in range(11, 15)],
}
CHECKED_EXTRAS = ("report", "las", "e57", "geo")
KNOWN_TO_LACK = {"Linux aarch64 (Jetson, Raspberry Pi)": {"e57"}}
"""What the documentation says is missing there."""
PYTHONS = ("3.11", "3.14")
"""The oldest and the newest that are supported."""


def resolved(requirements: list[str], tags: list[str], python: str) -> subprocess.CompletedProcess[str]:
    """What pip says when it is asked for wheels of these requirements."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed", "--only-binary=:all:"]
        where = [f"--platform={tag}" for tag in tags] + [f"--python-version={python}", f"--target={folder}"]
        return subprocess.run([*command, *where, *requirements], capture_output=True, text=True, check=False)


def main() -> int:
    """Ask for every combination, say what came out."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    dependencies = project["dependencies"]
    extras = project["optional-dependencies"]
    failed = False
    for name, tags in PLATFORMS.items():
        for python in PYTHONS:
            run = resolved(dependencies, tags, python)
            if run.returncode and (UNREACHABLE.search(run.stderr) or resolved(["numpy"], tags, python).returncode):
                print(f"platforms: not checked, the package index cannot be reached or has no wheels at all for {name}")
                return 0
            print(f"platforms: Python {python} on {name}: {'no wheel' if run.returncode else 'wheels for everything'}")
            if run.returncode:
                print("\n".join(line for line in run.stderr.splitlines() if "ERROR" in line))
                failed = True
            lacking = [extra for extra in CHECKED_EXTRAS if resolved(extras[extra], tags, python).returncode]
            if set(lacking) - KNOWN_TO_LACK.get(name, set()):
                print(f"platforms: Python {python} on {name}: no wheel for the extras {', '.join(lacking)}")
                failed = True
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
