"""Under which key compiled code is kept: a hash of the file it comes from and of all that this imports.

A file of boxplus counts with its place in the package, so that the same release in another folder finds what was compiled before.
Every process asks for the keys of the files that it imports, and waits for them: names are looked up in listings of folders.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import sys

import numba

_PACKAGE_ROOT = os.path.dirname(os.path.realpath(__file__))
_IMPORT = re.compile(
    r"^\s*(?:from\s+((?:boxplus|\.)[\w.]*)\s+import\s+"
    r"(\([^)#]*(?:#[^\n]*\n[^)#]*)*\)|[^\n#\\]*(?:\\\r?\n[^\n#\\]*)*)|import\s+(boxplus[\w.]+))",
    re.MULTILINE,
)
_BESIDE_NAMES = re.compile(r"#[^\n]*|[()\\]")  # comments, brackets, lines that go on


@functools.cache
def source_key(file: str) -> str:
    """Hash of `file`, of every boxplus file it depends on, of Numba's version and of the processor.

    Args:
        file: absolute, without symbolic links (`resolved`).
    """
    pending, seen = [file], {file}
    while pending:
        for dependency in _source(pending.pop())[1] - seen:
            seen.add(dependency)
            pending.append(dependency)
    digest = hashlib.sha256(f"{numba.__version__} {sys.implementation.cache_tag} {processor()}".encode())
    for content in sorted(_source(path)[0] for path in seen):
        digest.update(content)
    return digest.hexdigest()[:24]


@functools.cache
def resolved(file: str) -> str:
    """The file itself, where this is a symbolic link, from the root of the file system on."""
    return os.path.realpath(file)


@functools.cache
def processor() -> str:
    """What machine code is made for."""
    from llvmlite import binding

    return f"{binding.get_host_cpu_name()} {binding.get_host_cpu_features().flatten()}"


@functools.cache
def _source(file: str) -> tuple[bytes, frozenset[str]]:
    """Hash of a file, and the boxplus files that it imports directly."""
    with open(file, "rb") as opened:
        content = opened.read()
    place = file[len(_PACKAGE_ROOT) + 1 :].split(os.sep) if file.startswith(_PACKAGE_ROOT + os.sep) else None
    found: set[str] = set()
    for package, names, module in _IMPORT.findall(content.decode("utf-8")):
        if package.startswith("."):  # in the stubs; those of a user's file lead to no file of boxplus
            if place is None:
                continue
            package = ".".join(["boxplus", *place[:-1]]) + package.rstrip(".")
        candidates = [module] if module else [package]
        for name in _BESIDE_NAMES.sub("", names).split(",") if package else ():
            candidates.append(f"{package}.{name.split(' as ')[0].strip()}")
        for candidate in candidates:
            found.update(_module_files(candidate))
    name = file.replace(os.sep, "/") if place is None else "/".join(place)
    return hashlib.sha256(name.encode() + b"\n" + content).digest(), frozenset(found)


@functools.cache
def _module_files(dotted_name: str) -> tuple[str, ...]:
    """The file of a module; of a package also its stub, which says where the names come from that it imports on first use."""
    names = dotted_name.split(".")[1:]
    path = os.path.join(_PACKAGE_ROOT, *names)
    found = []
    beside = _listing(os.path.dirname(path)) if names else frozenset([os.path.basename(path)])
    if names and f"{names[-1]}.py" in beside:
        found.append(f"{path}.py")
    if os.path.basename(path) in beside:
        inside = _listing(path)
        found += [os.path.join(path, name) for name in ("__init__.py", "__init__.pyi") if name in inside]
    return tuple(found)


@functools.cache
def _listing(folder: str) -> frozenset[str]:
    """What is in a folder; nothing where there is none."""
    try:
        return frozenset(os.listdir(folder))
    except OSError:
        return frozenset()
