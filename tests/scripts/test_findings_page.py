import subprocess
import sys

import findings_page


def test_the_page_lists_the_codes_as_they_are_declared() -> None:
    """Run scripts/findings_page.py after a change of a kind."""
    code = "import findings_page, sys; sys.stdout.reconfigure(encoding='utf-8'); print(findings_page.page(), end='')"
    path = [
        "-c",
        f"import sys; sys.path.insert(0, {str(findings_page.PAGE.parents[1] / 'scripts')!r}); {code}",
    ]
    fresh = subprocess.run([sys.executable, *path], check=True, capture_output=True)
    assert findings_page.PAGE.read_text(encoding="utf-8") == fresh.stdout.decode()
