"""Write results as files for other programs; each is read back and checked."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from pkgutil import resolve_name

from lce_rig.core.errors import ResultRefusedError, SessionError, UsageError, reading
from lce_rig.core.results import Calibration
from lce_rig.export.frames import require_known
from lce_rig.rig import Rig
from lce_rig.words import sentence

Exporter = Callable[[Sequence[Calibration], Rig, Path], list[Path]]

# Format -> module and function, imported when used.
EXPORTS: dict[str, str] = {
    "extrinsics": "lce_rig.export.extrinsics:export_extrinsics",
    "urdf": "lce_rig.export.urdf:export_urdf",
    "camera_info": "lce_rig.export.camera_info:export_camera_info",
    "static_tf": "lce_rig.export.static_tf:export_static_tf",
    "kalibr": "lce_rig.export.kalibr:export_kalibr",
    "autoware": "lce_rig.export.autoware:export_autoware",
}


def load_exporter(name: str) -> Exporter:
    """Import the function (calibrations, rig, folder) -> paths of a format.

    Raises:
        UsageError: no such format.
    """
    if name not in EXPORTS:
        raise UsageError(f"no export format is called {name}", f"Choose one of: {', '.join(EXPORTS)}")
    exporter: Exporter = resolve_name(EXPORTS[name])
    return exporter


def export(
    calibrations: Sequence[Calibration],
    rig: Rig,
    folder: Path | str,
    *,
    formats: Iterable[str] | None = None,
    is_forced: bool = False,
) -> list[Path]:
    """Write all formats (or those named) into a folder, each read back and checked by probe points.

    Exports of an earlier run are removed first, even if this one is refused, so that they are not mistaken
    for this result.

    Args:
        calibrations: what to write, one for each camera channel and LiDAR.
        rig: the profile the calibrations belong to.
        folder: usually the session's `calibration/`.
        formats: keys of EXPORTS; all by default.
        is_forced: write failed calibrations too; every file then says so.

    Returns:
        The files written, in the order of the formats.

    Raises:
        LceRigError: a calibration names sensors that the rig does not have.
        ResultRefusedError: a verdict is "fail"; nothing is written.
        LceRigError: a file reads back differently; it and all others are removed again.
    """
    folder = Path(folder)
    for calibration in calibrations:
        require_known(calibration, rig)
    exporters = [load_exporter(name) for name in (EXPORTS if formats is None else formats)]
    remove_exports(folder)
    require_usable(calibrations, is_forced=is_forced)
    paths: list[Path] = []
    try:
        for exporter in exporters:
            paths += exporter(calibrations, rig, folder)
    except BaseException:
        remove_exports(folder)
        raise
    return paths


def require_usable(calibrations: Sequence[Calibration], *, is_forced: bool = False) -> None:
    """Check that no calibration failed, unless forced.

    Raises:
        ResultRefusedError: a verdict is "fail".
    """
    failed = [c for c in calibrations if c.verdict == "fail"]
    if failed and not is_forced:
        pairs = ", ".join(f"{c.camera}/{c.channel} and {c.lidar}" for c in failed)
        reasons = "; ".join(sentence(finding) for c in failed for finding in c.findings)
        raise ResultRefusedError(f"not exported: the calibration of {pairs} failed", reasons)


def remove_exports(folder: Path) -> None:
    """Remove exports of earlier runs from a folder, recognised by their first lines.

    Raises:
        SessionError: one cannot be removed.
    """
    for path in sorted(folder.glob("*")):
        if is_export(path):
            try:
                path.unlink()
            except OSError as error:
                raise SessionError(
                    f"{path}: an earlier export cannot be removed: {error.strerror}"
                ) from error


def is_export(path: Path) -> bool:
    """Return whether a file is an export that lce-rig wrote, by its first lines.

    Raises:
        SessionError: it cannot be read.
    """
    if path.suffix not in (".yaml", ".urdf", ".txt") or not path.is_file() or path.is_symlink():
        return False
    with reading(path, SessionError), path.open("rb") as file:
        return b", written by lce-rig " in file.read(300)
