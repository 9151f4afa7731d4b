"""Hostile connections to the preview page of a live collection."""

import pytest
from fuzzing.preview import MAX_LOG_BYTES, fuzz_preview


@pytest.mark.long
def test_two_thousand_hostile_connections_stop_no_collection():
    report = fuzz_preview(2000, seed=0)
    assert report.n_wrong == 0, report.wrong
    assert report.n_open == 2000
    assert report.n_captures >= 2
    assert report.n_pages >= 3
    assert report.log_bytes < MAX_LOG_BYTES
