"""COLMAP's text and binary models: layouts byte by byte, round trips, and every way the files can be wrong."""

from __future__ import annotations

import struct
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boxplus.errors import InputError
from boxplus.formats.numbers import lines as number_lines
from boxplus.formats.reconstructions import colmap_binary
from boxplus.formats.reconstructions.colmap import read_colmap, write_colmap
from boxplus.formats.reconstructions.colmap_model import CAMERA_MODELS, ColmapModel


def random_model(seed: int, images: int = 4, points: int = 6, observations: int = 20) -> ColmapModel:
    rng = np.random.default_rng(seed)
    models = tuple(rng.choice(list(CAMERA_MODELS), 3).tolist())
    return ColmapModel(
        camera_ids=rng.choice(100, 3, replace=False),
        camera_models=models,
        camera_sizes=rng.integers(1, 5000, (3, 2)),
        camera_params=tuple(rng.normal(size=CAMERA_MODELS[model]) * 1e3 for model in models),
        image_ids=rng.choice(1000, images, replace=False),
        image_names=tuple(f"left {seed}/{i:03}.png" if i % 2 else f"{i}" for i in range(images)),
        camera_of=rng.integers(0, 3, images),
        T_camera_world=np.hstack([Rotation.random(images, rng).as_quat()[:, [3, 0, 1, 2]], rng.normal(size=(images, 3))]),
        point_ids=rng.choice(2**40, points, replace=False),
        points=rng.normal(size=(points, 3)),
        colors=rng.integers(0, 256, (points, 3)).astype(np.uint8),
        errors=rng.uniform(size=points),
        image_of=np.sort(rng.integers(0, images, observations)),
        point_of=rng.integers(-1, points, observations) if points else np.full(observations, -1),
        pixels=rng.uniform(0.0, 4000.0, (observations, 2)),
    )


def assert_same(left: ColmapModel, right: ColmapModel) -> None:
    for field in fields(ColmapModel):
        one, two = getattr(left, field.name), getattr(right, field.name)
        if field.name in ("format", "source"):
            continue
        if field.name == "camera_params":
            assert all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))
        elif field.name == "T_camera_world":
            np.testing.assert_allclose(one, two, rtol=0, atol=4e-16)
        elif isinstance(one, np.ndarray):
            assert np.array_equal(one, two) and one.dtype == two.dtype, field.name
        else:
            assert one == two, field.name


@given(
    seed=st.integers(0, 1000),
    form=st.sampled_from(["text", "binary"]),
    sizes=st.tuples(st.integers(0, 5), st.integers(0, 8), st.integers(0, 30)),
    block=st.sampled_from([64, 200, 1 << 20]),
)
def test_round_trip_keeps_every_bit(
    tmp_path_factory: pytest.TempPathFactory, seed: int, form: str, sizes: tuple[int, int, int], block: int
) -> None:
    folder = tmp_path_factory.mktemp("colmap")
    images, points, observations = sizes
    model = random_model(seed, images, points, observations if images else 0)
    write_colmap(folder, model, form)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(number_lines, "CHUNK", block)
        patch.setattr(colmap_binary, "BLOCK", block)
        again = read_colmap(folder)
    assert_same(model, again)
    assert again.format == form


