"""What mkdocs adds to docs/ when it makes the site: navigation, reference, and the files outside of docs/ that pages link to.

The pages stay what they are on disk, and their links lead somewhere there as well. Here
- the navigation is that of docs/index.md (and of docs/residuals/index.md), so that a page is listed in one place only;
- the reference is one page a folder of the package, with every public name (those of the stubs) and its docstring;
- README.md, CONTRIBUTING.md, CHANGELOG.md, sources, examples and the notebook become pages where a page links to them;
- nothing may be loaded from another server: a page that would is refused.
"""

from __future__ import annotations

import ast
import base64
import json
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"\]\(([^)#\s]+)(#[^)\s]*)?\)")
LANGUAGES = {".py": "python", ".yml": "yaml", ".toml": "toml", ".sh": "bash"}
ROOMS = {
    "systems": "Estimators",
    "filtering": "Filter",
    "sensors": "What sensors deliver",
    "recordings": "Recordings",
    "runs": "Inspection",
    "optimization": "Problems and solvers",
    "residuals": "Residuals",
    "manifolds": "Manifolds",
    "cameras": "Cameras",
    "sparse": "Sparse factorisation",
    "maps": "Maps",
    "formats": "Files",
    "evaluation": "Evaluation",
    "simulation": "Simulation",
    "errors": "Errors",
}
"""Pages of the reference, in this order. A folder with public names that is not listed is refused."""
ORIGIN: dict[str, str] = {}
"""The file of the repository that a page is made from; of the others it is the one in docs/ of the same name."""


