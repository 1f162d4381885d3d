"""Everything that can be set for an odometry run, from a YAML file and from single values."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from boxplus.errors import InputError
from boxplus.recordings.info import RecordingInfo
from boxplus.recordings.options import NO_POINT_TIME, RecordingOptions
from boxplus.systems.lidar_inertial_odometry.config import LioConfig


class MapConfig(BaseModel):
    """What is kept of the map on disk. The filter's own map in memory is not affected."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    save: bool = Field(True, description="stream the registered points to map tiles while running")
    voxel: float | None = Field(
        0.1,
        ge=0.001,
        description="keep one point per voxel of this edge [m], which bounds the disk space; null keeps every point",
    )
    tile_size: float = Field(50.0, gt=0, description="edge of the cubic map tiles [m]")
    ply: bool = Field(True, description="merge the tiles to map.ply at the end")
    pcd: bool = Field(True, description="merge the tiles to map.pcd at the end")


class RunConfig(BaseModel):
    """Settings of an odometry run; this is what `config.yaml` holds. None has to be given."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    recording: RecordingOptions = Field(default_factory=lambda: RecordingOptions())
    odometry: LioConfig = Field(default_factory=lambda: LioConfig())  # type: ignore[call-arg]
    map: MapConfig = Field(default_factory=lambda: MapConfig())  # type: ignore[call-arg]


_SECTIONS: dict[str, type[BaseModel]] = {"recording": RecordingOptions, "odometry": LioConfig, "map": MapConfig}


class _Yaml(yaml.SafeLoader):  # type: ignore[misc]
    """As YAML 1.2: only true and false are truth values; `off` and `on` are words, as `extrinsic_estimation` takes them."""

    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:bool"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


_Yaml.add_implicit_resolver("tag:yaml.org,2002:bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF"))


def load_run_config(
    path: str | Path | None = None,
    settings: Iterable[str] = (),
    overrides: Mapping[str, Mapping[str, object]] | None = None,
) -> RunConfig:
    """Settings from a YAML file, then single `key=value` texts, then overrides; the later ones win.

    Args:
        path: YAML file with the sections `recording`, `odometry` and `map`, each optional; also the `config.yaml` of a run.
        settings: texts such as `scan_voxel=0.5` or `map.voxel=0.2`, values in YAML.
        overrides: section → key → value.

    Raises:
        InputError: the file cannot be read, a key is unknown, or a value is not valid.
    """
    tree = {section: dict[str, object]() for section in _SECTIONS}
    if path is not None:
        for section, values in _read_yaml(Path(path)).items():
            tree[section].update(values)
    for text in settings:
        section, key, value = _parse_setting(text)
        tree[section][key] = value
    for section, override in (overrides or {}).items():
        tree[section].update(override)
    for section, values in tree.items():
        for key in values:
            _check_key(section, key)
    try:
        return RunConfig.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        cause = first.get("ctx", {}).get("error")
        if isinstance(cause, InputError):
            raise cause from error
        where = ".".join(str(part) for part in first["loc"][:2])
        raise InputError(
            f"a valid value for {where} ({describe_key(where)})", f"{first['input']!r} ({first['msg']})", "correct the value"
        ) from error


def describe_key(dotted: str) -> str:
    """The description of a setting, with its unit, from its dotted name (`map.voxel`)."""
    section, _, key = dotted.partition(".")
    field = _SECTIONS[section].model_fields.get(key) if section in _SECTIONS else None
    return (field.description if field is not None else None) or "a setting of boxplus lio"


def _read_yaml(path: Path) -> dict[str, dict[str, object]]:
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
    sections = f"the sections {', '.join(_SECTIONS)}"
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError(
            f"a YAML file with {sections}", f"{type(content).__name__} in {path}", "write e.g. 'odometry:' and keys below"
        )
    for section, values in content.items():
        if section not in _SECTIONS:
            home = [name for name, model in _SECTIONS.items() if section in model.model_fields]
            advice = f"write it below '{home[0]}:'" if home else _suggest(str(section), list(_SECTIONS), "section")
            raise InputError(f"{sections} in {path}", f"{section!r}", advice)
        if values is not None and not isinstance(values, dict):
            raise InputError(f"keys and values below '{section}:' in {path}", repr(values), "write one 'key: value' a line")
        for key in values or {}:
            if not isinstance(key, str):
                raise InputError(f"names of settings below '{section}:' in {path}", repr(key), "write e.g. 'scan_voxel: 0.5'")
    return {section: values or {} for section, values in content.items()}


def _parse_setting(text: str) -> tuple[str, str, object]:
    name, equals, value = text.partition("=")
    if not equals:
        raise InputError("a setting as key=value", repr(text), "write e.g. --set scan_voxel=0.5")
    section, dot, key = name.strip().rpartition(".")
    if not dot:
        homes = [candidate for candidate, model in _SECTIONS.items() if key in model.model_fields]
        if len(homes) != 1:
            known = sorted(f"{candidate}.{known}" for candidate, model in _SECTIONS.items() for known in model.model_fields)
            raise InputError("the name of a setting", repr(key), _suggest(key, known, "setting"))
        section = homes[0]
    if section not in _SECTIONS:
        raise InputError(f"a section ({', '.join(_SECTIONS)})", repr(section), _suggest(section, list(_SECTIONS), "section"))
    try:
        return section, key, yaml.load(value, _Yaml)
    except yaml.YAMLError as error:
        raise InputError(f"a value for {section}.{key}", repr(value), "write a number, a word or a [list]") from error


def _check_key(section: str, key: str) -> None:
    known = list(_SECTIONS[section].model_fields)
    if key not in known:
        raise InputError(f"a known setting in section '{section}'", repr(key), _suggest(key, known, "setting"))


def _suggest(word: str, known: list[str], kind: str) -> str:
    short = {name.rpartition(".")[2]: name for name in known}
    near = difflib.get_close_matches(word, list(short), n=1)
    hint = f"did you mean {short[near[0]]}? " if near else ""
    return f"{hint}the {kind}s are: {', '.join(known)}"


def dump_run_config(config: RunConfig, info: RecordingInfo) -> str:
    """The text of `config.yaml`: everything as used, readings found from the data included, so that it repeats the run."""
    used = config.model_dump()
    found = used["recording"]
    is_bag = bool(info.lidar_topic) and any(topic.name == info.lidar_topic for topic in info.topics)
    if is_bag:
        found["lidar_topic"], found["imu_topic"] = info.lidar_topic, info.imu_topic
        found["point_time_field"] = info.point_time.field or NO_POINT_TIME
        if info.point_time.field is not None:
            found["point_time_unit"], found["point_time_reference"] = info.point_time.unit, info.point_time.reference
        found["gyro_unit"], found["accel_unit"] = info.gyro_unit, info.accel_unit
    head = (
        "# Settings of this run, those found from the data included: 'boxplus lio RECORDING --config FILE' repeats it.\n"
        "# For another recording delete the lines of section 'recording' that shall be found anew.\n"
    )
    body: str = yaml.safe_dump(used, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
    return head + body
