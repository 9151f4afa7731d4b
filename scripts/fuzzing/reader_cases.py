"""One case of the campaign against readers: its damaged files, and what became of reading them."""

import contextlib
import gc
import shutil
import time
import traceback
import warnings
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from fuzzing.mutations import damaged
from fuzzing.reader_table import READERS
from fuzzing.sanity import InsaneError
from fuzzing.seeds_of_recordings import Files
from lce_rig.core.errors import LceRigError

MAX_SECONDS = 10.0
MAX_GROWN_BYTES = 1 << 30
ACCEPTED, REFUSED, WRONG = "accepted", "refused", "wrong"
_EXIT_CODES = frozenset(range(1, 8))
_MB = 1 << 20


@dataclass(frozen=True)
class Outcome:
    """What became of one case.

    Attributes:
        case: its number.
        verdict: ACCEPTED, REFUSED or WRONG.
        what: what is wrong, alike for cases with the same cause.
        detail: traceback or message.
        seconds: taken by the reader.
        grown_bytes: highest memory in use while it read, over that before.
    """

    case: int
    verdict: str
    what: str = ""
    detail: str = ""
    seconds: float = 0.0
    grown_bytes: int = 0

    def to_dict(self) -> dict[str, object]:
        """Give plain values."""
        return asdict(self)


def damaged_files(name: str, seeds: Sequence[Files], seed: int, case: int) -> Files:
    """Build the input of one case; the same arguments give the same bytes.

    Args:
        name: of the reader.
        seeds: its sound inputs.
        seed: of the run.
        case: number of the case; every fiftieth is left sound.
    """
    reader = READERS[name]
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), case])
    chosen = int(rng.integers(len(seeds)))
    files = seeds[chosen]
    if case % 50 == 0:
        return files
    target = reader.targets(files)[int(rng.integers(len(reader.targets(files))))]
    layer = reader.layers[int(rng.integers(len(reader.layers)))]
    parts = layer.split(files[target])
    at = int(rng.integers(len(parts)))
    others = [other for k, other in enumerate(parts) if k != at][:20]
    others += [
        each[target] for each in seeds if each is not files and target in each and layer.split(each[target])
    ]
    parts[at] = damaged(parts[at], others, layer.form, rng)
    changed = files | {target: layer.join(files[target], parts)}
    return changed if reader.seal is None else reader.seal(changed)


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files below a new folder."""
    folder.mkdir()
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def run_case(name: str, seeds: Sequence[Files], seed: int, case: int, folder: Path) -> Outcome:
    """Read one damaged input from a new folder, which is removed afterwards, and judge what becomes of it."""
    reader = READERS[name]
    write_files(folder, damaged_files(name, seeds, seed, case))
    before = _forget_peak()
    began_s = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            reader.read(folder)
        verdict, what, detail = ACCEPTED, "", ""
    except reader.refuses as error:
        verdict, what, detail = _judge_refusal(error)
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        verdict, what, detail = WRONG, _place_of(error), traceback.format_exc(limit=-12)
    seconds = time.perf_counter() - began_s
    if case % 50 == 0 and verdict == REFUSED and reader.is_sound:
        verdict, what, detail = WRONG, "a sound input is refused", what
    grown = _peak_bytes() - before
    if verdict != WRONG and seconds > MAX_SECONDS:
        verdict, what = WRONG, f"longer than {MAX_SECONDS:g} s"
    if verdict != WRONG and grown > MAX_GROWN_BYTES:
        verdict, what = WRONG, f"more than {MAX_GROWN_BYTES // _MB} MB of memory"
    shutil.rmtree(folder, ignore_errors=True)
    if grown > 100 * _MB:
        gc.collect()
    return Outcome(case, verdict, what, detail, seconds, grown)


def _judge_refusal(error: Exception) -> tuple[str, str, str]:
    if isinstance(error, InsaneError):
        return WRONG, str(error)[:120], traceback.format_exc(limit=-6)
    if isinstance(error, LceRigError):
        if error.exit_code not in _EXIT_CODES:
            return WRONG, f"exit code {error.exit_code}", str(error)
        if not error.what.strip():
            return WRONG, "an error without words", repr(error)
    return REFUSED, str(error)[:300], ""


def _place_of(error: BaseException) -> str:
    """Name an exception by its type and the last line of this package that it came through."""
    if isinstance(error, InsaneError):
        return str(error)[:120]
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "/lce_rig/" in frame.filename]
    place = f"{own[-1].filename.rpartition('/lce_rig/')[2]}:{own[-1].lineno}" if own else "outside lce_rig"
    return f"{type(error).__name__} at {place}"


def _forget_peak() -> int:
    """Start measuring the highest memory in use anew; gives what is in use now."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _status_bytes("VmRSS")


def _peak_bytes() -> int:
    return _status_bytes("VmHWM")


def _status_bytes(key: str) -> int:
    with open("/proc/self/status") as file:  # noqa: PTH123
        for line in file:
            if line.startswith(key):
                return int(line.split()[1]) * 1024
    raise RuntimeError(f"/proc/self/status has no {key}")