def public_names() -> dict[str, str]:
    """Where each public object lives, by the shortest name that it can be imported by."""
    names: dict[str, str] = {}
    for stub in sorted((ROOT / "boxplus").rglob("*.pyi"), key=lambda path: len(path.parts)):
        package = ".".join(stub.parent.relative_to(ROOT).parts)
        for node in ast.parse(stub.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.module is not None:
                for alias in node.names:
                    names.setdefault(f"{package}.{node.module}.{alias.name}", f"{package}.{alias.name}")
    losses = ROOT / "boxplus" / "optimization" / "losses.py"
    for definition in ast.parse(losses.read_text(encoding="utf-8")).body:
        if isinstance(definition, ast.ClassDef) and not definition.name.startswith("_"):
            names.setdefault(f"boxplus.optimization.losses.{definition.name}", f"boxplus.losses.{definition.name}")
    return {public: home for home, public in names.items() if public != "boxplus.optimization.losses"}


def entry(public: str, home: str) -> str:
    """What mkdocstrings makes the description of one object from. What the solver calls is described once for all residuals."""
    filters = '["!^_"]' if public == "boxplus.residuals.Residual" else '["!^_", "!_into$"]'
    heading = f'      heading: "{public}"\n      toc_label: "{public.rpartition(".")[2]}"\n'
    return f"::: {home}\n    options:\n{heading}      filters: {filters}\n"


def reference() -> dict[str, str]:
    """The pages of the reference, by name."""
    rooms: dict[str, list[str]] = {}
    for public, home in public_names().items():
        room = home.split(".")[1]
        if room not in ROOMS:
            raise PluginError(f"{public} lives in boxplus/{room}, which .ci/site.py does not list")
        rooms.setdefault(room, []).append(entry(public, home))
    pages = {f"api/{room}.md": f"# {ROOMS[room]}\n\n" + "\n".join(rooms[room]) for room in ROOMS}
    listed = "\n".join(f"- [{ROOMS[room]}]({room}.md)" for room in ROOMS)
    pages["api/index.md"] = (
        "# Reference\n\nEvery public class and function, from its docstring. Examples take `import numpy as np` and "
        f"`import boxplus as bp` for granted and are run by the tests.\n\n{listed}\n"
    )
    return pages


def notebook(path: Path, pictures: dict[str, bytes]) -> str:
    """A notebook as Markdown: texts, code and what it printed. What it drew is added to `pictures`."""
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            if "text" in output:
                parts.append(f"```text\n{''.join(output['text']).rstrip()}\n```")
            elif "image/png" in output.get("data", {}):
                name = f"{path.stem}_{len(pictures)}.png"
                pictures[name] = base64.b64decode("".join(output["data"]["image/png"]))
                parts.append(f"![What the code above drew]({name})")
    return "\n\n".join(parts)


def page_of(path: str) -> str | None:
    """The page of the site that shows a file of the repository; None for what mkdocs takes as it is."""
    if path.startswith("docs/") and not path.endswith((".py", ".ipynb")):
        return None
    if path.startswith("docs/"):
        return path.removeprefix("docs/") + ".md"
    if path == "README.md":
        return "readme_page.md"  # mkdocs takes README.md for the first page, which is docs/index.md
    return path if path.endswith(".md") else f"source/{path}.md"


def resolved(page: str, target: str) -> str:
    """The file of the repository that a link of a page leads to."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(ORIGIN.get(page, f"docs/{page}")), target))


def shown(path: str, pictures: dict[str, bytes]) -> str:
    """A file as Markdown."""
    if path.endswith(".md"):
        return (ROOT / path).read_text(encoding="utf-8")
    if path.endswith(".ipynb"):
        return notebook(ROOT / path, pictures)
    if (ROOT / path).is_dir():
        names = sorted(entry.name for entry in (ROOT / path).iterdir() if not entry.name.startswith((".", "_")))
        return f"# {path}\n\n" + "\n".join(f"- `{name}`" for name in names)
    language = LANGUAGES.get(Path(path).suffix, "text")
    return f"# {path}\n\n````{language}\n{(ROOT / path).read_text(encoding='utf-8')}\n````\n"


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made."""
    made, pictures = reference(), dict[str, bytes]()
    waiting = {file.src_uri: file.content_string for file in files if file.is_documentation_page()}
    while waiting:
        page, text = waiting.popitem()
        for target, _ in LINK.findall(text):
            path = resolved(page, target)
            extra = page_of(path) if (ROOT / path).exists() and "://" not in target else None
            if extra is not None and extra not in made:
                made[extra], ORIGIN[extra] = shown(path, pictures), path
                if path.endswith(".md"):
                    waiting[extra] = made[extra]
    for name, content in {**made, **pictures}.items():
        files.append(File.generated(config, name, content=content))
    config.nav = navigation()
    return files


def navigation() -> list[Any]:
    """The sections of docs/index.md as the navigation, the residuals' pages within theirs, and the reference."""
    nav: list[Any] = [{"boxplus": "index.md"}]
    for section in re.split(r"^## ", (ROOT / "docs" / "index.md").read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]:
        entries: list[Any] = []
        for title, target in re.findall(r"^- \[([^\]]+)\]\(([^)#]+)\)", section, re.MULTILINE):
            page = page_of(resolved("index.md", target)) or target
            entries.append({title: residual_pages() if page == "residuals/index.md" else page})
        nav.append({section.splitlines()[0]: entries})
    nav.append({"Reference": ["api/index.md", *({title: f"api/{room}.md"} for room, title in ROOMS.items())]})
    return nav


def residual_pages() -> list[Any]:
    """The page of all residuals and those that it lists."""
    text = (ROOT / "docs" / "residuals" / "index.md").read_text(encoding="utf-8")
    pages = dict.fromkeys(re.findall(r"\]\((\w+\.md)\)", text))
    return ["residuals/index.md", *(f"residuals/{page}" for page in pages)]


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turn links to files outside of docs/ into links to their pages."""

    def turned(match: re.Match[str]) -> str:
        target, anchor = match[1], match[2] or ""
        path = resolved(page.file.src_uri, target)
        if "://" in target or not (ROOT / path).exists():
            return match[0]
        shown_at = page_of(path) or path.removeprefix("docs/")
        return f"]({posixpath.relpath(shown_at, posixpath.dirname(page.file.src_uri) or '.')}{anchor})"

    if page.file.src_uri.startswith(("source/", "api/")):
        return markdown
    return LINK.sub(turned, markdown)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """Refuse what would be loaded from another server."""
    loaded = re.findall(r'<(?:script|img|iframe|source)[^>]*\ssrc="(https?://[^"]+)"', output)
    loaded += re.findall(r'<link[^>]*\srel="(?:stylesheet|preconnect|icon)"[^>]*\shref="(https?://[^"]+)"', output)
    if loaded:
        raise PluginError(f"{page.file.src_uri} would load {loaded[0]} from another server")
    return output
