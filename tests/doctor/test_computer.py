"""The computer's lines say what the kernel and the disk do."""

from pathlib import Path

from lce_rig.doctor.checks import check_computer_clock, check_disk
from lce_rig.doctor.observing import Examination

from .observed import codes, look, make_rig


def test_the_disk_of_a_folder_that_is_not_there_yet_is_measured_and_left_clean(tmp_path: Path) -> None:
    line = look(check_disk, Examination(make_rig(), tmp_path / "not" / "yet"))
    assert line is not None
    disk = line.findings[0]
    assert disk.figure("write_mbps") > 0 and disk.figure("free_mb") > 0
    assert disk.figures["folder"] == str(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_red() -> None:
    line = look(check_disk, Examination(make_rig(), Path("/proc")))
    assert line is not None
    assert line.severity == "error" and codes(line) == ["computer.disk_not_writable"]


def test_the_clock_is_judged_by_the_kernel() -> None:
    line = look(check_computer_clock, Examination(make_rig()))
    assert line is not None
    code = "computer.clock" if line.severity == "note" else "computer.clock_not_synchronised"
    assert codes(line) == [code] and (line.severity == "note") == ("max_error_ms" in line.figures)
