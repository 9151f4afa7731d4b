"""Targets: found by name; ambiguous paths and options are refused."""

import shlex

import pytest

from lce_rig.core.errors import ProfileError, TargetError, UsageError
from lce_rig.fleet.deployment import standing
from lce_rig.fleet.place import Place
from lce_rig.fleet.releases import find_target, read_targets
from lce_rig.fleet.target import TargetSettings


def write(path, text):
    path.write_text(text)
    return path


def test_find_target_beside_the_session(tmp_path):
    session = tmp_path / "session"
    session.mkdir()
    with pytest.raises(UsageError):
        find_target("heron", None, session)
    write(tmp_path / "deploy.yaml", "targets: {heron: {to: calib}, kestrel: {to: 'robot@kestrel:calib'}}")
    # A relative folder is one beside the file that names it.
    assert find_target("heron", None, session).to == str(tmp_path / "calib")
    assert find_target("kestrel", None, session).host == "robot@kestrel"
    other = write(tmp_path / "other.yaml", "targets: {kestrel: {to: /other}}")
    assert find_target("kestrel", other, session).to == "/other"
    with pytest.raises(UsageError) as caught:
        find_target("heron", other, session)
    assert "kestrel" in caught.value.hint


@pytest.mark.parametrize("text", ["", "[heron]"])
def test_targets_empty_file_gets_own_advice(tmp_path, text):
    with pytest.raises(ProfileError) as caught:
        read_targets(write(tmp_path / "deploy.yaml", text))
    assert "deploy.yaml" in caught.value.what and "targets:" in caught.value.hint
    assert "rigs new" not in caught.value.hint


@pytest.mark.parametrize(
    ("to", "host", "path"),
    [
        ("/opt/calibration", None, "/opt/calibration"),
        ("robot@kestrel.local:calibration", "robot@kestrel.local", "calibration"),
        ("kestrel:~/calibration", "kestrel", "calibration"),
        ("robot@[fe80::1%eth0]:/opt/c", "robot@[fe80::1%eth0]", "/opt/c"),
        ("./a:b", None, "./a:b"),
    ],
)
def test_targets_have_scp_syntax(to, host, path):
    target = TargetSettings(to=to)
    assert (target.host, target.path) == (host, path)


@pytest.mark.parametrize(
    "text",
    [
        "to: ''",
        "to: -oProxyCommand=touch",
        "to: 'kestrel:-rf'",
        "to: 'robot@:c'",
        "to: '@kestrel:c'",
        "to: /opt\n    formats: [nonsense]",
        "to: 'kestrel:a b'",
        "to: 'kestrel:$(reboot)'",
        "to: /opt\n    ssh: {Port: 22}",
        "to: 'kestrel:c'\n    ssh: {ProxyCommand: touch}",
        "to: 'kestrel:c'\n    ssh: {LocalCommand: touch}",
        "to: 'kestrel:c'\n    ssh: {KnownHostsCommand: touch}",
        "to: 'kestrel:c'\n    ssh: {PKCS11Provider: /tmp/a.so}",
        "to: 'kestrel:c'\n    ssh: {Match: exec touch}",
        "to: 'kestrel:c'\n    ssh: {ProxyJump: '-oProxyCommand=touch'}",
        "to: 'kestrel:c'\n    ssh: {ProxyJump: 'a,$(touch x)'}",
        "to: 'kestrel:c'\n    ssh: {User: '$(touch x)'}",
        "to: 'kestrel:c'\n    ssh: {Port: '22 -oProxyCommand=touch'}",
        "to: '{robot}@kestrel:$(touch)'",
        "to: /opt\n    keep: 1",
    ],
)
def test_targets_shell_words_are_refused(tmp_path, text):
    path = write(tmp_path / "deploy.yaml", f"targets:\n  kestrel:\n    {text}\n")
    with pytest.raises(ProfileError, match=r"deploy\.yaml:[34]:"):
        read_targets(path)


def test_place_passes_arguments_unchanged(tmp_path):
    words = Place(TargetSettings(to="kestrel:c", ssh={"Port": 2222})).command("echo $2", "it's; $(reboot)")
    assert words[0] == "ssh" and "Port=2222" in words and "BatchMode=yes" in words
    assert words[-2] == "kestrel"
    assert shlex.split(words[-1]) == ["sh", "-c", "echo $2", "sh", "c", "it's; $(reboot)"]


@pytest.mark.long
def test_place_unreachable_host_is_explained():
    with pytest.raises(TargetError) as caught:
        standing(TargetSettings(to="robot@127.0.0.1:c", ssh={"Port": 1}))
    assert "no connection" in caught.value.what and caught.value.exit_code == 8


def test_a_jump_over_hosts_is_allowed():
    jump = "ann@gate:2222,[fe80::1]"
    assert TargetSettings(to="kestrel:c", ssh={"ProxyJump": jump}).ssh == {"ProxyJump": jump}


def test_the_name_of_a_robot_is_put_into_the_place_only(tmp_path):
    text = "targets: {nav: {to: 'robot@{robot}.local:calib', run: 'echo {robot}'}}"
    (target,) = read_targets(write(tmp_path / "deploy.yaml", text)).values()
    own = target.for_robot("r17")
    assert (own.host, own.robot, own.run) == ("robot@r17.local", "r17", "echo {robot}")
    for name in ("a}]}\n  b", "-oProxyCommand=touch", "$(touch x)", "a b", "../r1", ""):
        with pytest.raises(ValueError):
            target.for_robot(name)
    with pytest.raises(UsageError):
        find_target("nav", tmp_path / "deploy.yaml", tmp_path)
