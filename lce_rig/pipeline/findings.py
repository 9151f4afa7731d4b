"""Kinds of findings of the commands: sensors without a result, and results that cannot be compared."""

from collections.abc import Collection, Mapping

from lce_rig.core.findings import Finding, Kind, Losses, Refusal, warning_kind
from lce_rig.core.phrasing import captures_to_add
from lce_rig.detect.detection import Detections
from lce_rig.rig import Rig


def _commonest(finding: Finding) -> str:
    """The commonest of {causes} of refusal with their counts, and {where} to hold the board."""
    causes = finding.figures["causes"]
    assert isinstance(causes, tuple)
    lines = [f"{cause[0]} x {cause[2]}" for cause in causes if isinstance(cause, tuple)]
    # If most captures are refused, list their causes first.
    if 2 * finding.figure("n_detected") >= finding.figure("n_captures"):
        where = finding.figures.get("where")
        n_missing = int(finding.figure("n_needed") - finding.figure("n_detected"))
        more = f"add {n_missing} captures or more, with the board at other places and tilts"
        lines.append(captures_to_add(*where) if isinstance(where, tuple) else more)
    return "\n".join(lines)


FEW_DETECTED = Kind(
    "shortage.few_detected",
    "both sensors found the board in {n_detected} of {n_captures} captures (minimum {n_needed})",
    _commonest,
    severity="warning",
)


def few_detected(subject: str, n_detected: int, refused: Mapping[str, Refusal], n_needed: int) -> Finding:
    """Report too few captures with the board in both sensors, and the commonest causes of refusal."""
    losses = Losses()
    for why in refused.values():
        losses.add(why)
    return FEW_DETECTED(
        subject,
        n_detected=n_detected,
        n_captures=n_detected + len(refused),
        n_needed=n_needed,
        causes=tuple((n, why.code, f"{why.family}: {why.sentence}") for why, n in losses.counts()[:3]),
    )


UNCONNECTED = warning_kind(
    "shortage.unconnected",
    "no placement connects {subject} with {others}",
    "hold the board in {n_needed} placements or more where both {first} and {second} see it",
)
LIDAR_ABSENT = warning_kind(
    "shortage.lidar_absent",
    "no capture holds a scan of {subject}",
    "record it with the others, or remove it from the profile",
)
SENSOR_DISAGREES = warning_kind(
    "shortage.sensor_disagrees",
    "captures of {subject} agree with no other sensor's ({others})",
    "check its clock and topic: samples may be of other times or boards",
)
CHANNEL_ABSENT = warning_kind(
    "shortage.channel_absent",
    "no capture holds {subject}: the result is without it",
    "collect it, or omit it: `lce-rig calibrate {session} --channels {held}`",
)

CHANNEL_REJECTED = warning_kind(
    "shortage.channel_rejected",
    "{subject}: no image agrees with the scans as the other channels do: the result is without it",
    "its cause: `lce-rig calibrate {session} --channels {channel} --name {channel}`",
)


def absent_channels(
    rig: Rig, detections: Detections, wanted: Collection[str] | None
) -> dict[str, list[Finding]]:
    """List, by camera, the channels without captures, if another channel has some.

    Args:
        rig: the profile.
        detections: detections of the session.
        wanted: names of the channels that are used; None for all.
    """
    cameras = {camera for camera, _ in detections.images}
    held = ",".join(sorted({channel for _, channel in detections.images}))
    return {
        camera: [
            CHANNEL_ABSENT(f"{camera}.{channel}", held=held)
            for channel in settings.channels
            if (wanted is None or channel in wanted) and (camera, channel) not in detections.images
        ]
        for camera, settings in rig.cameras.items()
        if camera in cameras
    }


