"""result.json of calibrations that a test made."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from lce_rig.core.calibration import Calibration, Provenance, ResultFile
from lce_rig.session.durable import write_atomically


def result_file(
    rig: str,
    calibrations: Sequence[Calibration],
    inputs: Mapping[str, str] | None = None,
    provenance: Provenance | None = None,
) -> ResultFile:
    """Build result.json of a rig."""
    return ResultFile(
        rig=rig,
        pairs=tuple(calibrations),
        inputs_sha256=inputs or {},
        provenance=provenance or Provenance(),
    )


def write_result(
    path: Path, rig: str, calibrations: Sequence[Calibration], inputs: Mapping[str, str] | None = None
) -> None:
    """Write result.json of a rig."""
    write_atomically(path, result_file(rig, calibrations, inputs).text())
