"""Diagnosis of captures whose image and scan do not belong together.

Captures that disagree may all fit one rigid transform once images are mirrored, or are paired with other
scans. These errors have nothing to do with lens, board or mounting, and are named before them.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from lce_rig.calibrate.consensus import Consensus, agrees_with, find_consensus
from lce_rig.calibrate.findings import EXCHANGED_IMAGES, MIRRORED, OTHER_ORDER
from lce_rig.core.board import Board
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Finding, Severity
from lce_rig.core.geometry import Array
from lce_rig.core.results import Observation

# Fewest captures, and their share, that must agree once a supposed error is undone: by chance few do.
_MIN_EXPLAINED, _SHARE = 5, 0.75
# Fewest captures beside a consensus of others.
_MIN_OF_SOME = 2
# Reflections of an image left to right and top to bottom, as factors of the camera's axes; of the board's.
_MIRRORS = np.array([[-1.0, 1.0, 1.0, 1.0], [1.0, -1.0, 1.0, 1.0]])
_IN_PLANE = np.array([-1.0, 1.0, 1.0, 1.0])

Candidates = Sequence[Observation]


def find_association_error(
    candidates: Candidates, board: Board, consensus: Consensus | None
) -> Finding | None:
    """Find the error of association that explains captures without agreement.

    Args:
        candidates: of each capture with the board in both sensors.
        board: its specification.
        consensus: of these captures; None where they agree with no extrinsics.

    Returns:
        An error if most captures disagree and the same error explains them; where the others suffice for
        extrinsics, a finding whose severity is by the share of captures concerned; None for no such error.
    """
    ordered = sorted(candidates, key=lambda item: item.capture)
    n_agreeing = len(consensus.observations) if consensus else 0
    whole = _of_all(ordered, board, n_agreeing) if 2 * n_agreeing < len(ordered) else None
    if whole is not None or consensus is None or n_agreeing < _MIN_EXPLAINED:
        return whole
    return _of_some(ordered, consensus)


def is_of_all(error: Finding) -> bool:
    """Check whether an error concerns all captures, so that the few that agree agree by chance."""
    return not error.figures.get("captures")


def _of_all(ordered: Candidates, board: Board, n_agreeing: int) -> Finding | None:
    """Find the error that all captures share: without it, most agree."""
    supposed = {
        "mirrored": [_mirrored(item, _MIRRORS[0]) for item in ordered],
        "late": _paired(ordered[1:], ordered),
        "early": _paired(ordered, ordered[1:]),
        "reversed": _paired(ordered[::-1], ordered),
    }
    n_explained: dict[str, int] = {}
    for error, undone in supposed.items():
        with suppress(NotEnoughDataError):
            n = len(find_consensus(undone, board).observations)
            if n >= max(_MIN_EXPLAINED, _SHARE * len(undone)):
                n_explained[error] = n
    if not n_explained:
        return None
    error = max(n_explained, key=lambda each: n_explained[each])
    figures = {
        "n_explained": n_explained[error],
        "n_captures": len(supposed[error]),
        "n_agreeing": n_agreeing,
    }
    if error == "mirrored":
        return MIRRORED(captures=(), **figures)
    return OTHER_ORDER(order=error, **figures)


def _of_some(ordered: Candidates, consensus: Consensus) -> Finding | None:
    """Find the error of captures that disagree with the consensus of the others."""
    T, refused = consensus.T_cam_lidar, [item for item in ordered if item.capture in consensus.refused]
    mirrored = [
        item for item in refused if any(agrees_with(_mirrored(item, mirror), T) for mirror in _MIRRORS)
    ]
    exchanged = [
        item
        for item in refused
        if any(agrees_with(_paired([item], [other])[0], T) for other in refused if other is not item)
    ]
    explained, kind = max((mirrored, MIRRORED), (exchanged, EXCHANGED_IMAGES), key=lambda each: len(each[0]))
    if len(explained) < max(_MIN_OF_SOME, len(refused) / 2):
        return None
    share = len(explained) / len(ordered)
    severity: Severity = "note" if share <= 0.25 else "warning" if share <= 0.5 else "error"
    return kind(
        severity=severity,
        captures=tuple(item.capture for item in explained),
        n_explained=len(explained),
        n_captures=len(ordered),
        n_agreeing=len(consensus.observations),
    )


def _mirrored(item: Observation, mirror: Array) -> Observation:
    """Reflect the board's poses in the image; in its plane the board is reflected, too."""

    def reflected(T_cam_board: Array) -> Array:
        return np.asarray(mirror[:, None] * T_cam_board * _IN_PLANE)

    image, second = item.image, item.image.T_cam_board_alternative
    alternative = None if second is None else reflected(second)
    image = replace(image, T_cam_board=reflected(image.T_cam_board), T_cam_board_alternative=alternative)
    return replace(item, image=image)


def _paired(images: Candidates, scans: Candidates) -> list[Observation]:
    """Pair the images of some captures with the scans of others, one by one; the scan names the capture."""
    return [replace(scan, image=image.image) for image, scan in zip(images, scans, strict=False)]
