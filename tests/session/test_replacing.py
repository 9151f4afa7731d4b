"""Folders of results change whole, even if a process is killed meanwhile."""

import signal
import subprocess
import sys
import time

import pytest

from lce_rig.core.errors import SessionError
from lce_rig.session import Session
from lce_rig.session.durable import copy_over, recover, replacing

ENDLESS = """
import sys, pathlib
from lce_rig.session.durable import replacing
root = pathlib.Path(sys.argv[1])
print("started", flush=True)
for k in range(10**6):
    with replacing(root, root / "out") as draft:
        for name in "abc":
            (draft / name).write_text(str(k))
"""


def fill(root, text, **options):
    with replacing(root, root / "out", **options) as draft:
        (draft / "a").write_text(text)
        (draft / "sub").mkdir()
        (draft / "sub" / "b").write_text(text)


def contents(folder):
    return {path.read_text() for path in folder.rglob("*") if path.is_file()}


def test_an_error_leaves_the_earlier_folder(tmp_path):
    fill(tmp_path, "one")
    with pytest.raises(ZeroDivisionError), replacing(tmp_path, tmp_path / "out") as draft:
        (draft / "a").write_text("two")
        raise ZeroDivisionError

    def refuse(_old, _draft):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fill(tmp_path, "two", finish=refuse)
    assert contents(tmp_path / "out") == {"one"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_replace_in_linked_session_only(tmp_path):
    """A link in place of the folder to replace is refused."""
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    for text in ("one", "two"):
        fill(tmp_path / "link", text)
        assert contents(tmp_path / "real" / "out") == {text}
    (tmp_path / "real" / "out").rename(tmp_path / "real" / "may")
    (tmp_path / "real" / "out").symlink_to("may")
    with pytest.raises(SessionError):
        fill(tmp_path / "link", "three")
    assert {path.name for path in (tmp_path / "real").iterdir()} == {"out", "may"}
    assert contents(tmp_path / "real" / "may") == {"two"}


def test_killed_replacement_leaves_one_complete_folder(tmp_path):
    fill(tmp_path, "first")
    for k in range(2):  # scripts/fuzz.py result-kills does it by the hundred
        process = subprocess.Popen([sys.executable, "-c", ENDLESS, str(tmp_path)], stdout=subprocess.PIPE)
        process.stdout.readline()
        time.sleep(0.007 * k)
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        recover(tmp_path)
        assert len(contents(tmp_path / "out")) == 1
    fill(tmp_path, "last")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_folder_moved_by_killed_process_is_restored(tmp_path):
    fill(tmp_path, "one")
    (tmp_path / "out").rename(tmp_path / ".old-out")
    recover(tmp_path)
    assert contents(tmp_path / "out") == {"one"}


def test_draft_in_use_is_kept(tmp_path):
    with replacing(tmp_path, tmp_path / "out") as slow:
        (slow / "a").write_text("slow")
        fill(tmp_path, "quick")
        assert contents(tmp_path / "out") == {"quick"}
    assert contents(tmp_path / "out") == {"slow"}


def test_copies_share_their_data_and_links_stay_links(tmp_path):
    (tmp_path / "one" / "deep").mkdir(parents=True)
    (tmp_path / "one" / "deep" / "file").write_text("x")
    (tmp_path / "one" / "link").symlink_to("/etc/hostname")
    copy_over(tmp_path / "one", tmp_path / "two")
    assert (tmp_path / "two" / "deep" / "file").stat().st_nlink == 2
    assert (tmp_path / "two" / "link").is_symlink()


def test_link_within_session_is_followed(tmp_path, rig, samples):
    Session.create(tmp_path / "s", rig).close()
    (tmp_path / "s" / "captures").rmdir()
    (tmp_path / "s" / "more").mkdir()
    (tmp_path / "s" / "captures").symlink_to("more")
    with Session.open(tmp_path / "s", writable=True) as session:
        assert session.add_capture(*samples(0), {}) == "000000"
