from lce_rig.cli.show import harmless


def test_harmless_shows_control_characters_as_text():
    text = "robot\x1b]0;title\x07 \x9b31m\r\n\tdone"
    assert harmless(text) == "robot\\x1b]0;title\\x07 \\x9b31m\\r\n\tdone"
