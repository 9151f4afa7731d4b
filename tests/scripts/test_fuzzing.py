"""Ctrl-C at random moments of every verb, and hostile inputs."""

import pytest
from fuzzing.hostile import HOSTILE, N_NEIGHBOURS, add_result
from fuzzing.inputs import MOST_MB, MOST_S, run_limited
from fuzzing.interrupts import fuzz_interrupts
from fuzzing.mutations import TARGETS, fuzz_mutations

from lce_rig.session import Session


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A simulated session of three captures with a result."""
    folder = tmp_path_factory.mktemp("whole") / "session"
    made = run_limited(["simulate", "--rig", "rlfs", "--captures", "3", str(folder)])
    assert made.code == 0, made.text
    add_result(folder)
    return folder


@pytest.mark.realtime
@pytest.mark.long
def test_every_verb_ends_within_two_seconds_of_ctrl_c():
    report = fuzz_interrupts(22, seed=0)
    assert report.n_wrong == 0, report.wrong
    assert len(report.kinds) >= 9


@pytest.mark.realtime
@pytest.mark.long
@pytest.mark.parametrize(
    "name",
    ["las_vlrs", "png_chunk_2g", "pcd_lzf", "png_zero", "pcd_pipe", "mcap_lz4", "mcap_false_size", "bag_lz4",
     "db3_zstd", "pcap_100gb", "raw_pipe", "rig_wide", "manifest_zero", "into_pipe", "targets_zero"],
)  # fmt: skip
def test_hostile_input_is_refused_in_little_memory(tmp_path, whole, name):
    (tmp_path / name).mkdir()
    outcome = run_limited(HOSTILE[name](tmp_path / name, whole))
    assert outcome.peak_mb < MOST_MB and outcome.seconds < 4 * MOST_S, outcome
    assert outcome.code in range(10) and "Traceback" not in outcome.text, outcome.text
    if (tmp_path / name / "recording").is_dir():
        assert len(Session.open(tmp_path / name / "session").captures) == N_NEIGHBOURS


@pytest.mark.long
def test_fuzz_mutations_damaged_files_are_no_crash():
    report = fuzz_mutations(2 * len(TARGETS), seed=2)
    assert [each for each in report.wrong if "took" not in each] == []
