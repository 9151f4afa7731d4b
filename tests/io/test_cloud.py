"""Clouds with any fields become scans of one convention; rings from elevation where there is no field."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.lib.recfunctions import drop_fields, rename_fields

from lce_rig.core.data import NO_RING, Scan
from lce_rig.core.errors import SourceError
from lce_rig.io.cloud import rings_from_elevation, to_scan
from lce_rig.rig import LidarSettings, TimestampSettings
from tests.notes import has_note

FIRST = LidarSettings()
LAST = LidarSettings(timestamps=TimestampSettings(reference="last_firing"))
STAMP_NS = 1_700_000_000 * 10**9


class Reading(NamedTuple):
    scan: Scan
    notes: tuple[str, ...]


def reading_of(cloud, lidar, settings, where, stamp_ns=None):
    notes = set()
    return Reading(to_scan(cloud, lidar, settings, where, stamp_ns, notes=notes), tuple(sorted(notes)))


def with_time(room, values, name="time"):
    base = drop_fields(room, "time")
    out = np.zeros(len(base), dtype=[*base.dtype.descr, (name, values.dtype)])
    for field in base.dtype.names:
        out[field] = base[field]
    out[name] = values
    return out


def test_points_without_a_return_are_dropped_and_counted(room):
    cloud = room.copy()
    cloud["x"][:5], cloud["y"][5:7], cloud["z"][7] = np.nan, np.inf, -np.inf
    for axis in "xyz":
        cloud[axis][10:14] = 0
    cloud["x"][20], cloud["y"][20] = 0.0, 0.0  # no laser looks along the axis of rotation
    reading = reading_of(cloud, "lidar", FIRST, "here")
    assert len(reading.scan.points) == len(reading.scan.ring) == len(reading.scan.offset_ns) == len(room) - 13
    assert np.isfinite(reading.scan.points).all()


def test_cloud_without_points_is_refused(room):
    invalid = room[:3].copy()
    invalid["x"] = np.nan
    for cloud in (invalid, room[:0], drop_fields(room, "z")):
        with pytest.raises(SourceError):
            reading_of(cloud, "lidar", FIRST, "here")


@pytest.mark.parametrize("name", ["ring", "channel", "laser_id", "RING"])
def test_rings_go_by_several_names(room, name):
    reading = reading_of(rename_fields(room, {"ring": name}), "lidar", FIRST, "here")
    np.testing.assert_array_equal(reading.scan.ring, room["ring"])
    assert reading.scan.ring.dtype == np.int16 and reading.notes == ()


def test_cloud_rings_come_from_elevations(room):
    reading = reading_of(drop_fields(room, "ring"), "lidar", FIRST, "here")
    np.testing.assert_array_equal(reading.scan.ring, room["ring"])
    assert len(reading.notes) == 1 and has_note(reading.notes, "no ring", "elevation angles")


@pytest.mark.parametrize("table", [np.arange(15, -1, -1), np.r_[0:16:2, 1:16:2], np.arange(16) * 8])
def test_rings_always_count_from_the_lowest(room, table):
    cloud = room.copy()
    cloud["ring"] = table[room["ring"]]
    reading = reading_of(cloud, "lidar", FIRST, "here")
    is_ascending = bool((np.diff(table) > 0).all())
    np.testing.assert_array_equal(reading.scan.ring, cloud["ring"] if is_ascending else room["ring"])
    assert bool(reading.notes) != is_ascending


@pytest.mark.parametrize(
    ("values", "unit_ns"),
    [
        (np.arange(5760) * 17e-6, 17_000),
        ((np.arange(5760) * 17e-6).astype(np.float32), 17_000),
        (np.arange(5760, dtype=np.uint32) * 17_000, 17_000),
        (np.arange(5760, dtype=np.uint32) * 17, 17_000),
        (1.7e9 + np.arange(5760) * 17e-6, 17_000),
        (STAMP_NS + np.arange(5760, dtype=np.int64) * 17_000, 17_000),
    ],
    ids=["s", "s float32", "ns", "us", "unix s", "unix ns"],
)
@pytest.mark.parametrize("name", ["time", "t", "timestamp", "offset"])
def test_times_in_any_unit_become_ns_after_the_first_firing(room, values, unit_ns, name):
    scan = reading_of(with_time(room, values, name), "lidar", FIRST, "here", STAMP_NS).scan
    assert scan.offset_ns is not None and scan.offset_ns.dtype == np.int64
    np.testing.assert_allclose(scan.offset_ns, np.arange(5760) * unit_ns, atol=300)
    assert scan.stamp_ns == STAMP_NS


def test_cloud_last_stamp_becomes_first(room):
    span_ns = 5759 * 17_000
    negative = np.arange(-5759, 1) * 17e-6
    scan = reading_of(with_time(room, negative), "lidar", LAST, "here", STAMP_NS).scan
    assert scan.stamp_ns == pytest.approx(STAMP_NS - span_ns, abs=1000)
    assert scan.offset_ns.min() == 0 and scan.offset_ns.max() == pytest.approx(span_ns, abs=1000)
    counted_up = np.arange(5760, dtype=np.uint32) * 17_000
    assert (
        reading_of(with_time(room, counted_up), "lidar", LAST, "here", STAMP_NS).scan.stamp_ns
        == STAMP_NS - span_ns
    )
    timeless = reading_of(drop_fields(room, "time"), "lidar", LAST, "here", STAMP_NS)
    assert timeless.scan.stamp_ns == STAMP_NS - 100_000_000


@pytest.mark.parametrize(
    "values", [np.zeros(5760), np.full(5760, np.nan), (1.7e9 + np.arange(5760) * 17e-6).astype("f4")]
)
def test_cloud_useless_times_count_as_absent(room, values):
    reading = reading_of(with_time(room, values), "lidar", FIRST, "here", STAMP_NS)
    assert reading.scan.offset_ns is None
    assert len(reading.notes) == 1 and has_note(reading.notes, "field 'time'", "no times")
    (note,) = reading_of(drop_fields(room, "time"), "lidar", FIRST, "here").notes
    assert "field" not in note


def test_intensity_may_be_called_reflectivity_or_be_absent(room):
    named = reading_of(rename_fields(room, {"intensity": "reflectivity"}), "lidar", FIRST, "here")
    assert set(named.scan.intensity) == {30.0} and named.notes == ()
    absent = reading_of(drop_fields(room, "intensity"), "lidar", FIRST, "here")
    assert set(absent.scan.intensity) == {0.0} and absent.notes == ("no intensity",)


@pytest.mark.parametrize("factor", [1000.0, 100.0])
def test_cloud_other_units_are_refused(room, factor):
    cloud = room.copy()
    for axis in "xyz":
        cloud[axis] *= factor
    with pytest.raises(SourceError, match="here"):
        reading_of(cloud, "lidar", FIRST, "here")
    far = room.copy()
    for axis in "xyz":
        far[axis] *= 20
    assert len(reading_of(far, "lidar", FIRST, "here").scan.points) == len(room)


def rosette(n=20000):
    """Points of a scanner whose four lines sweep the room in no rings, as a Livox does."""
    rng = np.random.default_rng(1)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, n), np.radians(rng.uniform(-7, 52, n))
    distance = rng.uniform(2.0, 8.0, n)
    cloud = np.zeros(n, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("line", "u1")])
    cloud["x"] = distance * np.cos(elevation) * np.cos(azimuth)
    cloud["y"] = distance * np.cos(elevation) * np.sin(azimuth)
    cloud["z"] = distance * np.sin(elevation)
    cloud["line"] = np.arange(n) % 4
    return cloud


def test_cloud_lines_need_ringless_model():
    with pytest.raises(SourceError) as caught:
        reading_of(rosette(), "lidar", FIRST, "livox")
    assert "Livox" in caught.value.hint
    scan = reading_of(rosette(), "lidar", FIRST.model_copy(update={"model": "Livox Mid-360"}), "livox").scan
    assert len(scan.points) == len(rosette()) and set(scan.ring) == {NO_RING}


def test_rings_in_a_tilted_frame_stay_rings(room):
    room, tilt = room.copy(), np.radians(10.0)
    x, z = room["x"].copy(), room["z"].copy()
    room["x"], room["z"] = np.cos(tilt) * x + np.sin(tilt) * z, np.cos(tilt) * z - np.sin(tilt) * x
    assert len(np.unique(reading_of(room, "lidar", FIRST, "tilted").scan.ring)) == 16


def test_to_scan_near_returns_judge_no_rings(room):
    rng = np.random.default_rng(0)
    mount = room[rng.integers(0, len(room), 4000)]
    for axis in "xyz":
        mount[axis] = rng.uniform(-0.2, 0.2, len(mount))
    for cloud in (np.concatenate([room, mount]), drop_fields(np.concatenate([room, mount]), "ring")):
        scan = reading_of(cloud, "lidar", FIRST, "here").scan
        assert len(np.unique(scan.ring)) == 16
        assert np.linalg.norm(scan.points, axis=1).min() >= FIRST.min_range_m
    with pytest.raises(SourceError, match=r"nearer than min_range_m 0\.4 m"):
        to_scan(mount, "lidar", FIRST, "here")


VLP16_DEG = np.arange(-15.0, 16.0, 2.0)
HDL32_DEG = -30.67 + np.arange(32) * 4.0 / 3.0
UNEVEN64_DEG = np.concatenate([-24.33 + np.arange(32) * 0.5, -8.33 + np.arange(32) / 3.0])
UNEVEN32_DEG = np.concatenate(
    [[-25.0, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -4.667], np.linspace(-4, 5 / 3, 18)]
    + [[7 / 3, 10 / 3, 4.667, 7.0, 10.333, 15.0]]
)


def sweep(elevations_deg, offsets_m=0.0, n=1200, seed=0, low_m=0.8, high_m=12.0):
    """Make a cloud of n returns a laser at smoothly varying distances, with the lasers' numbers."""
    rng = np.random.default_rng(seed)
    azimuth = np.tile(np.linspace(0, 2 * np.pi, n, endpoint=False), (len(elevations_deg), 1)).T
    phase = rng.uniform(0, 6, size=len(elevations_deg))
    range_m = low_m + (high_m - low_m) * (0.5 + 0.5 * np.sin(3 * azimuth + phase)) ** 2
    elevation = np.radians(elevations_deg)
    flat = range_m * np.cos(elevation)
    z = range_m * np.sin(elevation) + offsets_m
    points = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], axis=-1).reshape(-1, 3)
    return points.astype(np.float32), np.tile(np.arange(len(elevations_deg)), n)


@pytest.mark.parametrize(
    "elevations_deg", [VLP16_DEG, HDL32_DEG, UNEVEN32_DEG, UNEVEN64_DEG, VLP16_DEG - 7.3]
)
def test_every_point_gets_the_number_of_its_laser(elevations_deg):
    points, laser = sweep(elevations_deg)
    np.testing.assert_array_equal(rings_from_elevation(points), laser)


def test_laser_with_few_returns_keeps_its_ring():
    points, laser = sweep(VLP16_DEG)
    keep = (laser < 13) | (np.arange(len(laser)) % 97 == 0)
    ring = rings_from_elevation(points[keep])
    assert all(len(np.unique(ring[laser[keep] == k])) == 1 for k in range(16))


@pytest.mark.parametrize("n", [1, 2])
def test_cloud_of_few_points_has_no_rings(n):
    with pytest.raises(SourceError):
        rings_from_elevation(np.array([[3.0, 1.0, 0.2], [5.0, 2.0, 1.9]])[:n])
