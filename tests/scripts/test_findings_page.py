import subprocess
import sys

from findings_page import PAGE

SCRIPT = PAGE.parents[1] / "scripts" / "findings_page.py"
PRINT = "import runpy, sys; sys.stdout.buffer.write(runpy.run_path(sys.argv[1])['page']().encode())"


def test_findings_page_is_up_to_date():
    """Run scripts/findings_page.py after a change of a kind."""
    # A separate process does not declare the tests' kinds.
    fresh = subprocess.run([sys.executable, "-c", PRINT, str(SCRIPT)], check=True, capture_output=True)
    assert PAGE.read_bytes() == fresh.stdout
