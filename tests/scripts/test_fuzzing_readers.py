"""The campaign against readers finds what is planted, repeats itself, and finds nothing else."""

import json
import os
import pickle
import signal
import struct
import zipfile
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fuzzing import layers, reader_cases, sanity
from fuzzing.bomb_files import deflated, zip_of
from fuzzing.mutations import damaged
from fuzzing.reader_cases import WRONG, damaged_files, run_case
from fuzzing.reader_table import READERS, Reader
from fuzzing.readers import ReaderReport, _Worker, fuzz_readers, make_seeds
from fuzzing.samples import simulated_samples

from lce_rig.core.data import Scan
from lce_rig.core.errors import LceRigError, SourceError
from lce_rig.core.pcd import decode_pcd

SOUND = b"seven 7\n"


def one_reader(monkeypatch: pytest.MonkeyPatch, read: Any, **more: Any) -> None:
    reader = Reader(lambda _samples: [{"a.txt": SOUND * 20}], read, **more)
    monkeypatch.setitem(READERS, "planted", reader)


def outcome_of(tmp_path: Path, case: int = 1) -> reader_cases.Outcome:
    return run_case("planted", [{"a.txt": SOUND * 20}], 0, case, tmp_path / "case")


def said(report: ReaderReport) -> str:
    return "\n".join(f"{w.reader}: {w.what}: {w.reproduce}\n{w.detail}" for w in report.wrong)


def test_the_same_case_gives_the_same_bytes_and_another_gives_others() -> None:
    seeds = {name: READERS[name].make(simulated_samples()) for name in ("pcd-binary", "session.json")}
    for name, own in seeds.items():
        cases = [[damaged_files(name, own, 3, case) for case in range(1, 30)] for _ in range(2)]
        assert cases[0] == cases[1]
        assert len({json.dumps({k: v.hex() for k, v in each.items()}) for each in cases[0]}) > 20


def test_every_form_of_damage_changes_a_document() -> None:
    sound = json.dumps({"a": [1, 2.5, "x"], "b": {"c": True}}).encode()
    for form in ("bytes", "text", "json", "lines"):
        made = {damaged(sound, [sound[::-1]], form, np.random.default_rng(k)) for k in range(100)}  # type: ignore[arg-type]
        assert len(made - {sound}) > 60, form


def crash(_folder: Path) -> None:
    raise IndexError("planted")


def refuse(_folder: Path) -> None:
    raise SourceError("it is damaged")


def warn(_folder: Path) -> None:
    np.float32(1e30) * np.full(3, np.float32(1e30))


def refuse_without_words(_folder: Path) -> None:
    raise SourceError("")


def refuse_as_a_bug(_folder: Path) -> None:
    error = LceRigError("it is damaged")
    error.exit_code = 70
    raise error


def swallow_memory(_folder: Path) -> None:
    np.ones(10_000_000)


def accept_the_impossible(_folder: Path) -> None:
    n = np.full((3, 3), np.nan, np.float32)
    sanity.check_scan(Scan("lidar", 0, n, np.zeros(3, np.float32), np.zeros(3, np.int16)))


@pytest.mark.parametrize(
    "read", [crash, warn, refuse_without_words, refuse_as_a_bug, swallow_memory, accept_the_impossible]
)
def test_whatever_a_reader_must_not_do_is_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Any
) -> None:
    one_reader(monkeypatch, read)
    monkeypatch.setattr(reader_cases, "MAX_GROWN_BYTES", 60_000_000)
    assert outcome_of(tmp_path).verdict == WRONG


def test_a_refusal_in_words_is_right_but_not_of_sound_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one_reader(monkeypatch, refuse)
    assert outcome_of(tmp_path).verdict == reader_cases.REFUSED
    assert "sound input" in outcome_of(tmp_path, case=0).what


