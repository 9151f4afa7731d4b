"""Entry point of the installed command: Ctrl-C and the memory limit come before any other import."""

import ctypes
import gc
import os
import resource
import sys
from contextlib import suppress
from pathlib import Path

from lce_rig.core.interrupts import EXIT_INTERRUPTED, INTERRUPTED, interrupt_no_more, watch_for_interrupts

# Limit as a share of the computer's memory and swap: above it the computer thrashes and kills programs.
_SHARE_OF_MEMORY = 0.8
# Lower bound of the limit, bytes: intact sessions need at most 0.7 GB.
_LEAST_BYTES = 1 << 30
# glibc's mallopt: its options; the largest block taken from the heap, bytes (its maximum); free bytes at the
# heap's end above which it returns them to the kernel.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_HEAP_BLOCK_BYTES, _FREE_BYTES = 1 << 25, 1 << 27


def main() -> None:
    """Run the command line and exit with its code."""
    _open_closed_streams()
    try:
        watch_for_interrupts()
        limit_memory()
        limit_opencv()
        keep_freed_memory()
        # Its matrices are small: threads of BLAS would only wait for each other.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        # Net number of new objects between searches for cycles: imports alone make 1e5, without cycles.
        gc.set_threshold(20_000, 20, 20)
        from lce_rig.cli.main import run

        code = run(sys.argv[1:])
        interrupt_no_more()
    except KeyboardInterrupt:  # during the import
        sys.stderr.write(f"{INTERRUPTED}\n")
        code = EXIT_INTERRUPTED
    if code == EXIT_INTERRUPTED:
        # Python's own exit would wait for running threads, so exit without it.
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):
                stream.flush()
        os._exit(code)
    sys.exit(code)


def limit_memory() -> None:
    """Limit the memory of this process, and of each that it starts, to a share of the computer's.

    Beyond the limit Python raises MemoryError, which `reading` names with its file. Data are limited, not
    the address space: onnxruntime, Open3D and threads reserve far more of it than they use.
    """
    with suppress(OSError, ValueError, KeyError):
        lines = (line.split() for line in Path("/proc/meminfo").read_text().splitlines())
        size_kb = {words[0]: int(words[1]) for words in lines}
        total_bytes = 1024 * (size_kb["MemTotal:"] + size_kb["SwapTotal:"])
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        limit = max(int(_SHARE_OF_MEMORY * total_bytes), _LEAST_BYTES)
        resource.setrlimit(resource.RLIMIT_DATA, (limit if hard < 0 else min(limit, hard), hard))


def keep_freed_memory() -> None:
    """Reuse the memory of freed arrays: fresh pages from the kernel took a tenth of a calibration."""
    with suppress(OSError, AttributeError):  # Only glibc has these options.
        set_option = ctypes.CDLL(None).mallopt
        set_option(_M_MMAP_THRESHOLD, _HEAP_BLOCK_BYTES)
        set_option(_M_TRIM_THRESHOLD, _FREE_BYTES)


def limit_opencv() -> None:
    """Limit OpenCV's images, and silence its log, in this process and those that it starts.

    OpenCV reads these variables when it is first loaded. It refuses images that declare more pixels before it
    takes any memory; damaged images are reported by lce-rig, once.
    """
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 26))
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")


def _open_closed_streams() -> None:
    """Open /dev/null for closed standard streams (`lce-rig collect <&-`), as services have them."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115, PTH123
