"""Network captures of LiDARs: written by dpkt, read against velodyne-decoder."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import dpkt  # type: ignore[import-untyped]
import numpy as np
import pytest
import velodyne_decoder

import bevviz
from bevviz.cli import main
from tests.support import bags, lidar_packets, ouster_packets

START = bags.START / 1e9


def frames(payload: bytes, port: int, sender: str = "192.168.1.201", mtu: int = 1480) -> list[bytes]:
    """Wrap a datagram in Ethernet and IPv4, in fragments where it is long."""
    udp = bytes(dpkt.udp.UDP(sport=port, dport=port, ulen=8 + len(payload), data=payload))
    wrapped = []
    for at in range(0, len(udp), mtu):
        ip = dpkt.ip.IP(src=socket.inet_aton(sender), dst=b"\xff" * 4, p=17, id=7, data=udp[at : at + mtu])
        ip.mf, ip.offset = int(at + mtu < len(udp)), at // 8
        ip.len = 20 + len(ip.data)
        wrapped.append(bytes(dpkt.ethernet.Ethernet(src=b"\1" * 6, dst=b"\2" * 6, data=bytes(ip))))
    return wrapped


def capture(path: Path, timed: Iterable[tuple[float, bytes]], *, form: Any = dpkt.pcap.Writer) -> Path:
    with path.open("wb") as file:
        writer = form(file)
        for time, frame in timed:
            writer.writepkt(frame, ts=time)
    return path


def velodyne_packet(azimuth: int, metres: float) -> bytes:
    """Return a packet of a VLP-16: twelve blocks, 0.4 degrees each, every beam as far."""
    far = struct.pack("<HB", round(metres / 0.002), 100) * 32
    blocks = b"".join(
        b"\xff\xee" + struct.pack("<H", (azimuth + 40 * block) % 36_000) + far for block in range(12)
    )
    return blocks + struct.pack("<I", 1_000_000) + b"\x37\x22"


def test_scans_of_a_velodyne_equal_those_of_its_decoder(tmp_path: Path) -> None:
    """Two turns and a half: each turn is a scan."""
    timed = [
        (START + 1.33e-3 * i, frame)
        for i in range(190)
        for frame in frames(velodyne_packet(480 * i % 36_000, 5 + i // 75), 2368)
    ]
    drive = bevviz.open(capture(tmp_path / "drive.pcap", timed))
    assert drive.scene.lidars == ("velodyne",) and len(drive) == 3
    theirs = [points for _, points in velodyne_decoder.read_pcap(str(tmp_path / "drive.pcap"), None)]
    ours = np.concatenate([drive.raw(number).points for number in range(3)])
    other = np.concatenate(theirs)[:, :3]
    assert len(ours) == len(other) == 190 * 12 * 32
    np.testing.assert_allclose(ours[np.lexsort(ours.T)], other[np.lexsort(other.T)], atol=1e-4)
    assert drive.raw(1).received / 1e9 == pytest.approx(START + 1.33e-3 * 149, abs=1e-5)
    next_generation = bevviz.open(capture(tmp_path / "drive.pcapng", timed, form=dpkt.pcapng.Writer))
    np.testing.assert_array_equal(next_generation.raw(1).points, drive.raw(1).points)
    np.testing.assert_allclose(next_generation.times, drive.times, atol=1e-5)


def test_two_hesai_in_one_capture_are_two(tmp_path: Path) -> None:
    model = lidar_packets.MODELS_BY_NAME["PandarXT32"]
    timed = [
        (START + 1e-3 * i, frame)
        for i in range(72)
        for sender in ("192.168.1.201", "192.168.1.202")
        for frame in frames(lidar_packets.packet(model, i % 36), 2300 + int(sender[-1]), sender)
    ]
    drive = bevviz.open(
        capture(tmp_path / "two.pcap", timed), set={"source.lidar_topics": "[/hesai_2301/packets]"}
    )
    assert len(drive) == 2
    assert {topic.name for topic in drive.frames.recording.topics} == {  # type: ignore[attr-defined]
        "/hesai_2301/packets",
        "/hesai_2302/packets",
    }
    assert len(drive.raw(0).points) == 36 * model.blocks * (model.channels - 1)


def test_an_ouster_in_fragments_needs_its_metadata(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its packets are longer than an Ethernet frame, so that IP cuts them."""
    profile, timed = "RNG19_RFL8_SIG16_NIR16", []
    for number in range(3 * ouster_packets.PACKETS):
        scan, part = divmod(number, ouster_packets.PACKETS)
        payload = ouster_packets.packet(profile, scan, part, bags.START + scan * bags.PERIOD)
        timed += [(START + 0.02 * number, frame) for frame in frames(payload, 7502, mtu=400)]
    path = capture(tmp_path / "drive.pcap", timed)
    assert main(["info", str(path)]) == 0
    assert "packets of an Ouster without its metadata" in " ".join(capsys.readouterr().out.split())
    (tmp_path / "sensor.json").write_text(ouster_packets.metadata(profile))
    drive = bevviz.open(path)
    assert len(drive) == 3 and drive.scene.lidars == ("os_lidar",)
    recorded = bevviz.open(
        ouster_packets.bag(tmp_path / "bag", profile, told=ouster_packets.metadata(profile))
    )
    np.testing.assert_array_equal(drive.raw(0).points, recorded.raw(0).points)


def test_other_captures_are_refused_and_cut_ones_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    timed = [(START + i, frame) for i in range(5) for frame in frames(bytes(1248), 6699)]
    assert main(["info", str(capture(tmp_path / "other.pcap", timed))]) == 2
    assert "most of its packets have 1248 bytes, to port 6699" in capsys.readouterr().err
    timed = [
        (START + 1e-3 * i, f) for i in range(99) for f in frames(velodyne_packet(480 * i % 36_000, 5), 2368)
    ]
    path = capture(tmp_path / "cut.pcap", timed)
    path.write_bytes(path.read_bytes()[:-100])
    drive = bevviz.open(path)
    assert len(drive) == 2 and "the capture ends early" in " ".join(drive.warnings)
