"""One limit of memory for the program: a file that demands more costs itself, not the computer."""

import resource
from contextlib import suppress
from pathlib import Path

_SHARE = 0.8
# Sound sessions need 0.7 GB at most; less than this would stop them on a busy computer, too.
_LEAST_BYTES = 1 << 30


def limit_memory() -> None:
    """Limit the memory of this process, and of each that it starts, to a share of what the computer has free.

    Beyond the limit Python raises MemoryError, which `reading` names with its file. Data are limited, not
    addresses: onnxruntime, Open3D and threads reserve far more of those than they use.
    """
    with suppress(OSError, ValueError, KeyError):
        lines = (line.split() for line in Path("/proc/meminfo").read_text().splitlines())
        free_kb = {words[0]: int(words[1]) for words in lines}
        free_bytes = 1024 * (free_kb["MemAvailable:"] + free_kb["SwapFree:"])
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        limit = max(int(_SHARE * free_bytes), _LEAST_BYTES)
        resource.setrlimit(resource.RLIMIT_DATA, (limit if hard < 0 else min(limit, hard), hard))
