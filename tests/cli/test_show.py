"""Progress of long work in a file or a pipe."""

from lce_rig.cli.show import ProgressLines


def lines_of(capsys, seconds_each, n):
    now_s = 0.0
    progress = ProgressLines("collecting", lambda: now_s)
    for done in range(1, n + 1):
        now_s += seconds_each
        progress(done, n)
    return capsys.readouterr().err.splitlines()


def test_progress_lines_every_tenth_is_printed(capsys):
    lines = lines_of(capsys, 0.1, 300)
    assert len(lines) == 9 and lines[0] == "collecting: 30 of 300 (10 %)"


def test_progress_lines_slow_work_is_reported_regularly(capsys):
    assert len(lines_of(capsys, 10.0, 100)) == 39


def test_progress_lines_short_work_prints_nothing(capsys):
    assert lines_of(capsys, 0.001, 300) == []
