"""`lce-rig collect` on sensors that send over UDP and pipes."""

from collections.abc import Callable
from pathlib import Path

import pytest
from wire.collecting import Collecting
from wire.reel import Reel
from wire.rig import WireRig

from tests.collect.live.sent import (
    captured_names,
    check_sent,
    check_stamps,
    check_whole,
    errors,
    journal_of,
    read_sent,
)

Start = Callable[..., WireRig]


@pytest.mark.long
def test_captures_appear_by_themselves_and_hold_what_was_sent(
    wire: Start, reel: Reel, tmp_path: Path
) -> None:
    rig, session = wire(), tmp_path / "session"
    with Collecting(rig.profile, session, "--hold", "0", "--captures", "2") as collecting:
        assert collecting.wait() == 0
    with Collecting(rig.profile, session, "--hold", "0", "--captures", "3") as again:
        assert again.wait() == 0
    captures, sent = check_whole(session), read_sent(reel, rig.rig.lidars["lidar"])
    assert [capture.name for capture in captures] == ["000000", "000001", "000002"]
    assert captured_names(collecting.said) + captured_names(again.said) == [each.name for each in captures]
    for capture in captures:
        check_stamps(capture, check_sent(capture, sent), reel.n_placements)
    assert [entry["ending"] for entry in journal_of(session)] == ["frames", "frames"]


def test_a_collection_without_captures_ends_in_time_and_says_what_to_check(
    wire: Start, tmp_path: Path
) -> None:
    with Collecting(wire().profile, tmp_path / "session", "--hold", "30", "--timeout", "1") as collecting:
        assert collecting.wait() == 6
    assert len(errors(collecting.said)) == 1
    assert [entry["ending"] for entry in journal_of(tmp_path / "session")] == ["timeout"]
