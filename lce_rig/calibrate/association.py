"""Diagnosis of captures whose image and scan do not belong together.

Captures that disagree may all fit one rigid transform after mirroring the images, or pairing them with other
scans. These errors do not depend on lens, board or mounting, and are tested before them.
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

# Minimum number and fraction of captures that must agree once a supposed error is corrected; few agree by
# chance.
_MIN_EXPLAINED, _SHARE = 5, 0.75
# Minimum number of captures with an error when the others have a consensus.
_MIN_OF_SOME = 2
# Reflections of an image, left to right and top to bottom: factors of the camera's axes. The first row
# holds for the board's axes, too.
_MIRRORS = np.array([[-1, 1, 1, 1], [1, -1, 1, 1]])

Candidates = Sequence[Observation]


def find_association_error(
    candidates: Candidates, board: Board, consensus: Consensus | None
) -> Finding | None:
    """Find the association error that explains why captures disagree.

    Args:
        candidates: captures with the board in both sensors.
        board: the board's specification.
        consensus: consensus of these captures; None if they agree on no extrinsics.

    Returns:
        An error if most captures disagree and one error explains them. If the others suffice for extrinsics,
        a finding with a severity by the fraction of captures concerned. None for no such error.
    """
    ordered = sorted(candidates, key=lambda item: item.capture)
    n_agreeing = len(consensus.observations) if consensus else 0
    whole = _of_all(ordered, board, n_agreeing) if 2 * n_agreeing < len(ordered) else None
    if whole is not None or consensus is None or n_agreeing < _MIN_EXPLAINED:
        return whole
    return _of_some(ordered, consensus)


def is_of_all(error: Finding) -> bool:
    """Check whether an error affects all captures; then only a few agree, by chance."""
    return not error.figures.get("captures")


def _of_all(ordered: Candidates, board: Board, n_agreeing: int) -> Finding | None:
    """Find an error common to all captures: once it is corrected, most of them agree."""
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
    """Find an error of the captures that disagree with the consensus of the others."""
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
    """Mirror the board's poses in the image, and the board in its plane."""

    def reflected(T_cam_board: Array) -> Array:
        return np.asarray(mirror[:, None] * T_cam_board * _MIRRORS[0])

    pose, second = item.pose, item.pose.T_cam_board_alternative
    alternative = None if second is None else reflected(second)
    pose = replace(pose, T_cam_board=reflected(pose.T_cam_board), T_cam_board_alternative=alternative)
    return replace(item, pose=pose)


def _paired(images: Candidates, scans: Candidates) -> list[Observation]:
    """Pair images and scans of different captures one by one; captures are named after the scan."""
    return [replace(scan, pose=image.pose) for image, scan in zip(images, scans, strict=False)]
