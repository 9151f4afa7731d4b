"""Damaged lines of sync boards, fed to the parsers in pieces."""

import pytest
from fuzzing.serial_lines import fuzz_lines

from lce_rig.devices.sync_board.lines.messages import LineFault


def test_damaged_lines_make_no_message_that_their_sum_denies():
    report = fuzz_lines(12_000, seed=0)
    assert report.n_wrong == 0, report.wrong
    assert report.n_messages > 1000
    assert all(report.faults[fault.value] > 100 for fault in LineFault)


@pytest.mark.slow
def test_a_million_damaged_lines_leave_memory_as_it_was():
    report = fuzz_lines(1_000_000, seed=1)
    assert report.n_wrong == 0, report.wrong
    assert report.grown_bytes < 4_000_000
