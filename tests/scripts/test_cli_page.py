from cli_page import PAGE, page


def test_cli_page_is_up_to_date():
    """Run scripts/cli_page.py after a change of a verb's help."""
    assert PAGE.read_text(encoding="utf-8") == page()
