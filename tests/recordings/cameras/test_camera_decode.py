"""Images from their bytes: every encoding against what was written, and what is cut or damaged is told."""

import importlib.util
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.errors import RecordingError
from boxplus.recordings.cameras import decode
from boxplus.recordings.cameras.decode import MalformedImageError, decode_file, decode_raw
from tests.camera_recordings import pgm

needs_cv2 = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="OpenCV (extra `vision`) is not installed")
RNG = np.random.default_rng(1)
GREY, COLOUR = RNG.integers(0, 256, (7, 5), np.uint8), RNG.integers(0, 256, (7, 5, 3), np.uint8)
SMOOTH = np.add.outer(np.arange(40), np.arange(50)).astype(np.uint8)


@pytest.mark.parametrize("padding", [0, 3])
@pytest.mark.parametrize("big_endian", [False, True])
def test_raw_greys_of_8_16_and_32_bits(padding: int, big_endian: bool) -> None:
    for encoding, kind in (("mono8", "u1"), ("mono16", "u2"), ("16UC1", "u2"), ("32FC1", "f4")):
        pixels = (GREY.astype(np.float64) * 3).astype(kind)
        rows = pixels.astype(np.dtype(kind).newbyteorder(">" if big_endian else "<")).view(np.uint8).reshape(7, -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=9)
        read = decode_raw(encoding, 7, 5, rows.shape[1], big_endian, rows.tobytes())
        np.testing.assert_array_equal(read, pixels)
        assert read.dtype == np.dtype(kind) and read.dtype.isnative


def test_raw_colours_come_as_red_green_blue() -> None:
    alpha = np.full((7, 5, 1), 200, np.uint8)
    written = {
        "rgb8": COLOUR,
        "bgr8": COLOUR[:, :, ::-1],
        "rgba8": np.concatenate([COLOUR, alpha], axis=2),
        "bgra8": np.concatenate([COLOUR[:, :, ::-1], alpha], axis=2),
    }
    for encoding, pixels in written.items():
        for kind, factor in (("u1", 1), (">u2", 250)):
            data = (pixels.astype(np.uint16) * factor).astype(kind)
            name = encoding if factor == 1 else encoding.replace("8", "16")
            read = decode_raw(name, 7, 5, data.shape[1] * data.shape[2] * data.itemsize, True, data.tobytes())
            np.testing.assert_array_equal(read, COLOUR.astype(np.uint16) * factor)
            assert read.dtype == np.dtype(kind).newbyteorder("=")


@pytest.mark.parametrize(("encoding", "at"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("yuyv", 0)])
def test_of_luminance_and_chrominance_the_luminance_is_taken(encoding: str, at: int) -> None:
    both = np.full((7, 5, 2), 128, np.uint8)
    both[:, :, at] = GREY
    np.testing.assert_array_equal(decode_raw(encoding, 7, 5, 10, False, both.tobytes()), GREY)


@needs_cv2
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize(("bits", "factor"), [(8, 1), (16, 300)])
def test_a_mosaic_of_one_colour_is_that_colour(pattern: str, bits: int, factor: int) -> None:
    colour = {"r": 200 * factor, "g": 100 * factor, "b": 50 * factor}
    mosaic = np.zeros((8, 10), f"u{bits // 8}")
    for number, letter in enumerate(pattern):
        mosaic[number // 2 :: 2, number % 2 :: 2] = colour[letter]
    pixels = decode_raw(f"bayer_{pattern}{bits}", 8, 10, 10 * bits // 8, False, mosaic.tobytes())
    assert pixels.shape == (8, 10, 3) and pixels.dtype == mosaic.dtype
    assert (pixels == tuple(colour.values())).all()


def test_raw_images_that_do_not_fit_are_refused() -> None:
    for encoding, height, width, step, size, reason in (
        ("nv21", 2, 2, 4, 8, "unknown encoding 'nv21', where mono8, "),
        ("mono8", 2, 2, 1, 4, "4 bytes in rows of 1 for 2x2 pixels"),
        ("mono8", 2, 2, 2, 3, "3 bytes in rows of 2"),
        ("rgb8", 0, 2, 6, 12, "a size of 2x0 pixels"),
        ("mono8", 1, 10**6, 10**6, 10**6, "a size of 1000000x1 pixels"),
    ):
        with pytest.raises(MalformedImageError, match=reason):
            decode_raw(encoding, height, width, step, False, bytes(size))


@given(st.integers(1, 9), st.integers(1, 9), st.booleans(), st.booleans(), st.integers(0, 2**32 - 1))
def test_pgm_and_ppm_round_trip(height: int, width: int, deep: bool, colour: bool, seed: int) -> None:
    shape = (height, width, 3) if colour else (height, width)
    pixels = np.random.default_rng(seed).integers(0, 65536 if deep else 256, shape).astype(np.uint16 if deep else np.uint8)
    np.testing.assert_array_equal(decode_file(pgm(pixels)), pixels)


@given(st.integers(0, 200))
def test_a_cut_pgm_is_refused(length: int) -> None:
    whole = pgm(GREY)
    if length < len(whole):
        with pytest.raises(MalformedImageError):
            decode_file(whole[:length])


def test_what_is_no_image_is_refused() -> None:
    for data, reason in (
        (b"", "an empty file"),
        (b"GIF89a...", "neither JPEG, PNG, PGM nor PPM"),
        (b"P5\nfoo", "without its header"),
    ):
        with pytest.raises(MalformedImageError, match=reason):
            decode_file(data)


@needs_cv2
def test_png_is_exact_and_colours_are_red_green_blue() -> None:
    import cv2

    deep = GREY.astype(np.uint16) * 257
    for pixels in (GREY, deep, COLOUR):
        written = pixels if pixels.ndim == 2 else pixels[:, :, ::-1]
        np.testing.assert_array_equal(decode_file(cv2.imencode(".png", written)[1].tobytes()), pixels)


@needs_cv2
def test_jpeg_is_close_and_colours_are_red_green_blue() -> None:
    import cv2

    colour = np.zeros((40, 50, 3), np.uint8)
    colour[:, :] = (200, 100, 50)
    for pixels in (SMOOTH, colour):
        written = pixels if pixels.ndim == 2 else pixels[:, :, ::-1]
        read = decode_file(cv2.imencode(".jpg", written)[1].tobytes())
        assert read.shape == pixels.shape
        assert np.abs(read.astype(int) - pixels).max() < 8


@needs_cv2
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_what_opencv_would_fill_up_is_refused(suffix: str) -> None:
    """libjpeg paints the missing part of a cut image grey and returns it."""
    import cv2

    whole = cv2.imencode(suffix, RNG.integers(0, 256, (60, 80), np.uint8))[1].tobytes()
    for share in (0.1, 0.5, 0.9):
        with pytest.raises(MalformedImageError):
            decode_file(whole[: int(share * len(whole))])


@needs_cv2
def test_a_png_with_a_flipped_bit_is_refused() -> None:
    import cv2

    whole = bytearray(cv2.imencode(".png", SMOOTH)[1].tobytes())
    whole[len(whole) // 2] ^= 4
    with pytest.raises(MalformedImageError, match="wrong checksum"):
        decode_file(bytes(whole))


def test_without_opencv_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(RecordingError, match=r"OpenCV, to decode JPEG images – got it is not installed – .*pip install .*opencv"):
        decode_file(decode.JPEG_MAGIC + b"\xff\xda\xff\xd9")
    np.testing.assert_array_equal(decode_file(pgm(GREY)), GREY)
