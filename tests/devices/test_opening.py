"""Which driver a rig's sensors get."""

from typing import Any

import pytest

from lce_rig.core.errors import SourceError
from lce_rig.devices import driver_of, open_live, sensors, source_of
from lce_rig.rig import Rig, load_rig


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


@pytest.mark.parametrize("wanted", ["v4l", "vlp16", "sync_board"])
def test_an_unknown_driver_or_one_of_another_kind_keeps_no_other_sensor_from_opening(wanted: str) -> None:
    rig = with_driver(load_rig("rlfs"), "cam", type=wanted)
    with pytest.raises(SourceError) as caught:
        open_live(rig)
    assert repr(wanted) in caught.value.what and "v4l2, command, davis" in caught.value.hint
    assert sensors(rig)[:2] == ["lidar", "cam"] and source_of(rig, "lidar").sensor == "lidar"


def test_a_lidar_of_an_unknown_model_is_not_guessed() -> None:
    rig = load_rig("rlfs")
    unknown, lite = (
        rig.model_copy(update={"lidars": {"lidar": rig.lidars["lidar"].model_copy(update=changes)}})
        for changes in (
            {"model": "XY-32", "driver": rig.lidars["lidar"].driver.model_copy(update={"type": None})},
            {"model": "Puck LITE"},
        )
    )
    with pytest.raises(SourceError) as caught:
        driver_of(unknown, "lidar")
    assert "XY-32" in caught.value.what and driver_of(lite, "lidar") == "vlp16"
