"""Codes of findings that name a cause, and the ones that a calibration gives for its verdict."""

from collections import Counter

from lce_rig.core.calibration import Calibration
from lce_rig.core.errors import LceRigError, NotEnoughDataError
from lce_rig.core.findings import Finding

Codes = frozenset[str]


def codes(text: str) -> Codes:
    """Return the codes in a list separated by spaces."""
    return frozenset(text.split())


NOTHING: Codes = frozenset()
SQUARES = codes("verdict.scale")
RANGE_OFFSET = codes("verdict.range_offset")
RANGE_CONTRAST = codes("verdict.range_contrast")
SCALED = codes("verdict.scale verdict.range_scale verdict.plate_size")
"""Ranges scaled: as if squares and plate were smaller."""
OTHER_UNIT = codes(
    "verdict.range_scale lidar.other_size lidar.other_plate lidar.no_plate lidar.too_far lidar.no_returns"
)
PLATE = codes("verdict.plate_size verdict.plate_edge lidar.other_size lidar.other_plate")
PATTERN = codes("verdict.pattern_offset")
BOW = codes("verdict.bow")
LENS = codes("verdict.intrinsics verdict.lens")
DISTORTION = LENS | codes("verdict.lens_model image.misfit")
LASERS = codes("verdict.laser_angles")
MOVED = codes("verdict.moved")
OUTLIER = codes("verdict.outlier calibrate.outlier pair.elsewhere")
"""Of one capture: a finding, or its refusal."""
LAST = OUTLIER | codes("verdict.moved verdict.last_rejected")
DRIFT, FOCUS_DRIFT = codes("verdict.drift"), codes("verdict.focus_drift")
TIME_OFFSET, READOUT = codes("verdict.time_offset"), codes("verdict.readout")
TWO_BOARDS = codes("verdict.two_boards")
SCATTER = codes("verdict.scatter lidar.too_thick")
FEW_RINGS = codes("lidar.too_few_rings lidar.too_few_points lidar.no_plate")
EXCHANGED = codes("association.exchanged_images")
OTHER_ORDER = EXCHANGED | codes("association.other_order")
NO_ORDER = EXCHANGED | codes("shortage.few_agree pair.no_agreement")
MIRRORED = codes("association.mirrored")
NOMINAL = codes("verdict.far_from_nominal")
CAMERAS_EXCHANGED = codes("verdict.exchanged")
OTHER_FRAME = NOMINAL | codes("lidar.other_origin")
PROFILE = "profile.error"
"""Stands for the error of a profile that cannot be loaded."""
OTHER_IMAGES = codes(f"image.error {PROFILE}")
OTHER_CORNERS = codes(f"image.other_board image.part image.no_board {PROFILE}")
FEW = codes(
    "shortage.few_detected shortage.few_captures shortage.undetermined verdict.few_placements "
    "verdict.rotation_uncertain verdict.translation_uncertain"
)

CAUSES = (
    SCALED
    | RANGE_OFFSET
    | RANGE_CONTRAST
    | PLATE
    | PATTERN
    | BOW
    | DISTORTION
    | LASERS
    | codes("verdict.moved verdict.last_rejected verdict.outlier")
    | DRIFT
    | FOCUS_DRIFT
    | TIME_OFFSET
    | READOUT
    | TWO_BOARDS
    | SCATTER
    | OTHER_ORDER
    | MIRRORED
    | OTHER_FRAME
    | CAMERAS_EXCHANGED
)
"""Findings that name a cause; all others are symptoms or notes."""
_STAGES_OF_PAIRS = ("pair", "calibrate")


def first_cause(calibration: Calibration) -> str:
    """Return the code of the cause that a result gives first; "" for none.

    That is the first finding that is not a note, then the first note that names a cause, then the commonest
    refusal of captures in which the sensors disagree.
    """
    serious = [finding.code for finding in calibration.findings if finding.severity != "note"]
    notes = [finding.code for finding in calibration.findings if finding.code in CAUSES]
    refused = Counter(
        why.code for why in calibration.captures_refused.values() if why.family in _STAGES_OF_PAIRS
    )
    return next(iter((*serious, *notes, *(code for code, _ in refused.most_common()))), "")


def independent_causes(calibration: Calibration) -> tuple[str, ...]:
    """List the codes of the causes in a result that are not notes and follow from no other."""
    found = (finding for finding in calibration.findings if finding.severity != "note")
    return tuple(dict.fromkeys(each.code for each in found if each.code in CAUSES and not _cause_of(each)))


def cause_of_error(error: LceRigError) -> str:
    """Return the code of the cause that an error gives.

    Where most captures lack the board, that is the commonest cause of their refusal, as in the message.
    """
    if not isinstance(error, NotEnoughDataError) or error.finding is None:
        return PROFILE
    finding = error.finding
    refusals = finding.figures.get("causes")
    if isinstance(refusals, tuple) and refusals and isinstance(refusals[0], tuple):
        is_rare = 2 * finding.figure("n_detected") < finding.figure("n_captures")
        return str(refusals[0][1]) if is_rare else finding.code
    return finding.code


def _cause_of(finding: Finding) -> str:
    """Return the code of the cause from which a finding follows; "" for none."""
    return str(getattr(finding, "follows", ""))
