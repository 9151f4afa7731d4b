from findings_page import PAGE, page


def test_the_page_lists_the_codes_as_the_tables_have_them() -> None:
    """Run scripts/findings_page.py after a change of a table."""
    assert PAGE.read_text(encoding="utf-8") == page()
