"""Damaged packets of a VLP-16 between sound ones, fed to the receiver."""

import pytest
from fuzzing.vlp16_packets import fuzz_packets


def test_damaged_packets_make_no_point_that_was_not_sent():
    report = fuzz_packets(1_500, seed=0)
    assert report.n_wrong == 0
    assert report.n_scans > 30 and report.n_points > 80_000
    kinds = (
        "wrong_flag",
        "wrong_length",
        "uneven_azimuths",
        "unknown_factory_bytes",
        "other_model",
        "unknown_pps",
    )
    assert {f"packet.{kind}" for kind in kinds} <= report.refused.keys()
    assert report.refused["packet.astray"] > 50


@pytest.mark.slow
def test_a_million_damaged_packets_leave_memory_as_it_was():
    report = fuzz_packets(1_000_000, seed=1)
    assert report.n_wrong == 0
    assert report.grown_bytes < 4_000_000
