"""What a profile may say about pictures from events."""

from pathlib import Path

import pytest

from lce_rig.core.errors import ProfileError
from lce_rig.rig import Rig, dump_rig, find_profile, load_rig, parse_rig

RLES = find_profile("rles").read_text(encoding="utf-8")
KIND = "        kind: events\n"


def with_block(block: str, kind: str = KIND) -> str:
    assert kind in RLES
    return RLES.replace(kind, f"{kind}        reconstruction: {block}\n", 1)


def model_of(rig: Rig) -> str | None:
    settings = rig.cameras["davis"].channels["events"].reconstruction
    assert settings is not None
    return settings.model


def refusal(text: str) -> str:
    with pytest.raises(ProfileError) as caught:
        parse_rig(text, "mine.yaml")
    return str(caught.value)


def test_a_relative_path_begins_at_the_profiles_folder_and_stays_absolute_in_a_session(
    tmp_path: Path,
) -> None:
    (tmp_path / "mine.yaml").write_text(with_block("{model: nets/other.onnx}"), encoding="utf-8")
    rig = load_rig(tmp_path / "mine.yaml")
    assert model_of(rig) == str(tmp_path / "nets" / "other.onnx")
    frozen = tmp_path / "elsewhere" / "rig.yaml"
    frozen.parent.mkdir()
    frozen.write_text(dump_rig(rig), encoding="utf-8")
    assert load_rig(frozen) == rig


def test_an_absolute_path_stays_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "other.onnx"
    (tmp_path / "mine.yaml").write_text(with_block(f"{{model: {path}}}"), encoding="utf-8")
    assert model_of(load_rig(tmp_path / "mine.yaml")) == str(path)


@pytest.mark.parametrize(
    ("block", "key"),
    [
        ("{window_s: 0.05, window_events: 100}", "window_events"),
        ("{method: map, model: x.onnx}", "model"),
        ("{windows_s: 0.05}", "windows_s"),
        ("{window_s: 50}", "window_s"),
        ("{window_events: 0}", "window_events"),
        ("{method: e2vid}", "method"),
        ("{model: ''}", "model"),
    ],
)
def test_what_cannot_be_meant_is_named_with_its_line(block: str, key: str) -> None:
    text = with_block(block)
    line = text[: text.index("reconstruction:")].count("\n") + 1
    assert f"mine.yaml:{line}: cameras.davis.channels.events.reconstruction.{key}: " in refusal(text)


def test_frames_are_not_reconstructed() -> None:
    message = refusal(with_block("{method: network}", "        kind: frames\n"))
    assert "channels.frames.reconstruction:" in message
