"""Sessions and recordings below a root, and their entries in a manifest."""

import pytest

from lce_rig.core.errors import NotEnoughDataError, ProfileError, UsageError
from lce_rig.fleet.jobs import find_jobs
from lce_rig.fleet.storage import Storage


def lay_out(root, *sessions):
    for name in sessions:
        (root / name).mkdir(parents=True)
        (root / name / "session.json").write_text("{}")


def test_find_jobs_names_each_session_once(tmp_path):
    lay_out(tmp_path, "r1/2026/a", "r2/b", "c", "r1/2026/a/results/inner", ".hidden/d")
    jobs = find_jobs(Storage.at(tmp_path))
    found = {job.source.removeprefix(f"{tmp_path}/"): job.fallback_robot for job in jobs}
    assert found == {"r1/2026/a": "r1", "r2/b": "r2", "c": "c"}
    (job,) = find_jobs(Storage.at(tmp_path / "c"))
    assert (job.source, job.fallback_robot) == (f"{tmp_path}/c", "c")


def test_a_manifest_names_robot_and_profile_by_patterns(tmp_path):
    lay_out(tmp_path, "hall/r1/a", "hall/r2/b", "yard/r1/c")
    (tmp_path / "bags").mkdir()
    (tmp_path / "bags/r7.bag").write_bytes(b"")
    (tmp_path / "profiles").mkdir()
    (tmp_path / "profiles/r.yaml").write_text("name: r")
    (tmp_path / "fleet.yaml").write_text(
        "sessions:\n"
        "  - {path: 'hall/{robot}/*'}\n"
        "  - {path: '*/r1/*', robot: r1}\n"
        "  - {path: 'bags/{robot}.bag', rig: profiles/r.yaml}\n"
    )
    jobs = {job.source.removeprefix(f"{tmp_path}/"): job for job in find_jobs(Storage.at(tmp_path))}
    assert set(jobs) == {"hall/r1/a", "hall/r2/b", "yard/r1/c", "bags/r7.bag"}
    assert [jobs[name].robot for name in sorted(jobs)] == ["r7", "r1", "r2", "r1"]
    assert jobs["bags/r7.bag"].rig == f"{tmp_path}/profiles/r.yaml"


@pytest.mark.parametrize(
    "text",
    [
        "sessions: [{path: a, wheels: 4}]",
        "sessions: [{robot: a}]",
        "sessions: [{path: '{driver}/*'}]",
        "runs: []",
        "sessions: 3",
        "sessions: [{path: '../*'}]",
        "sessions: [{path: /etc}]",
        "[",
        "sessions: [{path: '{robot}/{robot}'}]",
        "sessions: [{path: 'a**b'}]",
        "sessions: [{path: a, robot: " + "1" * 5000 + "}]",
        'sessions: [{path: "a\\0b"}]',
        "sessions: [{path: 2026-13-45T99:99:99Z}]",
        "sessions: [{path: a, name: b}]",
        "sessions: [{path: a, robt: b}]",
        "[{path: a}]",
        "",
    ],
)
def test_a_manifest_that_cannot_be_used_is_refused(tmp_path, text):
    lay_out(tmp_path, "a")
    (tmp_path / "fleet.yaml").write_text(text)
    with pytest.raises(UsageError) as caught:
        find_jobs(Storage.at(tmp_path))
    said = f"{caught.value.what} {caught.value.hint}"
    assert caught.value.exit_code == 2 and "fleet.yaml" in said and "docs/fleets.md" in said
    assert "rig profile" not in said and "rigs new" not in said and "top level" not in said


def test_misspelt_manifest_key_suggests_nearest(tmp_path):
    lay_out(tmp_path, "a")
    (tmp_path / "fleet.yaml").write_text("sessions: [{path: a, robt: b}]")
    with pytest.raises(UsageError, match=r"sessions\.0\.robt.*robot"):
        find_jobs(Storage.at(tmp_path))


def test_find_jobs_robot_is_first_folder(tmp_path):
    lay_out(tmp_path, "r1/a", "b")
    (tmp_path / "fleet.yaml").write_text("sessions: [{path: '**/*'}, {path: '*'}]")
    jobs = {job.source.removeprefix(f"{tmp_path}/"): job for job in find_jobs(Storage.at(tmp_path))}
    assert jobs["b"].fallback_robot == "b" and jobs["r1/a"].fallback_robot == "r1"


@pytest.mark.parametrize("rig", ["nosuch.yaml", "/nosuch/r.yaml", "rlfz"])
def test_find_jobs_absent_profile_is_refused(tmp_path, rig):
    lay_out(tmp_path, "a")
    (tmp_path / "fleet.yaml").write_text(f"sessions: [{{path: '*', rig: {rig}}}]")
    with pytest.raises(ProfileError, match=rig.rpartition("/")[2]):
        find_jobs(Storage.at(tmp_path))


def test_a_root_without_sessions_is_refused(tmp_path):
    with pytest.raises(NotEnoughDataError):
        find_jobs(Storage.at(tmp_path))
    with pytest.raises(UsageError):
        find_jobs(Storage.at(tmp_path / "absent"))
