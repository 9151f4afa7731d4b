"""Sessions and registry in an S3 store: the same results as on a disk, byte for byte."""

import pytest
from benchmarks.fleet import files_of, s3_server

from lce_rig.fleet.jobs import find_jobs
from lce_rig.fleet.registry import Registry, write_rows
from lce_rig.fleet.storage import Storage
from lce_rig.fleet.work import Settings, work


@pytest.fixture
def bucket():
    with s3_server() as address:
        yield Storage(address)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_the_same_sessions_give_the_same_files_in_a_store_and_on_a_disk(fleet_root, tmp_path, bucket):
    here = tmp_path / "registry"
    bucket.fs.put(f"{fleet_root}/", f"{bucket.path}/sessions", recursive=True)
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
def test_a_result_in_a_store_counts_when_its_rows_are_there(row, bucket):
    registry = Registry(bucket / "registry")
    with registry.result("r1/a") as draft:
        (draft / "old.txt").write_text("1")
        fresh = write_rows(draft, [row(folder="r1/a", source="s")])
    assert registry.consolidate(fresh)["folder"].to_pylist() == ["r1/a"]
    with registry.result("r1/a") as draft:
        (draft / "new.txt").write_text("2")
        write_rows(draft, [row(folder="r1/a", source="s", n_used=9)])
    assert (registry.place / "r1/a").names() == ["fleet.json", "new.txt"]
    assert registry.consolidate(rebuild=True)["n_used"].to_pylist() == [9]
    registry.place.fs.rm_file((registry.place / "r1/a/fleet.json").path)
    assert registry.rows("r1/a") == [] and len(registry.consolidate(rebuild=True)) == 0
    with registry.result("r1/a") as draft:
        write_rows(draft, [row(folder="r1/a", source="s")])
    registry.set_aside("r1/a")
    assert registry.folders() == []
    aside = registry.place / ".superseded/r1"
    kept = {name: (aside / name).names() for name in aside.names()}
    assert kept == {"a": ["fleet.json", "old.txt"], "a-2": ["new.txt"], "a-3": ["fleet.json"]}
