import pytest
from draw_architecture import PICTURE, draw, layers


@pytest.mark.long
def test_architecture_diagram_is_up_to_date():
    """Run scripts/draw_architecture.py after a change of rooms or imports."""
    assert PICTURE.read_text(encoding="utf-8") == draw()


def test_every_room_stands_in_a_layer():
    rooms = {path.parent.name for path in (PICTURE.parents[2] / "lce_rig").glob("*/__init__.py")}
    assert rooms == {room.partition(".")[0] for row in layers() for room in row}
