"""What the readers of COLMAP's text and binary files hand over, with names instead of indices, and its assembly."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.reconstructions.colmap_model import ColmapModel

_TABLE_PER_ID = 16  # ids are looked up in a table where they are this dense, else by bisection
_Scalar = TypeVar("_Scalar", np.int64, np.float64, np.uint8)


@dataclass(slots=True)
class ColmapParts:
    """The contents of the three files of a model as they are read."""

    camera_ids: list[int] = field(default_factory=list)
    camera_models: list[str] = field(default_factory=list)
    camera_sizes: list[tuple[int, int]] = field(default_factory=list)
    camera_params: list[NDArray[np.float64]] = field(default_factory=list)
    image_ids: list[int] = field(default_factory=list)
    image_names: list[str] = field(default_factory=list)
    image_cameras: list[int] = field(default_factory=list)  # camera id of each image
    poses: list[NDArray[np.float64]] = field(default_factory=list)  # (7,) each
    pixels: list[NDArray[np.float64]] = field(default_factory=list)  # (k, 2) of each image
    observed: list[NDArray[np.int64]] = field(default_factory=list)  # (k,) point ids of each image, −1 for none
    point_ids: list[NDArray[np.int64]] = field(default_factory=list)  # the following in chunks
    points: list[NDArray[np.float64]] = field(default_factory=list)
    colors: list[NDArray[np.uint8]] = field(default_factory=list)
    errors: list[NDArray[np.float64]] = field(default_factory=list)
    track_lengths: list[NDArray[np.int64]] = field(default_factory=list)
    tracks: list[NDArray[np.int64]] = field(default_factory=list)  # (t, 2) image id, index of the observation in the image

    def assemble(self, folder: Path, format: Literal["text", "binary"]) -> ColmapModel:
        """The model, with indices instead of names.

        Raises:
            InputError: a name that nothing has, or tracks of points that contradict the observations of images.
        """
        camera_ids, image_ids = np.array(self.camera_ids, np.int64), np.array(self.image_ids, np.int64)
        point_ids = _joined(self.point_ids, (0,), np.int64)
        camera_of = _index(camera_ids, np.array(self.image_cameras, np.int64), "camera", "an image", folder)
        names = _joined(self.observed, (0,), np.int64)
        point_of = np.full(len(names), -1, np.int64)
        has_point = names != -1
        point_of[has_point] = _index(point_ids, names[has_point], "point", "an observation", folder)
        model = ColmapModel(
            camera_ids=camera_ids,
            camera_models=tuple(self.camera_models),
            camera_sizes=np.array(self.camera_sizes, np.int64).reshape(-1, 2),
            camera_params=tuple(self.camera_params),
            image_ids=image_ids,
            image_names=tuple(self.image_names),
            camera_of=camera_of,
            T_camera_world=np.array(self.poses, np.float64).reshape(-1, 7),
            point_ids=point_ids,
            points=_joined(self.points, (0, 3), np.float64),
            colors=_joined(self.colors, (0, 3), np.uint8),
            errors=_joined(self.errors, (0,), np.float64),
            image_of=np.repeat(np.arange(len(image_ids)), [len(part) for part in self.observed]),
            point_of=point_of,
            pixels=_joined(self.pixels, (0, 2), np.float64),
            format=format,
            source=str(folder),
        )
        self._check_tracks(model, folder)
        return model

    def _check_tracks(self, model: ColmapModel, folder: Path) -> None:
        """The two directions of the same table must agree."""
        lengths = _joined(self.track_lengths, (0,), np.int64)
        tracks = _joined(self.tracks, (0, 2), np.int64)
        point = np.repeat(np.arange(len(lengths)), lengths)
        image = _index(model.image_ids, tracks[:, 0], "image", "a track", folder)
        starts = model.observation_starts()
        observation = starts[image] + tracks[:, 1]
        wrong = (tracks[:, 1] < 0) | (observation >= starts[image + 1])
        wrong[~wrong] = model.point_of[observation[~wrong]] != point[~wrong]
        if wrong.any():
            first = int(np.argmax(wrong))
            raise InputError(
                "tracks that agree with the observations of the images",
                f"point {model.point_ids[point[first]]} with observation {tracks[first, 1]} of image {tracks[first, 0]}, which "
                f"is not one of it ({folder})",
                "the files are not of the same model: copy all of them again",
            )
        missing = np.flatnonzero(np.bincount(model.point_of[model.point_of >= 0], minlength=len(lengths)) != lengths)
        if missing.size:
            raise InputError(
                "tracks that hold all observations of their point, each once",
                f"a track of {lengths[missing[0]]} for point {model.point_ids[missing[0]]} ({folder})",
                "the files are not of the same model: copy all of them again",
            )


def _joined(parts: list[NDArray[_Scalar]], empty: tuple[int, ...], kind: type[_Scalar]) -> NDArray[_Scalar]:
    return np.concatenate(parts) if parts else np.empty(empty, kind)


def _index(ids: NDArray[np.int64], names: NDArray[np.int64], kind: str, where: str, folder: Path) -> NDArray[np.int64]:
    """Where each name stands in `ids`."""
    if not len(names):
        return np.empty(0, np.int64)
    lowest, highest = (int(ids.min()), int(ids.max())) if len(ids) else (0, -1)
    known = (names >= lowest) & (names <= highest)
    place = np.full(len(names), -1, np.int64)
    if highest - lowest < _TABLE_PER_ID * len(ids):
        table = np.full(highest - lowest + 1, -1, np.int64)
        table[ids - lowest] = np.arange(len(ids))
        place[known] = table[names[known] - lowest]
    else:
        order = np.argsort(ids, kind="stable")
        candidate = order[np.searchsorted(ids, names[known], sorter=order)]
        place[known] = np.where(ids[candidate] == names[known], candidate, -1)
    if (place < 0).any():
        raise InputError(
            f"{kind}s that the model has",
            f"{kind} {names[np.argmax(place < 0)]} in {where} ({folder})",
            "the files are not of the same model: copy all of them again",
        )
    return place
