"""Which driver a rig's sensors get."""

from typing import Any

import pytest

from lce_rig.core.errors import SourceError
from lce_rig.devices.opening import driver_type, open_live
from lce_rig.rig import DriverSettings, Rig, load_rig


def with_driver(rig: Rig, camera: str, **driver: Any) -> Rig:
    settings = rig.cameras[camera]
    changed = settings.model_copy(update={"driver": settings.driver.model_copy(update=driver)})
    return rig.model_copy(update={"cameras": rig.cameras | {camera: changed}})


@pytest.mark.parametrize(
    ("rig", "sources"),
    [
        ("rlfs", [("lidar", "Vlp16Source"), ("cam", "V4l2Source")]),
        ("rles", [("lidar", "Vlp16Source"), ("davis", "DavisSource")]),
    ],
)
def test_the_shipped_rigs_get_their_drivers(rig: str, sources: list[tuple[str, str]]) -> None:
    made = [(source.sensor, type(source).__name__) for source in open_live(load_rig(rig))]
    assert made[:2] == sources
    assert all(name == "SyncBoard" for _, name in made[2:])


@pytest.mark.parametrize(
    ("rig", "camera", "driver", "source"),
    [
        ("rlfs", "cam", {"type": None, "command": ("true",), "device": None}, "ImagePipeSource"),
        ("rles", "davis", {"type": "v4l2"}, "V4l2Source"),
        ("rlfs", "cam", {"type": "ros2"}, "Ros2Source"),
    ],
)
def test_the_profile_may_choose_the_driver(
    rig: str, camera: str, driver: dict[str, Any], source: str
) -> None:
    assert type(open_live(with_driver(load_rig(rig), camera, **driver))[1]).__name__ == source


def test_an_unknown_driver_or_one_of_another_kind_is_named() -> None:
    for wanted in ("v4l", "vlp16", "sync_board"):
        rig = with_driver(load_rig("rlfs"), "cam", type=wanted)
        with pytest.raises(SourceError, match=f"'{wanted}'") as caught:
            open_live(rig)
        assert "v4l2, command, davis" in caught.value.hint


def test_a_lidar_of_an_unknown_model_is_not_guessed() -> None:
    with pytest.raises(SourceError, match="XY-32"):
        driver_type("lidar", "lidar", "XY-32", DriverSettings())
    assert driver_type("lidar", "lidar", "Puck LITE", DriverSettings()) == "vlp16"
