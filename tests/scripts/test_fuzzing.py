"""Ctrl-C at random moments of every verb."""

import pytest
from fuzzing.interrupts import fuzz_interrupts


@pytest.mark.long
def test_every_verb_ends_within_two_seconds_of_ctrl_c():
    report = fuzz_interrupts(22, seed=0)
    assert report.n_wrong == 0, report.wrong
    assert len(report.kinds) >= 9
