"""Sessions and registry in an S3 store: the same results as on a disk, byte for byte."""

import contextlib
import json
import logging
import os
from urllib.request import Request, urlopen

import pytest
from moto.server import ThreadedMotoServer
from s3fs import S3FileSystem

from lce_rig.cli.main import run
from lce_rig.fleet.jobs import find_jobs
from lce_rig.fleet.registry import TABLE, Registry, write_rows
from lce_rig.fleet.storage import Storage
from lce_rig.fleet.work import Settings, work


@contextlib.contextmanager
def s3_server():
    """Serve S3 on loopback, with a bucket `fleet`; the environment names it while the block lasts."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    settings = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    before = {name: os.environ.get(name) for name in settings}
    os.environ |= settings
    S3FileSystem.clear_instance_cache()  # an instance keeps the address that it was made with
    try:
        # Servers of one process share what they hold.
        urlopen(Request(f"http://{host}:{port}/moto-api/reset", method="POST")).close()
        S3FileSystem().mkdir("fleet")
        yield "s3://fleet"
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value
        server.stop()


def files_of(place):
    """Read every file of a registry but the table, without the figures that differ between runs."""
    files = {}
    for name in place.files():
        data = (place / name).read() or b""
        if name.endswith("fleet.json"):
            document = json.loads(data)
            for row in document["rows"]:
                for key in ("duration_s", "finished", "source"):
                    row.pop(key)
            data = json.dumps(document).encode()
        if name != TABLE:
            files[name] = data
    return files


@pytest.fixture
def bucket():
    with s3_server() as address:
        yield Storage(address)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_fleet_s3_files_equal_those_on_disk(fleet_root, tmp_path, bucket):
    here = tmp_path / "registry"
    with bucket.reached() as (fs, path):
        fs.put(f"{fleet_root}/", f"{path}/sessions", recursive=True)
    registries = {}
    for root, place in ((Storage.at(fleet_root), here), (bucket / "sessions", bucket / "registry")):
        settings = Settings(place.url if isinstance(place, Storage) else str(place))
        jobs = find_jobs(root)
        assert len(jobs) == 3
        fresh = [row for job in jobs for row in work(job, settings, lambda _: None)]
        registry = registries[place] = settings.opened()
        registry.consolidate(fresh)
        again = [row for job in jobs for row in work(job, settings, lambda _: None)]
        assert [row["is_new"] for row in again] == [False, False, True], "the torn one is tried again"
    there = files_of(bucket / "registry")
    on_disk = files_of(Storage.at(here))
    # A session that cannot be read is known by its address only.
    known = {name: data for name, data in on_disk.items() if "unread-" not in name}
    assert {name: data for name, data in there.items() if "unread-" not in name} == known
    assert len(known) > 5 and len(there) == len(on_disk)


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_stored_result_counts_once_its_rows_exist(row, bucket):
    registry = Registry(bucket / "registry")

    def write(name, **changes):
        with registry.result("r1/a") as draft:
            (draft / name).write_text(name)
            write_rows(draft, [row(folder="r1/a", source="s", status="failed") | changes])

    write("old.txt")
    assert registry.consolidate()["folder"].to_pylist() == ["r1/a"]
    write("new.txt", n_used=9)
    assert (registry.place / "r1/a").names() == ["fleet.json", "new.txt"]
    assert registry.consolidate(rebuild=True)["n_used"].to_pylist() == [9]
    with registry.place.reached() as (fs, path):
        fs.rm_file(f"{path}/r1/a/fleet.json")
    assert registry.rows("r1/a") == [] and len(registry.consolidate(rebuild=True)) == 0
    registry.set_aside("r1/a")
    assert registry.folders() == []
    aside = registry.place / ".superseded/r1"
    kept = {name: (aside / name).names() for name in aside.names()}
    assert kept == {"a": ["fleet.json", "old.txt"], "a-2": ["new.txt"]}


@pytest.mark.parametrize("words", [["table"], ["run", "ROOT"], ["report"], ["deploy", "--target", "nav"]])
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_a_store_that_cannot_be_reached_is_one_error(tmp_path, monkeypatch, capsys, words):
    (tmp_path / "deploy.yaml").write_text("targets: {nav: {to: /tmp/x}}")
    monkeypatch.chdir(tmp_path)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    S3FileSystem.clear_instance_cache()
    root = "s3://nowhere/sessions"
    words = [root if word == "ROOT" else word for word in words]
    assert run(["fleet", *words, "--registry", "s3://nowhere/registry"]) == 5
    assert "Traceback" not in capsys.readouterr().err
    S3FileSystem.clear_instance_cache()
