"""Sensors of a bag on a clock of their own, mapped by receipt; streams of one clock are left alone."""

import numpy as np
import pytest

from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SourceError
from lce_rig.io import open_recording
from lce_rig.io.recording import SourceOptions, check_overlap, join_recordings
from tests.notes import has_note
from tests.shared import changed

CAM, LIDAR = "/camera/image_raw", "/velodyne_points"
T0_NS = 1_700_000_000 * 10**9
BOOT_NS = 4281 * 10**9
PERIOD_NS = 100_000_000


@pytest.fixture
def record(tmp_path, write_bag, room, cloud_message, image_message):
    """Write n scans and images at 10 Hz; a scan is sent when it is complete, an image 10 ms later."""

    def write(n, lidar_ns=lambda t: t, cam_ns=lambda t: t, late_s=0.0, kind="mcap", parts=("lidar", "cam")):
        rng = np.random.default_rng(0)
        pixels, messages = np.zeros((24, 32, 3), np.uint8), []
        for k in range(n):
            t, wait_ns = T0_NS + k * PERIOD_NS, rng.exponential(4e6, 2).astype(int) + round(late_s * 1e9)
            if "lidar" in parts:
                log_ns = t + PERIOD_NS + int(wait_ns[0])
                messages.append((LIDAR, "PointCloud2", log_ns, cloud_message(room, lidar_ns(t))))
            if "cam" in parts:
                seen = t + PERIOD_NS // 2
                log_ns = seen + 10_000_000 + int(wait_ns[1])
                messages.append((CAM, "Image", log_ns, image_message(pixels, cam_ns(seen))))
        path = tmp_path / "_".join(parts)
        return write_bag(path, kind, sorted(messages, key=lambda message: message[2]))

    return write


def stamps(recording):
    samples = list(recording.samples())
    return tuple(np.array([s.stamp_ns for s in samples if isinstance(s, kind)]) for kind in (Image, Scan))


def since_boot(t):
    return BOOT_NS + round((t - T0_NS) * (1 - 80e-6))


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
@pytest.mark.parametrize("n", [3, 300])
def test_samples_lidar_on_its_own_clock_is_mapped(rig, record, kind, n):
    recording = open_recording(record(n, lidar_ns=since_boot, kind=kind), rig)
    images, scans = stamps(recording)
    true_ns = T0_NS + np.arange(n) * PERIOD_NS
    assert np.array_equal(images, true_ns + PERIOD_NS // 2)
    assert np.abs(scans - true_ns).max() < 10_000_000
    assert has_note(recording.notes, LIDAR, "mapped by", "+1699995719", "uncertainty 30 ms")
    assert len(list(check_overlap(recording.samples(), rig, []))) == 2 * n


def test_samples_camera_on_its_own_clock_is_mapped(rig, record):
    recording = open_recording(record(60, cam_ns=since_boot), rig)
    images, scans = stamps(recording)
    true_ns = T0_NS + np.arange(60) * PERIOD_NS
    assert np.array_equal(scans, true_ns)
    assert np.abs(images - true_ns - PERIOD_NS // 2 - 10_000_000).max() < 10_000_000


def test_samples_gps_time_beside_utc_is_mapped(rig, record):
    images, scans = stamps(open_recording(record(60, lidar_ns=lambda t: t + 18 * 10**9), rig))
    assert np.abs(images - scans - PERIOD_NS // 2).max() < 10_000_000


def test_samples_few_delays_do_not_pass_for_a_clock(rig, record):
    # A line through three receipts would have a drift of percents.
    _, scans = stamps(open_recording(record(5, lidar_ns=since_boot), rig))
    assert np.abs(np.diff(scans) - PERIOD_NS).max() < 10_000


@pytest.mark.parametrize("late_s", [0.0, 86400.0])
def test_samples_of_one_clock_are_unchanged(rig, record, late_s):
    both = {"lidar_ns": since_boot, "cam_ns": since_boot} if late_s else {}
    recording = open_recording(record(20, late_s=late_s, **both), rig)
    _, scans = stamps(recording)
    true_ns = T0_NS + np.arange(20) * PERIOD_NS
    assert scans.tolist() == [since_boot(t) if late_s else t for t in true_ns.tolist()]
    assert not has_note(recording.notes, "mapped")


def test_samples_offset_of_the_profile_comes_first(rig, record):
    bridged = changed(rig, lidars__lidar__timestamps__expected_offset_s=1699995719.0)
    recording = open_recording(record(9, lidar_ns=since_boot), bridged)
    assert stamps(recording)[1][0] == BOOT_NS
    assert len(list(check_overlap(recording.samples(), bridged, []))) == 18


def test_check_overlap_clock_since_start_names_its_key(rig, record):
    paths = record(9, lidar_ns=since_boot, parts=("lidar",)), record(9, parts=("cam",))
    (joined,) = join_recordings(
        [open_recording(path, rig, SourceOptions(is_part=True)) for path in paths], rig
    )
    with pytest.raises(SourceError) as caught:
        list(check_overlap(joined.samples(), rig, []))
    assert "lidars.lidar.timestamps.expected_offset_s" in caught.value.hint
    assert "one bag" in caught.value.hint and "+169999571" in caught.value.hint