SHORTAGE = Kind("shortage.text", "{text}", "{advice}", severity="warning")
NO_AGREEMENT = Kind(
    "pair.no_agreement",
    "no three of {n_captures} captures agree with one set of extrinsics",
    "check board size, intrinsics, and the pairing of images with scans",
)
OUTDATED = Kind(
    "results.outdated",
    "{subject}: the profile or the captures that it used have changed since",
    "run `lce-rig calibrate {session}` again with the same options",
    severity="warning",
)
FAILED = Kind(
    "repeat.failed",
    "the calibration of {subject} ({camera} and {lidar}) failed",
    "run `lce-rig calibrate {subject}` for its reasons",
)
ONLY_ONE = Kind(
    "repeat.only_one", "{camera} and {lidar} are calibrated in {subject} only", severity="warning"
)
OTHER_BOARD = Kind(
    "repeat.other_board", "{first} and {subject} were taken with different boards", severity="warning"
)
OTHER_PROFILE = Kind(
    "verify.other_profile",
    "the profile of these samples differs from the result's in {keys}: judged with the result's intrinsics",
    "calibrate again if lens, board or mounting were changed",
    severity="warning",
)
_PLACES = "record more places with doors, poles or furniture before a far wall"
SCENE_NO_VIEWS = Kind(
    "scene_calibration.no_views",
    "no image within the tolerance of a scan",
    "check the topics and timestamps of the recording",
    severity="warning",
)
SCENE_MOVING = Kind(
    "scene_calibration.moving",
    "{n_views} views of a moving rig are not used: scans or images have no timestamps",
    "record points with their firing times, or let the rig stand",
    severity="warning",
)
SCENE_DARK = Kind(
    "scene_calibration.dark",
    "cannot tell: images are dark, 99 % of the pixels below grey {grey_99:.0f} (minimum {limit:.0f})",
    "record by daylight, or expose longer",
    severity="warning",
)
SCENE_EVENTS_STAND = Kind(
    "scene_calibration.events_of_standing_rig",
    "cannot tell: events show only moving things, and the rig was not seen to move in {n_views} views",
    "move the rig slowly past upright edges, or record images as well",
    severity="warning",
)
SCENE_FEW_EDGES = Kind(
    "scene_calibration.few_edges",
    "cannot tell: {n_edges} edges of the scene in {n_views} views are too few",
    _PLACES,
    severity="warning",
)
SCENE_WEAK = Kind(
    "scene_calibration.weak",
    "cannot tell: edges of images and scans do not match near the nominal pose in {n_views} views, "
    "score {score:.2f} (minimum {min_score:.2f})",
    "check nominal_extrinsics, intrinsics, camera names, and timestamps",
    severity="warning",
)
SCENE_AMBIGUOUS = Kind(
    "scene_calibration.ambiguous",
    "cannot tell: two poses fit the edges of {n_views} views nearly as well",
    _PLACES,
    severity="warning",
)
SCENE_BEYOND_REACH = Kind(
    "scene_calibration.beyond_reach",
    "cannot tell: the best fit is more than {reach_deg:1deg} or {reach_m:mm} from the nominal pose",
    "correct nominal_extrinsics, and check intrinsics and the camera's name",
    severity="warning",
)
SCENE_LENS = Kind(
    "scene_calibration.lens",
    "cannot tell: edges fit better with focal lengths changed by {change:+.0f} % in {n_views} views",
    "correct the intrinsics: those of this lens at this image size",
    severity="warning",
)
SCENE_UNDETERMINED = Kind(
    "scene_calibration.undetermined",
    "cannot tell: the scene of {n_views} views does not determine {axes:motion}",
    _PLACES,
    severity="warning",
)
SCENE_UNCERTAIN = Kind(
    "scene_calibration.uncertain",
    "uncertainty {sigma_deg:deg}, {sigma_m:mm} (target {target_deg:deg}, {target_m:mm}), largest in "
    "{weakest:motion}",
    "record more places, or calibrate with a board",
    severity="warning",
)
SCENE_ONE_PLACE = Kind(
    "scene_calibration.one_place",
    "{n_views} views show one place, where a wrong pose may fit: images correlate by {alike:.2f} "
    "(limit {limit:.2f})",
    "record several places",
    severity="warning",
)
SCENE_TYPICAL = Kind(
    "scene_calibration.typical",
    "nothing confirms the result: nominal_extrinsics is typical of such rigs, not of this one",
    "enter the CAD model's pose with `source: cad`",
    severity="warning",
)