def test_inner_parts_are_put_back_as_they_were() -> None:
    samples = simulated_samples()
    grey = samples.images[0].pixels
    png = READERS["png"].make(samples)[0]["a.png"]
    for layer in (layers.PNG_CHUNKS, layers.PNG_ROWS):
        again = layer.join(png, layer.split(png))
        assert np.array_equal(cv2.imdecode(np.frombuffer(again, np.uint8), cv2.IMREAD_UNCHANGED), grey)
    pcd = READERS["pcd-compressed"].make(samples)[0]["a.pcd"]
    column = layers.PCD_COLUMNS
    assert decode_pcd(column.join(pcd, column.split(pcd))).tobytes() == decode_pcd(pcd).tobytes()
    for name, layer, suffix in (
        ("ros1-bz2", layers.ROS1_CHUNKS, ".bag"),
        ("mcap-lz4", layers.MCAP_CHUNKS, ".mcap"),
        ("db3", layers.messages_of(".db3"), ".db3"),
    ):
        bag = READERS[name].make(samples)[0][f"a{suffix}"]
        again = layer.join(bag, layer.split(bag))
        contents = [[(c.topic, t, raw) for c, t, raw in layers.messages_in(d, suffix)] for d in (bag, again)]
        assert contents[0] == contents[1] and len(contents[0]) >= 5, name


def test_zips_laid_out_here_are_what_zipfile_reads() -> None:
    n = 1 << 24
    with zipfile.ZipFile(BytesIO(zip_of({"a": (deflated(b"7", n), n)}))) as archive:
        assert archive.read("a") == b"7" * n
    assert struct.unpack("<I", zip_of({"a": (deflated(b"7", n), n)})[14:18])[0] == zlib.crc32(b"7" * n)


@pytest.mark.long
@pytest.mark.parametrize(
    ("number", "what"),
    [(signal.SIGKILL, "the process died of signal 9"), (signal.SIGSTOP, "longer than 10 s: killed")],
)
def test_a_process_that_hangs_or_dies_costs_one_case_and_is_named(
    tmp_path: Path, number: signal.Signals, what: str
) -> None:
    (tmp_path / "seeds").write_bytes(pickle.dumps(make_seeds(["reference"])))
    worker, found = _Worker(tmp_path), list[reader_cases.Outcome]()
    for outcome in worker.run("reference", 0, 20_000, 1e9):
        found.append(outcome)
        if len(found) == 3:
            assert worker._process is not None
            os.kill(worker._process.pid, number)
        if outcome.what == what or len(found) > 19_000:
            break
    assert found[-1].what == what and found[-1].verdict == WRONG
    assert [outcome.case for outcome in found] == list(range(len(found)))
    after = next(iter(worker.run("reference", 0, 1, 1e9)))
    worker.stop()
    assert after.verdict == reader_cases.ACCEPTED


# Readers whose sound input is made quickly.
_QUICK = (
    *(
        "pcd-ascii",
        "pcd-binary",
        "pcd-compressed",
        "ply-big-endian",
        "png",
        "jpeg",
        "stream-y4m",
        "ros1-torn",
    ),
    *("aedat4-zstd", "evt2", "evt3", "hdf5", "npz-foreign", "text-zip", "session.json", "manifest"),
    *("stored-scan", "detection-cache", "rig-values", "result.json", "reference", "urdf"),
)


@pytest.mark.long
def test_damaged_files_are_refused_or_read_right() -> None:
    report = fuzz_readers(8, 0, names=_QUICK)
    assert report.n_wrong == 0, said(report)
    assert report.n == 8 * len(_QUICK)
    assert report.n_refused > 50 and report.n_accepted > 25


@pytest.mark.long
def test_a_minute_of_damaged_files_for_every_reader_finds_nothing() -> None:
    report = fuzz_readers(60, 1, jobs=2)
    assert report.n_wrong == 0, said(report)
    assert report.n == 60 * len(READERS) and len(READERS) >= 46
    assert all(counts["n_refused"] + counts["n_accepted"] == 60 for counts in report.readers.values())