def test_text_is_as_documented(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text(
        "# Camera list\n1 SIMPLE_PINHOLE 640 480 500.5 320 240\n7 OPENCV 64 48 1 2 3 4 5 6 7 8\n"
    )
    (tmp_path / "images.txt").write_text(
        "# Image list\n3 0.8 0 0 0.6 1 2 3 7 a b.png\n1.5 2.5 63 3.5 4.5 -1\n"
        "5 1 0 0 0 4 5 6 1 0002.png\n\n6 1 0 0 0 4 5 6 1 c\n7 8 63\n"
    )
    (tmp_path / "points3D.txt").write_text("# points\n63 1 2 3 255 128 0 0.5 3 0 6 0\n")
    model = read_colmap(tmp_path)
    assert model.format == "text"
    assert model.camera_models == ("SIMPLE_PINHOLE", "OPENCV") and model.camera_sizes.tolist() == [[640, 480], [64, 48]]
    assert model.camera_params[0].tolist() == [500.5, 320, 240]
    assert model.image_names == ("a b.png", "0002.png", "c") and model.camera_of.tolist() == [1, 0, 0]
    assert model.T_camera_world[0].tolist() == [0.8, 0, 0, 0.6, 1, 2, 3]
    assert model.image_of.tolist() == [0, 0, 2] and model.point_of.tolist() == [0, -1, 0]
    assert model.pixels.tolist() == [[1.5, 2.5], [3.5, 4.5], [7, 8]]
    assert model.colors.tolist() == [[255, 128, 0]] and model.errors.tolist() == [0.5]
    starts, track = model.tracks()
    assert starts.tolist() == [0, 2] and track.tolist() == [0, 2]
    assert model.observation_starts().tolist() == [0, 2, 2, 3]
    write_colmap(tmp_path / "again", model)
    lines = (tmp_path / "again" / "images.txt").read_text().splitlines()[3:]
    assert lines[:4] == [
        "3 0.8 0.0 0.0 0.6 1.0 2.0 3.0 7 a b.png",
        "1.5 2.5 63 3.5 4.5 -1",
        "5 1.0 0.0 0.0 0.0 4.0 5.0 6.0 1 0002.png",
        "",
    ]
    assert (tmp_path / "again" / "points3D.txt").read_text().splitlines()[2:] == ["63 1.0 2.0 3.0 255 128 0 0.5 3 0 6 0"]


def test_binary_is_as_documented(tmp_path: Path) -> None:
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<Q", 1) + struct.pack("<iiQQ3d", 7, 0, 640, 480, 500.5, 320, 240))
    observations = struct.pack("<ddqddQ", 1.5, 2.5, 63, 3.5, 4.5, 2**64 - 1)
    (tmp_path / "images.bin").write_bytes(
        struct.pack("<Q", 1)
        + struct.pack("<I7dI", 3, 0.8, 0, 0, 0.6, 1, 2, 3, 7)
        + b"a b.png\0"
        + struct.pack("<Q", 2)
        + observations
    )
    (tmp_path / "points3D.bin").write_bytes(
        struct.pack("<Q", 1) + struct.pack("<Q3d3BdQII", 63, 1, 2, 3, 255, 128, 0, 0.5, 1, 3, 0)
    )
    before = {name: (tmp_path / name).read_bytes() for name in ("cameras.bin", "images.bin", "points3D.bin")}
    model = read_colmap(tmp_path / "images.bin")
    assert model.camera_models == ("SIMPLE_PINHOLE",) and model.camera_params[0].tolist() == [500.5, 320, 240]
    assert model.image_names == ("a b.png",) and model.T_camera_world[0].tolist() == [0.8, 0, 0, 0.6, 1, 2, 3]
    assert model.point_of.tolist() == [0, -1] and model.pixels.tolist() == [[1.5, 2.5], [3.5, 4.5]]
    assert model.points.tolist() == [[1, 2, 3]] and model.colors.tolist() == [[255, 128, 0]]
    write_colmap(tmp_path / "again", model)
    assert {name: (tmp_path / "again" / name).read_bytes() for name in before} == before


def test_binary_is_preferred_unless_a_text_file_is_named(tmp_path: Path) -> None:
    write_colmap(tmp_path, random_model(0), "text")
    write_colmap(tmp_path, random_model(1), "binary")
    assert read_colmap(tmp_path).format == "binary"
    assert read_colmap(tmp_path / "cameras.txt").format == "text"
    with pytest.raises(
        InputError, match=r"expected a COLMAP model: a folder with cameras.* – got .*elsewhere, which is not there – "
    ):
        read_colmap(tmp_path / "elsewhere")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes").touch()
    for path, there in (
        (tmp_path / "other", "a folder with notes"),
        (tmp_path / "other" / "notes", "a file beside which there is none"),
    ):
        with pytest.raises(InputError, match=f"got .*, {there} – give the folder that has them"):
            read_colmap(path)
    with pytest.raises(InputError, match=r"expected the format text or binary – got 'xml'"):
        write_colmap(tmp_path, random_model(0), "xml")


@pytest.mark.parametrize(
    ("name", "at", "line", "message"),
    [
        (
            "cameras.txt",
            0,
            "1 SIMPLE 640 480 500 320 240",
            r"a camera model out of SIMPLE_PINHOLE, .* got '1 SIMPLE .*cameras.txt, line 3",
        ),
        ("cameras.txt", 0, "1 PINHOLE 640 480 500 320 240", r"a camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS\[\] – got .*line 3"),
        ("cameras.txt", 0, "1 PINHOLE 640.5 480 500 500 320 240", r"a camera: CAMERA_ID .*line 3"),
        (
            "images.txt",
            0,
            "1 1 0 0 0 4 5 6 1",
            r"an image: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME – got .*images.txt, line 4",
        ),
        ("images.txt", 0, "1 1 0 0 x 4 5 6 1 name", r"an image: IMAGE_ID .*line 4"),
        (
            "images.txt",
            1,
            "1.5 2.5",
            r"the observations of an image: POINTS2D\[\] as \(X, Y, POINT3D_ID\) – got '1.5 2.5' .*line 5",
        ),
        ("images.txt", 1, "1.5 2.5 3.5", r"the observations of an image: .*line 5"),
        ("images.txt", 1, "1.5 2.5 12345", r"points that the model has – got point 12345 in an observation"),
        ("points3D.txt", 0, "63 1 2 3 255 128 0", r"a point: POINT3D_ID X Y Z R G B ERROR TRACK\[\] .*points3D.txt, line 3"),
        ("points3D.txt", 0, "63 1 2 3 255 128 300 0.5", r"a point: POINT3D_ID .*line 3"),
        ("points3D.txt", 0, "63 1 2 3 255 128 0 0.5 1 0.5", r"a point: POINT3D_ID .*line 3"),
        ("points3D.txt", 1, "63 1 2 3 255 128 0 0.5 1", r"a point: POINT3D_ID .*line 4"),
    ],
)
def test_wrong_text_is_refused(tmp_path: Path, name: str, at: int, line: str, message: str) -> None:
    write_colmap(tmp_path, random_model(0), "text")
    lines = (tmp_path / name).read_text().splitlines()
    comments = sum(line.startswith("#") for line in lines)
    lines[comments + at] = line
    (tmp_path / name).write_text("\n".join(lines))
    with pytest.raises(InputError, match=message):
        read_colmap(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_cut_binary_is_refused_wherever_it_is_cut(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    write_colmap(tmp_path, random_model(0), "binary")
    data = (tmp_path / name).read_bytes()
    monkeypatch.setattr(colmap_binary, "BLOCK", 100)
    for size in range(0, len(data), 7):
        (tmp_path / name).write_bytes(data[:size])
        with pytest.raises(InputError, match=rf"got the end of the file \(.*{name}\) – the file is cut"):
            read_colmap(tmp_path)
    (tmp_path / name).write_bytes(data + b"\1\2\3")
    with pytest.raises(InputError, match=rf"expected the end of the file – got 3 more bytes \(.*{name}\)"):
        read_colmap(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(InputError, match=rf"{name}: No such file|a COLMAP model"):
        read_colmap(tmp_path)


def test_an_unknown_camera_model_is_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path, random_model(0), "binary")
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<Q", 1) + struct.pack("<iiQQ3d", 7, 99, 640, 480, 1, 2, 3))
    with pytest.raises(InputError, match=r"a camera model from 0 to 11 – got 99, camera 7"):
        read_colmap(tmp_path)


def test_an_impossible_image_size_is_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path, random_model(0), "binary")
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<Q", 1) + struct.pack("<IiQQ3d", 7, 0, 2**63, 480, 1, 2, 3))
    with pytest.raises(InputError, match=r"at most 2147483648 pixels a side – got 9223372036854775808 × 480, camera 7"):
        read_colmap(tmp_path)


def test_tracks_must_agree_with_observations(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 640 480 500 320 240\n")
    (tmp_path / "images.txt").write_text("3 1 0 0 0 1 2 3 1 a\n1 2 8 3 4 9\n")
    for points, message in (
        ("8 1 2 3 0 0 0 0 3 1\n9 1 2 3 0 0 0 0 3 1\n", r"got point 8 with observation 1 of image 3, which is not one of it"),
        ("8 1 2 3 0 0 0 0 3 2\n9 1 2 3 0 0 0 0 3 1\n", r"got point 8 with observation 2 of image 3"),
        ("8 1 2 3 0 0 0 0\n9 1 2 3 0 0 0 0 3 1\n", r"each once – got a track of 0 for point 8"),
        ("8 1 2 3 0 0 0 0 3 0 3 0\n9 1 2 3 0 0 0 0 3 1\n", r"each once – got a track of 2 for point 8"),
        ("8 1 2 3 0 0 0 0 4 0\n9 1 2 3 0 0 0 0 3 1\n", r"images that the model has – got image 4 in a track"),
    ):
        (tmp_path / "points3D.txt").write_text(points)
        with pytest.raises(InputError, match=message):
            read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.zeros((5, 3))}, r"points of shape \(6, 3\) – got \(5, 3\) \(COLMAP model\)"),
        ({"camera_sizes": np.full((3, 2), -1)}, r"widths and heights that are not negative – got \[-1, -1\], camera"),
        ({"image_names": ("a",)}, r"4 image_names – got 1"),
        ({"camera_models": ("CUBE", "PINHOLE", "PINHOLE")}, r"a camera model out of .* – got 'CUBE', camera"),
        ({"camera_params": (np.zeros(2),) * 3}, r"\d+ parameters of .* – got shape \(2,\), camera"),
        ({"image_ids": np.array([1, 2, 2, 3])}, r"each image once – got image 2 again"),
        ({"image_ids": np.array([1, 2, 3, 2**32])}, r"image ids from 0 to 4294967295 – got 1 to 4294967296"),
        ({"camera_of": np.array([0, 1, 2, 3])}, r"camera indices from 0 to 2 – got 3 at 3"),
        ({"point_of": np.full(20, -2)}, r"point indices from -1 to 5 – got -2 at 0"),
        ({"image_of": np.arange(20)[::-1] // 5}, r"observations image by image – got image_of that decreases"),
        ({"T_camera_world": np.full((4, 7), np.nan)}, r"a finite pose – got \[nan.*image"),
        ({"T_camera_world": np.full((4, 7), 2.0)}, r"a unit quaternion in each pose – got length 4, image"),
    ],
)
def test_bad_arrays_are_refused(change: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(random_model(0), **change)


@pytest.mark.parametrize("form", ["text", "binary"])
def test_names_keep_their_bytes_in_any_encoding(tmp_path: Path, form: str) -> None:
    names = ("Bäume/ö 1.jpg", b"\xff\xe4.jpg".decode(errors="surrogateescape"))
    write_colmap(tmp_path, replace(random_model(0, images=2), image_names=names), form)
    assert read_colmap(tmp_path).image_names == names


def test_names_that_a_file_cannot_hold(tmp_path: Path) -> None:
    model = random_model(0, images=1)
    with pytest.raises(InputError, match=r"without line breaks and outer spaces – got 'a\\n'"):
        write_colmap(tmp_path, replace(model, image_names=("a\n",)), "text")
    with pytest.raises(InputError, match=r"image names without zero bytes"):
        write_colmap(tmp_path, replace(model, image_names=("a\0",)), "binary")
