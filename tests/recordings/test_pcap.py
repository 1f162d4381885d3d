"""Vendor captures, where their decoders are installed."""

import importlib.util
import struct
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import RecordingError
from boxplus.recordings import open_recording, pcap
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan

OUSTER = "clouds/ouster-sdk-3scan/OS-1-128_v2.3.0_1024x10_lb_n3.pcap"


@pytest.mark.skipif(importlib.util.find_spec("ouster") is None, reason="ouster-sdk is not installed")
def test_ouster_capture(shared_data: Path) -> None:
    with open_recording(shared_data / OUSTER) as recording:
        events = list(recording)
        assert recording.info.format == "Ouster pcap (OS-1-128)"
        T_imu_lidar = recording.info.T_imu_lidar
    scans = [e for e in events if isinstance(e, Scan)]
    imu = [e for e in events if isinstance(e, ImuSamples)]
    assert len(scans) == 3 and sum(map(len, imu)) == 30
    for scan in scans:
        assert len(scan) + sum(scan.rejected.values()) == 128 * 1024
        assert 0.09 < (scan.end_ns - scan.start_ns) * 1e-9 < 0.101
    norm = np.linalg.norm(np.concatenate([block.accel for block in imu]), axis=1)
    assert 9.0 < np.median(norm) < 11.5
    assert T_imu_lidar is not None
    np.testing.assert_allclose(T_imu_lidar[:3, 3], [-0.006253, 0.011775, -0.007645], atol=1e-9)


@pytest.mark.skipif(importlib.util.find_spec("ouster") is None, reason="ouster-sdk is not installed")
@pytest.mark.parametrize("damaged", [b"", b"{}", b"3", b'{"prod_line": "OS', b"\xff\xfe{}"])
def test_damaged_metadata_is_refused(shared_data: Path, tmp_path: Path, damaged: bytes) -> None:
    """The decoder raises a class of its own for it."""
    (tmp_path / "drive.pcap").write_bytes((shared_data / OUSTER).read_bytes())
    (tmp_path / "drive.json").write_bytes(damaged)
    with pytest.raises(
        RecordingError, match=r"an Ouster capture with its metadata – got drive.pcap: .* check that drive.json is whole"
    ):
        open_recording(tmp_path / "drive.pcap")


def test_errors_of_the_decoder_are_known_by_what_it_has(monkeypatch: pytest.MonkeyPatch) -> None:
    class SourceURLException(Exception):
        pass

    module = types.ModuleType("ouster.sdk.open_source")
    for name in ("ouster", "ouster.sdk"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, "ouster.sdk.open_source", module)
    assert pcap._ouster_errors() == ()
    module.SourceURLException = SourceURLException  # type: ignore[attr-defined]
    assert pcap._ouster_errors() == (SourceURLException,)


@pytest.mark.skipif(
    importlib.util.find_spec("velodyne_decoder") is None, reason="velodyne-decoder (extra 'sensors') is not installed"
)
def test_a_capture_of_neither_vendor(tmp_path: Path) -> None:
    (tmp_path / "other.pcap").write_bytes(b"\xd4\xc3\xb2\xa1\x02\x00\x04\x00" + bytes(12) + b"\x01\x00\x00\x00")
    with pytest.raises(RecordingError, match=r"Velodyne packets of 1206 bytes – got neither with other\.pcap"):
        open_recording(tmp_path / "other.pcap")


def vlp16_capture(turns: float, first_s: float = 1_700_000_000.0) -> bytes:
    """A capture of a VLP-16 at 10 Hz that sees 10 m in every direction."""
    capture = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    packets = int(turns * 75.4)
    for k in range(packets):
        blocks = b"".join(
            struct.pack("<HH", 0xEEFF, round((k * 12 + block) * 36_000 / (75.4 * 12)) % 36_000) + struct.pack("<HB", 5000, 9) * 32
            for block in range(12)
        )
        data = blocks + struct.pack("<IBB", round(k * 1e6 / 754), 0x37, 0x22)
        udp = struct.pack(">HHHH", 2368, 2368, 8 + len(data), 0) + data
        ip = struct.pack(">BBHHHBBHII", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, 1, 2) + udp
        frame = bytes(12) + b"\x08\x00" + ip
        seconds = first_s + k / 754
        capture += struct.pack("<IIII", int(seconds), round(seconds % 1 * 1e6), len(frame), len(frame)) + frame
    return capture


@pytest.mark.skipif(
    importlib.util.find_spec("velodyne_decoder") is None, reason="velodyne-decoder (extra 'sensors') is not installed"
)
def test_velodyne_capture(tmp_path: Path) -> None:
    path = tmp_path / "vlp16.pcap"
    path.write_bytes(vlp16_capture(turns=3.5))
    with open_recording(path) as recording:
        scans = [e for e in recording if isinstance(e, Scan)]
        assert recording.info.imu_topic == "" and not any(e.verdict == "error" for e in recording.info.evidence)
    assert 3 <= len(scans) <= 4
    np.testing.assert_allclose(np.linalg.norm(scans[1].p_lidar, axis=1), 10.0, atol=0.1)
    assert 0.09 < (scans[1].end_ns - scans[1].start_ns) * 1e-9 < 0.105
    assert abs((scans[2].start_ns - scans[1].start_ns) * 1e-9 - 0.1) < 0.003
    assert abs(scans[0].start_ns * 1e-9 - 1_700_000_000.0) < 0.01
    path.write_bytes(path.read_bytes()[:-700])
    with open_recording(path) as recording:
        assert len([e for e in recording if isinstance(e, Scan)]) >= 3


def test_a_missing_decoder_is_named_with_what_installs_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sensor.pcap").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "velodyne_decoder", None)
    with pytest.raises(
        RecordingError, match=r"velodyne-decoder, which decodes this capture .* – .*pip install .*velodyne-decoder"
    ):
        open_recording(tmp_path / "sensor.pcap")
    (tmp_path / "sensor.json").write_text("{}")
    monkeypatch.setitem(sys.modules, "ouster.sdk.core", None)
    with pytest.raises(RecordingError, match=r"pip install --no-deps 'ouster-sdk>=1"):
        open_recording(tmp_path / "sensor.pcap")
