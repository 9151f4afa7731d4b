"""`lce-rig collect` from recordings with raw events: captures, and messages without any."""

from dataclasses import replace

import pytest

from lce_rig.core.data import Events, Image
from lce_rig.session import Session
from tests.collect import simulated_moves as moves
from tests.io.events.aedat4_files import RawFrame, write_aedat4, write_davis


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A LiDAR's bag, and files of the DAVIS beside it: intact, of another time, of another camera, empty."""
    path = tmp_path_factory.mktemp("recordings")
    moves.bag(path / "lidar.bag", moves.without(Image, Events))
    frames = [s for s in moves.samples() if isinstance(s, Image)]
    raw = [RawFrame(frame.stamp_ns // 1000 - 4000, 8000, frame.pixels) for frame in frames]
    write_davis(path / "davis.aedat4", moves.events(), raw)
    late_ns = 1_234_500_000_000
    write_aedat4(path / "late.aedat4", [replace(e, t_ns=e.t_ns + late_ns) for e in moves.events()])
    other = replace(moves.events()[0], width_px=640, height_px=480)
    write_aedat4(path / "other.aedat4", [other])
    write_aedat4(path / "none.aedat4", [])
    return path


def collect(lce_rig, folder, session, *names):
    sources = [word for name in names for word in ("--from", folder / name)]
    return lce_rig("collect", "--rig", "rles", session, *sources)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (
            ["lidar.bag", "late.aedat4"],
            ["s apart", "cameras.davis.channels.events.timestamps.expected_offset_s"],
        ),
        (["lidar.bag", "other.aedat4"], ["640x480", "346x260"]),
        (["lidar.bag", "none.aedat4"], ["none.aedat4"]),
        (["davis.aedat4"], ["--from lidar.bag --from events.aedat4"]),
        (["lidar.bag"], ["/davis/image_raw", "davis.frames"]),
    ],
)
def test_unusable_event_recording_error_has_action(lce_rig, folder, tmp_path, names, said):
    outcome = collect(lce_rig, folder, tmp_path / "s", *names)
    assert outcome.code == 5
    assert all(text in outcome.err for text in said)


def test_collect_few_events_is_refused(lce_rig, tmp_path):
    few = [s.select(slice(None, None, 400)) if isinstance(s, Events) else s for s in moves.samples()]
    moves.bag(tmp_path / "few.bag", few)
    outcome = collect(lce_rig, tmp_path, tmp_path / "s", "few.bag")
    assert outcome.code == 6
    assert "few.bag" in outcome.err and "10 cm/s" in outcome.err
    assert not Session.open(tmp_path / "s").captures
