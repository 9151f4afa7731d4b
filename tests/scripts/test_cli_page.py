from cli_page import PAGE, page


def test_the_page_shows_every_verb_as_its_help_does():
    """Run scripts/cli_page.py after a change of a verb's help."""
    assert PAGE.read_text(encoding="utf-8") == page()
