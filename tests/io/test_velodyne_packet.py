"""Only whole packets of a VLP-16 are believed."""

import struct
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core import velodyne
from lce_rig.io.velodyne.packet import BadPacketError, read_data_packet, read_position_packet

from .vlp16_room import packets_of, room_scans

US_AT, MODE_AT, PRODUCT_AT = 1200, 1204, 1205


@pytest.fixture(scope="module")
def payload() -> bytes:
    return packets_of(room_scans(1))[20].payload


def damage(payload: bytes, at: int, value: bytes) -> bytes:
    return payload[:at] + value + payload[at + len(value) :]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda p: p[:-1],
        lambda p: p + b"\0",
        lambda p: b"",
        lambda p: damage(p, 500, b"\xff\xdd"),
        lambda p: damage(p, 1102, struct.pack("<H", 36000)),
        lambda p: damage(p, 502, struct.pack("<H", 20000)),
        lambda p: damage(p, MODE_AT, b"\x39"),
        lambda p: damage(p, US_AT, struct.pack("<I", velodyne.HOUR_US)),
        lambda p: damage(p, MODE_AT, b"\0\0"),
        lambda p: damage(p, PRODUCT_AT, b"\x23"),
    ],
)
def test_a_damaged_data_packet_is_refused(spoil: Callable[[bytes], bytes], payload: bytes) -> None:
    read_data_packet(payload, 0)
    with pytest.raises(BadPacketError):
        read_data_packet(spoil(payload), 0)


@given(st.binary(max_size=600))
def test_whatever_comes_as_a_position_packet_is_read_or_refused(payload: bytes) -> None:
    for body in (payload, payload.ljust(velodyne.POSITION_BYTES, b"\0")[: velodyne.POSITION_BYTES]):
        try:
            read = read_position_packet(body)
        except BadPacketError:
            continue
        assert 0 <= read.us < velodyne.HOUR_US and read.pps in range(4)


@pytest.mark.parametrize(
    ("sentence", "second"),
    [
        (b"$GPRMC,081802.00,A,3649.7478558,N,00224.4542928,W,0.034,212.5,210116,0.0,E,A*2E\r\n", 1082),
        (b"$GPRMC,220516,A,5133.82,N,00042.24,W,173.8,231.8,130694,004.2,W*70\n", 316),
        (b"$GPRMC,220516,A,5133.82,N,00042.24,W,173.8,231.8,130694,004.2,W*71\n", None),
        (b"$GNRMC,220516,V,,,,,,,130694,,,N*7A", None),
        (b"$GPGGA,220516,1,1*6C", None),
        (b"$GPRMC,226516,A,5133.82,N,00042.24,W,173.8,231.8,130694,004.2,W*76\n", None),
        (b"\xff" * 306, None),
    ],
)
def test_only_sound_sentences_tell_the_time(sentence: bytes, second: int | None) -> None:
    body = bytearray(velodyne.POSITION_BYTES)
    body[0xCE : 0xCE + len(sentence)] = sentence
    assert read_position_packet(bytes(body)).nmea_s == second
