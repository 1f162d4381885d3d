"""Settings in sections, from a YAML file and from single values, checked where they enter."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from boxplus._settings import refusal, suggestion
from boxplus.errors import InputError

ConfigT = TypeVar("ConfigT", bound=BaseModel)
Sections = Mapping[str, type[BaseModel]]


class _Yaml(yaml.SafeLoader):  # type: ignore[misc]
    """As YAML 1.2: only true and false are truth values; `off` and `on` are words, as `extrinsic_estimation` takes them."""

    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:bool"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


_Yaml.add_implicit_resolver("tag:yaml.org,2002:bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF"))


def load_settings(
    kind: type[ConfigT],
    path: str | Path | None = None,
    settings: Iterable[str] = (),
    overrides: Mapping[str, Mapping[str, object]] | None = None,
) -> ConfigT:
    """Settings from a YAML file, then single `key=value` texts, then overrides; the later ones win.

    Args:
        kind: the settings of a run, a model of sections which are models of keys.
        path: YAML file with these sections, each optional; also the `config.yaml` of a run.
        settings: texts such as `scan_voxel=0.5` or `map.voxel=0.2`, values in YAML.
        overrides: section → key → value.

    Raises:
        InputError: the file cannot be read, a key is unknown, or a value is not valid.
    """
    sections = _sections(kind)
    tree = {section: dict[str, object]() for section in sections}
    if path is not None:
        for section, values in _read_yaml(Path(path), sections).items():
            tree[section].update(values)
    for text in settings:
        section, key, value = _parse_setting(text, sections)
        tree[section][key] = value
    for section, override in (overrides or {}).items():
        tree[section].update(override)
    for section, values in tree.items():
        for key in values:
            _check_key(section, key, sections)
    try:
        return kind.model_validate(tree)
    except ValidationError as error:
        raise refusal(kind, error, lambda place: ".".join(map(str, place))) from None


def dump_settings(head: str, used: Mapping[str, object]) -> str:
    """The text of a `config.yaml`: comment lines, then sections of settings as `load_settings` reads them."""
    body: str = yaml.safe_dump(dict(used), sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
    return head + body


def _sections(kind: type[BaseModel]) -> Sections:
    """The models of the sections by name."""
    return {
        name: field.annotation
        for name, field in kind.model_fields.items()
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
    }


def _read_yaml(path: Path, known: Sections) -> dict[str, dict[str, object]]:
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), _Yaml)
    except OSError as error:
        raise InputError("a readable configuration file", f"{path}: {error.strerror}", "check the path") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        where = getattr(error, "problem_mark", None)
        line = f", line {where.line + 1}" if where is not None else ""
        raise InputError(
            "a YAML file", f"{path}{line}: {getattr(error, 'problem', None) or error}", "correct the file"
        ) from error
    sections = f"the sections {', '.join(known)}"
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError(
            f"a YAML file with {sections}", f"none of them in {path}", f"write e.g. '{_example(known)[0]}:' and keys below"
        )
    for section, values in content.items():
        if section not in known:
            home = [name for name, model in known.items() if section in model.model_fields]
            advice = f"write it below '{home[0]}:'" if home else suggestion(str(section), list(known), "section")
            raise InputError(f"{sections} in {path}", f"{section!r}", advice)
        if values is not None and not isinstance(values, dict):
            raise InputError(f"keys and values below '{section}:' in {path}", repr(values), "write one 'key: value' a line")
        for key in values or {}:
            if not isinstance(key, str):
                raise InputError(
                    f"names of settings below '{section}:' in {path}", repr(key), f"write e.g. '{_example(known)[1]}'"
                )
    return {section: values or {} for section, values in content.items()}


def _parse_setting(text: str, sections: Sections) -> tuple[str, str, object]:
    name, equals, value = text.partition("=")
    if not equals:
        raise InputError("a setting as key=value", repr(text), f"write e.g. --set {_example(sections)[1].replace(': ', '=')}")
    section, dot, key = name.strip().rpartition(".")
    if not dot:
        homes = [candidate for candidate, model in sections.items() if key in model.model_fields]
        known = sorted(f"{candidate}.{known}" for candidate, model in sections.items() for known in model.model_fields)
        # `voxel` is the map's: whoever writes it may as well mean the `scan_voxel` of another section.
        alike = [other for other in known if key in other.partition(".")[2].split("_") and other.partition(".")[0] not in homes]
        if len(homes) != 1 or alike:
            raise InputError("the name of a setting", repr(key), suggestion(key, known, "setting"))
        section = homes[0]
    if section not in sections:
        raise InputError(f"a section ({', '.join(sections)})", repr(section), suggestion(section, list(sections), "section"))
    try:
        return section, key, yaml.load(value, _Yaml)
    except yaml.YAMLError as error:
        raise InputError(f"a value for {section}.{key}", repr(value), "write a number, a word or a [list]") from error


def _example(sections: Sections) -> tuple[str, str]:
    """A section, and a setting of it as the YAML file has it."""
    if "odometry" in sections and "scan_voxel" in sections["odometry"].model_fields:
        return "odometry", "scan_voxel: 0.5"
    numbers = (
        (section, f"{key}: {field.default}")
        for section, model in sections.items()
        for key, field in model.model_fields.items()
        if isinstance(field.default, (int, float)) and not isinstance(field.default, bool)
    )
    return next(numbers)


def _check_key(section: str, key: str, sections: Sections) -> None:
    known = list(sections[section].model_fields)
    if key not in known:
        raise InputError(f"a known setting in section '{section}'", repr(key), suggestion(key, known, "setting"))
