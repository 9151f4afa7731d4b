"""Packets of Ousters become the points that Ouster's own library computes, and scans of one frame each.

`ouster_packets.npz` holds one packet of each profile with random returns, written by ouster-sdk 1.0.1 from
the metadata in it, and the points (16, 16, 3) that its XYZLut gives.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lce_rig.core.data import Scan
from lce_rig.core.errors import SourceError
from lce_rig.io import open_recording
from lce_rig.io.network import Datagram
from lce_rig.io.ouster import PROFILES, OusterRecording, read_metadata
from lce_rig.io.recording import SourceOptions
from lce_rig.rig import load_rig
from tests.damage import damaged

from .pcap_files import write_datagrams

KEPT = np.load(Path(__file__).parent / "ouster_packets.npz")
DOCUMENT = json.loads(KEPT["meta"].tobytes())
T0_NS = 1_700_000_000 * 10**9


@pytest.fixture
def rig():
    return load_rig("os1_64")


def write_metadata(path, profile, **changes):
    layout = {**DOCUMENT["data_format"], "udp_profile_lidar": profile}
    path.write_text(json.dumps({**DOCUMENT, "data_format": layout, **changes}))
    return read_metadata(path)


@pytest.mark.parametrize("profile", PROFILES)
def test_ouster_points_match_vendor_library(tmp_path, profile):
    metadata = write_metadata(tmp_path / "metadata.json", profile)
    payload = KEPT[f"{profile}_packet"].tobytes()
    assert metadata.packet.itemsize == len(payload)
    columns = np.frombuffer(payload, metadata.packet)[0]["columns"]
    range_m = (columns["pixels"]["range"] & PROFILES[profile].range_mask) * PROFILES[profile].unit_m
    assert range_m == pytest.approx(1e-3 * KEPT[f"{profile}_range"].T, abs=1e-9)
    np.testing.assert_array_equal(columns["pixels"]["reflectivity"], KEPT[f"{profile}_refl"].T)
    np.testing.assert_array_equal(columns["ns"], KEPT[f"{profile}_stamp"])
    points = metadata.to_points(columns["column"].astype(np.int64), range_m)
    wanted = KEPT[f"{profile}_xyz"].transpose(1, 0, 2)
    np.testing.assert_allclose(points[range_m > 0], wanted[range_m > 0], atol=1e-5)


def test_ouster_grouped_metadata_is_equal(tmp_path):
    flat = write_metadata(tmp_path / "flat.json", "LEGACY")
    beams = ("beam_altitude_angles", "beam_azimuth_angles", "beam_to_lidar_transform")
    document = {
        "beam_intrinsics": {key: DOCUMENT[key] for key in beams},
        "lidar_intrinsics": {"lidar_to_sensor_transform": DOCUMENT["lidar_to_sensor_transform"]},
        "lidar_data_format": DOCUMENT["data_format"],
    }
    path = tmp_path / "groups.json"
    path.write_text(json.dumps(document))
    groups = read_metadata(path)
    np.testing.assert_array_equal(groups.T_sensor_lidar, flat.T_sensor_lidar)
    assert (groups.origin_m, groups.packet) == (flat.origin_m, flat.packet)


def write_pcap(path, metadata, n_frames, range_m=4.0):
    """Record whole frames of a sensor in the middle of a sphere."""
    datagrams = []
    profile = PROFILES[metadata.name]
    per, step_ns = metadata.columns_per_packet, 10**8 // metadata.n_columns
    for k in range(round(n_frames * metadata.n_columns / per)):
        packet = np.zeros((), metadata.packet)
        number = k * per + np.arange(per)
        packet["columns"]["ns"] = T0_NS + step_ns * number
        packet["columns"]["column"] = number % metadata.n_columns
        packet["columns"]["status"] = 1
        packet["columns"]["pixels"]["range"] = round(range_m / profile.unit_m)
        packet["columns"]["pixels"]["reflectivity"] = 60
        frame = k * per // metadata.n_columns
        if profile.has_heads:
            packet["frame"] = frame
        else:
            packet["columns"]["frame"] = frame
        arrived_ns = T0_NS + step_ns * per * (k + 1) + 50_000
        datagrams.append(Datagram(arrived_ns, "169.254.1.2", 7502, packet.tobytes()))
    write_datagrams(path, datagrams)


@pytest.mark.parametrize("profile", PROFILES)
def test_ouster_pcap_gives_one_scan_per_frame(tmp_path, rig, profile):
    metadata = write_metadata(tmp_path / "drive.json", profile)
    write_pcap(tmp_path / "drive.pcap", metadata, 2.25)
    recording = open_recording(tmp_path / "drive.pcap", rig, SourceOptions(is_part=True))
    scans = list(recording.samples())
    assert len(scans) == 2 and recording.notes
    scan = scans[0]
    assert isinstance(scan, Scan) and scan.offset_ns is not None and scan.stamp_ns is not None
    assert len(scan.points) == metadata.n_columns * len(metadata.altitude_rad)
    elevation = np.arctan2(scan.points[:, 2] - 0.03618, np.hypot(scan.points[:, 0], scan.points[:, 1]))
    seen = [np.median(elevation[scan.ring == ring]) for ring in range(16)]
    assert np.array(seen) == pytest.approx(np.sort(metadata.altitude_rad), abs=0.003)
    # The profile's clock is the host's: the first packet's arrival, less its duration.
    assert scan.stamp_ns == pytest.approx(T0_NS + 50_000, abs=20_000)
    assert scan.offset_ns.max() == pytest.approx(10**8, rel=0.01)


def test_ouster_missing_or_unsupported_is_named(tmp_path, rig):
    path = tmp_path / "drive.pcap"
    write_pcap(path, write_metadata(tmp_path / "drive.json", "LEGACY"), 0.1)
    with pytest.raises(SourceError):
        list(OusterRecording(path, rig, SourceOptions()).samples())
    write_metadata(tmp_path / "drive.json", "RNG15_RFL8_NIR8")
    with pytest.raises(SourceError):
        open_recording(path, rig)
    with pytest.raises(SourceError):
        write_metadata(tmp_path / "drive.json", "FUSA_RNG15_RFL8_NIR8_DUAL")
    (tmp_path / "drive.json").write_text('{"a": 1}')
    with pytest.raises(SourceError, match=r"drive\.json"):
        open_recording(path, rig)
    (tmp_path / "drive.json").unlink()
    with pytest.raises(SourceError) as caught:
        open_recording(path, rig)
    assert "drive.json" in (caught.value.hint or "")


@settings(
    max_examples=50,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_ouster_damaged_gives_source_error(tmp_path, rig, data):
    """Any beginning and any flipped byte: scans or a SourceError."""
    path = tmp_path / "drive.pcap"
    path.unlink(missing_ok=True)
    write_pcap(path, write_metadata(tmp_path / "drive.json", "LEGACY"), 1.0)
    file = data.draw(st.sampled_from([path, path.with_suffix(".json")]), label="file")
    file.write_bytes(data.draw(damaged(file.read_bytes())))
    try:
        assert all(isinstance(scan, Scan) for scan in OusterRecording(path, rig, SourceOptions()).samples())
    except SourceError as error:
        assert "drive" in error.what
