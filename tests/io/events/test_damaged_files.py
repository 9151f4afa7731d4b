"""Damaged recordings of events: the events before and behind the damage, or one error that names the file."""

from functools import cache
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.errors import SourceError
from lce_rig.io.events import open_events
from tests.damage import damaged
from tests.io.events.encoders import random_events
from tests.io.events.test_files import START_US, WRITERS

EVENTS = random_events(200, 7, start_us=START_US)


@cache
def whole(folder: Path, name: str) -> bytes:
    WRITERS[name](folder / name, EVENTS)
    return (folder / name).read_bytes()


@pytest.mark.parametrize("name", ["a.aedat4", "a.h5", "a.raw", "a.txt"])
@given(data=st.data())
def test_damaged_events_are_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, name: str, data: st.DataObject
) -> None:
    folder = tmp_path_factory.getbasetemp()
    path = folder / "damaged" / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data.draw(damaged(whole(folder, name))))
    try:
        for events in open_events(path, resolution=(346, 260)):
            assert len(events.t_ns) == len(events.x) > 0
            assert events.x.max() < 346 and events.y.max() < 260
            assert (events.t_ns[1:] >= events.t_ns[:-1]).all()
    except SourceError as error:
        assert name in error.what
        assert "\n" not in error.what
