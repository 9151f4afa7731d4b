"""Entry point of the installed command: Ctrl-C and the memory limit come before any other import."""

import os
import sys
from contextlib import suppress

from lce_rig.core.interrupts import EXIT_INTERRUPTED, INTERRUPTED, interrupt_no_more, watch_for_interrupts
from lce_rig.core.memory import limit_memory


def main() -> None:
    """Run the command line and exit with its code."""
    _open_closed_streams()
    try:
        watch_for_interrupts()
        limit_memory()
        from lce_rig.cli.main import run

        code = run(sys.argv[1:])
        interrupt_no_more()
    except KeyboardInterrupt:  # during the import
        sys.stderr.write(f"{INTERRUPTED}\n")
        code = EXIT_INTERRUPTED
    if code == EXIT_INTERRUPTED:
        # Python's own exit would wait for running threads.
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):
                stream.flush()
        os._exit(code)
    sys.exit(code)


def _open_closed_streams() -> None:
    """Open /dev/null for standard streams that are closed (`lce-rig collect <&-`), as for services."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115, PTH123
