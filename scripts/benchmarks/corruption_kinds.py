"""Ways in which a user may bring about a session that is wrong as a whole: named, and the same each time.

Each takes a sound session and gives the corrupted one; None where a session does not lend itself to it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks import corruption_causes as causes
from benchmarks.corruption_causes import Codes
from benchmarks.corruption_detections import (
    Spoil,
    with_bow,
    with_contrast,
    with_focus_drift,
    with_rolling_shutter,
    with_second_board,
)
from benchmarks.corruption_sessions import LATE_S, ONE_PLACE, PARALLEL, Samples, late
from lce_rig.calibrate.options import Tolerances
from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import Array, exp_so3, invert, pose, transform
from lce_rig.rig import BoardSettings, IntrinsicsSettings, Rig, dump_rig, parse_rig

SOUND = "none"
Corrupt = Callable[[Samples], Samples | None]
_FOOT_M = 0.3048
# Standard deviations of the profile's own entry that an error within its tolerance may have.
_BEYOND = 3.0
_SEED = 12


@dataclass(frozen=True)
class Corruption:
    """One way of corrupting a session.

    Attributes:
        name: in the table.
        corrupt: the session.
        causes: codes of the findings that name it; any of them is right.
        unobservable: why the samples of the session cannot show it, in words; empty where they can.
        sigmas: its size in standard deviations of the profile's entry, from the sound profile; None where the
            profile has no entry for it.
        spoil: the detections, after those of the session are found; None leaves them.
    """

    name: str
    corrupt: Corrupt
    causes: Codes
    unobservable: str = ""
    sigmas: Callable[[Rig], float] | None = None
    spoil: Spoil | None = None

    def is_beyond(self, rig: Rig) -> bool:
        """Check whether the corruption is larger than the uncorrupted profile allows for."""
        try:
            return self.sigmas is None or self.sigmas(rig) > _BEYOND
        except ZeroDivisionError:
            return True  # the profile states the figure as exact


def corruptions() -> list[Corruption]:
    """List all of them, the sound session first."""
    return [Corruption(SOUND, _same, causes.NOTHING), *_all()]


def _all() -> Iterator[Corruption]:
    yield from _swapped()
    yield from _mirrored()
    yield from _frames()
    yield from _turned()
    yield from _scaled()
    yield from _elevations()
    yield from _other_places()
    yield from _at_the_ends()
    yield from _drifting()
    yield from _lenses()
    yield from _prints()
    yield from _timing()
    yield from _readout()
    yield from _noise()
    yield from _too_little()


# Images and scans that do not belong together.


def _swapped() -> Iterator[Corruption]:
    few = causes.EXCHANGED | causes.OUTLIER
    yield Corruption("images of 2 captures swapped", lambda s: _cycled(s, _some(s, 2)), few)
    yield Corruption("images of 5 captures mixed up", lambda s: _cycled(s, _some(s, 5)), causes.NO_ORDER)
    yield Corruption(
        "images of half the captures mixed up",
        lambda s: _cycled(s, _some(s, (len(s.images) + 1) // 2)),
        causes.NO_ORDER,
    )
    yield Corruption("images in reversed order", lambda s: _dealt(s, s.captures[::-1]), causes.OTHER_ORDER)
    yield Corruption("images one capture late", lambda s: _cycled(s, s.captures), causes.OTHER_ORDER)


def _some(samples: Samples, n: int) -> list[str]:
    chosen = np.random.default_rng(_SEED).permutation(len(samples.captures))[:n]
    return [samples.captures[k] for k in sorted(chosen)]


def _cycled(samples: Samples, names: Sequence[str]) -> Samples:
    """Hand the image of each of these captures to the next one, the last one's to the first."""
    taken_from = dict(zip(names, [names[-1], *names[:-1]], strict=True))
    return _dealt(samples, [taken_from.get(name, name) for name in samples.captures])


def _dealt(samples: Samples, sources: Sequence[str]) -> Samples:
    """Exchange the captures' images; timestamps are those of the scans they are paired with."""
    images = {
        name: replace(samples.images[source], stamp_ns=samples.images[name].stamp_ns)
        if source != name
        else samples.images[name]
        for name, source in zip(samples.captures, sources, strict=True)
    }
    return replace(samples, images=images)


# Axes and mountings.


def _mirrored() -> Iterator[Corruption]:
    def across(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return pixels[:, ::-1]

    mirrored: tuple[tuple[str, Corrupt], ...] = (
        ("images mirrored left to right", lambda s: _with_images(s, across)),
        ("every other image mirrored left to right", lambda s: _every_other(s, across)),
        ("images mirrored top to bottom", lambda s: _with_images(s, lambda p: p[::-1])),
        ("scans mirrored, y to -y", lambda s: _with_points(s, lambda p: p * [1, -1, 1])),
        ("x and y of scans swapped", lambda s: _with_points(s, lambda p: p[:, [1, 0, 2]])),
    )
    for label, corrupt in mirrored:
        yield Corruption(label, corrupt, causes.MIRRORED)
    yield Corruption(
        "images and scans mirrored alike",
        lambda s: _with_points(_with_images(s, across), lambda p: p * [1, -1, 1]),
        causes.MIRRORED | causes.NOMINAL,
        "a mirrored world seen by mirrored sensors is as consistent as the true one",
    )


def _every_other(samples: Samples, change: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> Samples:
    changed = _with_images(samples, change).images
    return replace(
        samples, images={**samples.images, **{name: changed[name] for name in samples.captures[1::2]}}
    )


def _frames() -> Iterator[Corruption]:
    """Give points or the nominal pose in another frame than is meant."""
    for up_m in (0.2, 0.7):
        yield Corruption(
            f"scans in a frame {up_m:g} m below the LiDAR",
            lambda s, up_m=up_m: _with_points(s, lambda p: p + [0, 0, up_m]),  # type: ignore[misc]
            causes.OTHER_FRAME,
        )
    yield Corruption("nominal pose inverted", _with_inverted_nominal, causes.NOMINAL)


def _with_inverted_nominal(samples: Samples) -> Samples | None:
    # Poses that are typical of a rig are compared with nothing.
    if all(entry.source != "cad" for entry in samples.rig.nominal_extrinsics):
        return None
    nominal = tuple(entry.corrections()["inverted"] for entry in samples.rig.nominal_extrinsics)
    return _with_rig(samples, samples.rig.model_copy(update={"nominal_extrinsics": nominal}))


def _turned() -> Iterator[Corruption]:
    yield Corruption("images rotated by 90 deg", lambda s: _with_images(s, np.rot90), causes.OTHER_IMAGES)
    yield Corruption(
        "images rotated by 180 deg",
        lambda s: _with_images(s, lambda p: np.rot90(p, 2)),
        causes.NOMINAL | causes.LENS,
        "but for the principal point, a camera that is mounted upside down takes these images",
    )
    for angle_deg in (5, 30, 90, 180):
        T = _about_z(angle_deg)
        yield Corruption(
            f"scans rotated by {angle_deg} deg about z",
            lambda s, T=T: _with_points(s, lambda p: transform(T, p)),  # type: ignore[misc]
            causes.NOMINAL,
            "a LiDAR that is mounted with another yaw takes these scans",
        )


def _scaled() -> Iterator[Corruption]:
    for label, factor in (("by 1.02", 1.02), ("by 1.05", 1.05), ("to feet", 1 / _FOOT_M), ("to mm", 1000.0)):
        yield Corruption(
            f"scans scaled {label}",
            lambda s, factor=factor: _with_points(s, lambda p: factor * p),  # type: ignore[misc]
            causes.SCALED if "by" in label else causes.OTHER_UNIT,
        )
    yield Corruption(
        "scans and board scaled by 1.02",
        lambda s: _with_board(_with_points(s, lambda p: 1.02 * p), _scaled_board(s.rig, 1.02)),
        causes.SCALED,
        "with another metre everywhere everything fits",
    )


def _elevations() -> Iterator[Corruption]:
    for error_deg in (0.2, 0.5, 1.0):
        yield Corruption(
            f"elevations wrong by -{error_deg:g} to +{error_deg:g} deg",
            lambda s, error_deg=error_deg: _with_elevations(s, np.radians(error_deg)),  # type: ignore[misc]
            causes.LASERS,
        )
    for angle in ("elevations", "azimuths"):
        yield Corruption(
            f"{angle} of every other ring wrong by +-0.5 deg",
            lambda s, angle=angle: _with_other_table(s, angle),  # type: ignore[misc]
            causes.LASERS,
        )
    # Readers of such a point cloud count its rings from the lowest.
    yield Corruption("elevations in reversed order", _upside_down, causes.MIRRORED | causes.LASERS)


def _upside_down(samples: Samples) -> Samples:
    def flip(scan: Scan) -> Scan:
        return replace(_moved(scan, scan.points * [1, 1, -1]), ring=scan.ring.max() - scan.ring)

    return replace(samples, scans={name: flip(scan) for name, scan in samples.scans.items()})


def _with_elevations(samples: Samples, error_rad: float) -> Samples:
    """Read each ring's elevation wrong: the lowest by -error, the highest by +error, linear in between."""
    highest = max(int(scan.ring.max()) for scan in samples.scans.values())
    return _with_angles(samples, lambda ring: (0 * ring, error_rad * (2 * ring / highest - 1)))


def _with_other_table(samples: Samples, angle: str) -> Samples:
    """Read the angles of odd rings too large, of even ones too small."""

    def errors(ring: Array) -> tuple[Array, Array]:
        off = np.radians(0.5) * (2.0 * (ring % 2) - 1)
        return (off, 0 * off) if angle == "azimuths" else (0 * off, off)

    return _with_angles(samples, errors)


def _with_angles(samples: Samples, errors: Callable[[Array], tuple[Array, Array]]) -> Samples:
    """Add errors of azimuth and elevation to each ring."""

    def raised(scan: Scan) -> Scan:
        x, y, z = scan.points.astype(float).T
        turned, lifted = errors(scan.ring.astype(float))
        elevation, azimuth = np.arctan2(z, np.hypot(x, y)) + lifted, np.arctan2(y, x) + turned
        level = np.cos(elevation)
        rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
        return _moved(scan, np.linalg.norm(scan.points, axis=1)[:, None] * rays)

    return replace(samples, scans={name: raised(scan) for name, scan in samples.scans.items()})


# Captures of a rig with other sensor poses.


def _other_places() -> Iterator[Corruption]:
    for label, T in (
        ("0.5 deg", _about_z(0.5)),
        ("1 deg", _about_z(1)),
        ("3 deg", _about_z(3)),
        ("2 cm", _aside(0.02)),
        ("5 cm", _aside(0.05)),
    ):
        yield Corruption(
            f"a quarter of the captures from a rig nudged by {label}",
            lambda s, T=T: _nudged(s, s.captures[1::4], T),  # type: ignore[misc]
            causes.MOVED,
        )
    for label, T in (("1 deg", _about_z(1)), ("5 cm", _aside(0.05))):
        yield Corruption(
            f"every other capture from a rig nudged by {label}",
            lambda s, T=T: _nudged(s, s.captures[1::2], T),  # type: ignore[misc]
            causes.MOVED,
        )
    yield Corruption(
        "every third capture from a rig nudged by 0.8 deg and 15 mm",
        lambda s: _nudged(s, s.captures[::3], _NUDGE),
        causes.MOVED,
    )
    for label, T in (
        ("0.5 deg", _about_z(0.5)),
        ("1 deg", _about_z(1)),
        ("5 cm", _aside(0.05)),
        ("0.8 deg and 15 mm", _NUDGE),
    ):
        # The LiDAR's final pose is the truth.
        yield Corruption(
            f"LiDAR nudged by {label} half-way",
            lambda s, T=T: replace(  # type: ignore[misc]
                _nudged(s, s.captures[len(s.captures) // 2 :], T), T_lidar_moved=T
            ),
            causes.MOVED,
        )
    for label, T in (("3 deg", _about_z(3)), ("1.5 deg and 30 mm", _about_z(1.5) @ _aside(0.03))):
        yield Corruption(
            f"one capture from a rig nudged by {label}",
            lambda s, T=T: _nudged(s, [s.captures[len(s.captures) // 3]], T),  # type: ignore[misc]
            causes.OUTLIER,
        )


def _at_the_ends() -> Iterator[Corruption]:
    """Move the LiDAR before the last captures, or after the first; its final pose is the truth."""
    for angle_deg in (1.5, 3.0, 5.0):
        T = _about_x(angle_deg)
        for n in (1, 2, 3, 4):
            last = "capture" if n == 1 else f"{n} captures"
            yield Corruption(
                f"LiDAR turned by {angle_deg:g} deg before the last {last}",
                lambda s, n=n, T=T: replace(_nudged(s, s.captures[-n:], T), T_lidar_moved=T),  # type: ignore[misc]
                causes.LAST if n == 1 else causes.MOVED,
                "one capture that disagrees may be of a board that moved" if n == 1 else "",
            )
        for n in (2, 3):
            yield Corruption(
                f"LiDAR turned by {angle_deg:g} deg after the first {n} captures",
                lambda s, n=n, T=T: _nudged(s, s.captures[:n], T),  # type: ignore[misc]
                causes.MOVED,
            )
    yield Corruption(
        "LiDAR nudged by 0.8 deg and 15 mm before the last 3 captures",
        lambda s: replace(_nudged(s, s.captures[-3:], _NUDGE), T_lidar_moved=_NUDGE),
        causes.MOVED,
    )


def _drifting() -> Iterator[Corruption]:
    """Change the mounting, or the focus, slowly from the first capture to the last."""
    yield Corruption("LiDAR drifts by 1 deg", lambda s: _drifted(s, 1.0), causes.DRIFT)
    yield Corruption(
        "focal length drifts by 1 %",
        _same,
        causes.FOCUS_DRIFT,
        spoil=lambda rig, found, _: with_focus_drift(rig, found, 0.01),
    )


def _drifted(samples: Samples, angle_deg: float) -> Samples:
    """Rotate the LiDAR about z in proportion to the capture number; its final pose is the truth."""
    names, scans = samples.captures, dict(samples.scans)
    for name, part in zip(names, np.linspace(0, 1, len(names)), strict=True):
        scans[name] = _nudged(samples, [name], _about_z(angle_deg * float(part))).scans[name]
    return replace(samples, scans=scans, T_lidar_moved=_about_z(angle_deg))


def _nudged(samples: Samples, names: Sequence[str], T_lidar_moved: Array) -> Samples:
    """Take the scans of some captures with the LiDAR elsewhere; its rings stay level."""
    scans = dict(samples.scans)
    for name in names:
        scans[name] = _moved(scans[name], transform(invert(T_lidar_moved), scans[name].points))
    return replace(samples, scans=scans)


def _about_z(angle_deg: float) -> Array:
    return pose(exp_so3(np.radians(angle_deg) * np.array([0.0, 0.0, 1.0])), np.zeros(3))


def _about_x(angle_deg: float) -> Array:
    return pose(exp_so3(np.radians(angle_deg) * np.array([1.0, 0.0, 0.0])), np.zeros(3))


def _aside(shift_m: float) -> Array:
    """Shift forward and left alike."""
    return pose(np.eye(3), shift_m * np.sqrt([0.5, 0.5, 0.0]))


# 0.8 deg about a slanted axis, and 15 mm.
_NUDGE = pose(
    exp_so3(np.radians(0.8) * np.array([0.3, 0.3, 0.9]) / np.linalg.norm([0.3, 0.3, 0.9])),
    0.015 * np.array([0.6, 0.0, 0.8]),
)


# Intrinsics that belong to another lens, or to another mode of the camera.


def _lenses() -> Iterator[Corruption]:
    for percent in (0.5, -1, 2, -5):
        factor = 1 + percent / 100
        yield Corruption(
            f"focal length of the profile {percent:+g} %",
            lambda s, f=factor: _with_lens(  # type: ignore[misc]
                s, lambda lens: {"fx_px": f * lens.fx_px, "fy_px": f * lens.fy_px}
            ),
            causes.LENS,
            sigmas=lambda rig, percent=percent: abs(percent) / 100 / _known(rig).lens.focal_length,  # type: ignore[misc]
        )
    yield Corruption(
        "principal point of the profile 5 px right",
        lambda s: _with_lens(s, lambda k: {"cx_px": k.cx_px + 5}),
        causes.LENS,
        sigmas=lambda rig: 5 / _known(rig).lens.principal_point_px,
    )
    yield Corruption(
        "principal point of the profile 20 px up",
        lambda s: _with_lens(s, lambda k: {"cy_px": k.cy_px - 20}),
        causes.LENS,
        sigmas=lambda rig: 20 / _known(rig).lens.principal_point_px,
    )
    yield Corruption(
        "distortion of the profile zero",
        lambda s: _with_lens(s, lambda k: {"distortion": (0.0,) * len(k.distortion)}),
        causes.DISTORTION,
        sigmas=_sigmas_of_distortion,
    )
    yield Corruption("images of half the resolution", lambda s: _with_images(s, _halved), causes.OTHER_IMAGES)
    yield Corruption(
        "images and resolution halved, other intrinsics unchanged",
        lambda s: _with_resolution_halved(_with_images(s, _halved)),
        causes.OTHER_IMAGES | causes.LENS,
    )


def _known(rig: Rig) -> Tolerances:
    """Return the standard deviations in a profile of one camera."""
    return Tolerances.of(next(iter(rig.cameras.values())), rig.board)


def _sigmas_of_distortion(rig: Rig) -> float:
    """Compare the displacement of pixels by the distortion with its standard deviation.

    Half-way to the corner, where every lens model is defined: there it is an eighth of the corner's.
    """
    known = _known(rig).lens
    lens = known.lens
    pixels = np.array([[lens.cx_px, lens.cy_px]]) / 2
    rays = replace(lens, distortion=(0.0,) * len(lens.distortion)).unproject(pixels)
    distorted, _ = lens.project(rays)
    return float(np.linalg.norm(distorted - pixels)) / (known.distortion_px / 8)


def _halved(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = pixels.shape[:2]
    return np.asarray(cv2.resize(pixels, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8)


def _with_resolution_halved(samples: Samples) -> Samples:
    cameras = {
        name: camera.model_copy(
            update={"resolution_px": (camera.resolution_px[0] // 2, camera.resolution_px[1] // 2)}
        )
        for name, camera in samples.rig.cameras.items()
    }
    return _with_rig(samples, samples.rig.model_copy(update={"cameras": cameras}))


# Boards other than the profile's.


def _prints() -> Iterator[Corruption]:
    for percent in (0.5, -1, 2, -5):
        factor = 1 + percent / 100
        yield Corruption(
            f"squares of the profile {percent:+g} %",
            lambda s, f=factor: _with_board(s, {"square_m": f * s.rig.board.square_m}),  # type: ignore[misc]
            causes.SQUARES,
            sigmas=lambda rig, f=factor: abs(f - 1) / _known(rig).square_size,  # type: ignore[misc]
        )
    for offset_m in (0.01, 0.02):
        yield Corruption(
            f"pattern {1000 * offset_m:.0f} mm off the plate's centre",
            lambda s, offset_m=offset_m: _with_board(s, _off_centre(s.rig.board, offset_m)),  # type: ignore[misc]
            causes.PATTERN,
            sigmas=lambda rig, offset_m=offset_m: offset_m / _known(rig).pattern_offset_m,  # type: ignore[misc]
        )
    for added_m in (0.01, 0.02, 0.035):
        yield Corruption(
            f"plate of the profile {1000 * added_m:.0f} mm larger",
            lambda s, added_m=added_m: _with_board(  # type: ignore[misc]
                s, {"width_m": s.rig.board.width_m + added_m, "height_m": s.rig.board.height_m + added_m}
            ),
            causes.PLATE,
            sigmas=lambda rig, added_m=added_m: added_m / _known(rig).plate_m,  # type: ignore[misc]
        )
    yield Corruption(
        "plate bowed by 8 mm",
        _same,
        causes.BOW,
        sigmas=lambda rig: 0.008 / _known(rig).bow_m,
        spoil=lambda rig, found, _: with_bow(rig, found, 0.008),
    )
    yield Corruption(
        "squares of the second half of the captures 10 % smaller",
        _same,
        causes.TWO_BOARDS,
        spoil=lambda rig, found, _: with_second_board(rig, found, 0.9),
    )
    yield Corruption(
        "one more row of corners in the profile", lambda s: _with_corners(s, 0, 1), causes.OTHER_CORNERS
    )
    yield Corruption(
        "one column of corners fewer in the profile", lambda s: _with_corners(s, -1, 0), causes.OTHER_CORNERS
    )
    yield Corruption(
        "board scaled by 1.02 in the profile",
        lambda s: _with_board(s, _scaled_board(s.rig, 1.02)),
        causes.SCALED,
        sigmas=lambda rig: 0.02 / _known(rig).square_size,
    )


def _off_centre(board: BoardSettings, offset_m: float) -> dict[str, object]:
    x, y = board.pattern_offset_m
    return {"pattern_offset_m": (x + offset_m, y)}


def _with_corners(samples: Samples, added_columns: int, added_rows: int) -> Samples:
    columns, rows = samples.rig.board.inner_corners or (0, 0)
    return _with_board(samples, {"inner_corners": (columns + added_columns, rows + added_rows)})


def _scaled_board(rig: Rig, factor: float) -> dict[str, object]:
    board = rig.board
    x, y = board.pattern_offset_m
    lengths: dict[str, object] = {
        key: factor * getattr(board, key) for key in ("square_m", "width_m", "height_m")
    }
    return lengths | {"pattern_offset_m": (factor * x, factor * y)}


# Time.


def _timing() -> Iterator[Corruption]:
    # Boards stand still, or samples are paired already.
    yield Corruption(
        "timestamps of images mixed up", _with_mixed_stamps, causes.TIME_OFFSET, sigmas=lambda _: 0.0
    )
    for name in map(late, LATE_S):
        yield Corruption(
            f"board moving, timestamps of images {name}",
            lambda s, name=name: s.variants.get(name),  # type: ignore[misc]
            causes.TIME_OFFSET,
        )


def _readout() -> Iterator[Corruption]:
    yield Corruption(
        "board moves at 0.15 m/s, rows read out over 20 ms",
        _same,
        causes.READOUT,
        spoil=lambda rig, found, _: with_rolling_shutter(rig, found, 0.02, 0.15),
    )


def _with_mixed_stamps(samples: Samples) -> Samples | None:
    stamps = [samples.images[name].stamp_ns for name in samples.captures]
    if None in stamps:
        return None
    mixed = np.random.default_rng(_SEED).permutation(len(stamps))
    images = {
        name: replace(samples.images[name], stamp_ns=stamps[k])
        for name, k in zip(samples.captures, mixed, strict=True)
    }
    return replace(samples, images=images)


# Noise, and captures with too little information.


def _noise() -> Iterator[Corruption]:
    for offset_m in (0.03, 0.06, 0.1):
        yield Corruption(
            f"ranges {100 * offset_m:.0f} cm too long",
            lambda s, offset_m=offset_m: _with_ranges(s, lambda r, _: r + offset_m),  # type: ignore[misc]
            causes.RANGE_OFFSET,
            sigmas=lambda rig, offset_m=offset_m: (  # type: ignore[misc]
                offset_m / next(iter(rig.lidars.values())).range_offset_sigma_m
            ),
        )
    yield Corruption(
        "ranges 15 mm longer on dark squares",
        _same,
        causes.RANGE_CONTRAST,
        spoil=lambda rig, found, T_cam_lidar: with_contrast(rig, found, T_cam_lidar, 0.015),
    )
    yield Corruption(
        "ranges with 5 cm of noise",
        lambda s: _with_ranges(s, lambda r, rng: r + 0.05 * rng.standard_normal(len(r))),
        causes.SCATTER,
    )
    yield Corruption("every other ring lost", _with_half_the_rings, causes.FEW_RINGS, sigmas=lambda _: 0.0)


def _with_ranges(samples: Samples, change: Callable[[Array, np.random.Generator], Array]) -> Samples:
    rng = np.random.default_rng(_SEED)
    scans = {}
    for name in samples.captures:
        points = samples.scans[name].points.astype(float)
        range_m = np.linalg.norm(points, axis=1)
        scans[name] = _moved(samples.scans[name], points * (change(range_m, rng) / range_m)[:, None])
    return replace(samples, scans=scans)


def _with_half_the_rings(samples: Samples) -> Samples:
    scans = {name: scan.select(scan.ring % 2 == 0) for name, scan in samples.scans.items()}
    return replace(samples, scans=scans)


def _too_little() -> Iterator[Corruption]:
    for n in (3, 5):
        yield Corruption(
            f"only {n} captures",
            lambda s, n=n: _only(s, s.captures[:n]),  # type: ignore[misc]
            causes.FEW,
        )
    yield Corruption("one capture 10 times", _copied, causes.FEW)
    # With a covariance within the targets, nothing is wrong with them.
    yield Corruption(
        "boards nearly parallel", lambda s: s.variants.get(PARALLEL), causes.FEW, sigmas=lambda _: 0.0
    )
    yield Corruption("board always in one place", lambda s: s.variants.get(ONE_PLACE), causes.FEW)


def _only(samples: Samples, names: Sequence[str]) -> Samples:
    images, scans = ({name: by_name[name] for name in names} for by_name in (samples.images, samples.scans))
    return replace(samples, images=images, scans=scans)  # type: ignore[arg-type]


def _copied(samples: Samples) -> Samples:
    first = samples.captures[0]
    copies = [f"{k:06d}" for k in range(10)]
    return replace(
        samples,
        images=dict.fromkeys(copies, samples.images[first]),
        scans=dict.fromkeys(copies, samples.scans[first]),
    )


# The uncorrupted data from which all are made.


def _same(samples: Samples) -> Samples:
    return samples


def _with_images(samples: Samples, change: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> Samples:
    def changed(image: Image) -> Image:
        return replace(image, pixels=np.ascontiguousarray(change(image.pixels)))

    return replace(samples, images={name: changed(image) for name, image in samples.images.items()})


def _with_points(samples: Samples, change: Callable[[Array], Array]) -> Samples:
    scans = {name: _moved(scan, change(scan.points.astype(float))) for name, scan in samples.scans.items()}
    return replace(samples, scans=scans)


def _moved(scan: Scan, points: Array) -> Scan:
    return replace(scan, points=np.ascontiguousarray(points, dtype=np.float32))


def _with_board(samples: Samples, update: dict[str, object]) -> Samples:
    board = samples.rig.board.model_copy(update=update)
    return _with_rig(samples, samples.rig.model_copy(update={"board": board}))


def _with_lens(samples: Samples, change: Callable[[IntrinsicsSettings], dict[str, object]]) -> Samples:
    cameras = {
        name: camera.model_copy(
            update={"intrinsics": camera.intrinsics.model_copy(update=change(camera.intrinsics))}
        )
        for name, camera in samples.rig.cameras.items()
    }
    return _with_rig(samples, samples.rig.model_copy(update={"cameras": cameras}))


def _with_rig(samples: Samples, rig: Rig) -> Samples:
    """Give the session another profile, which must be one that can be loaded.

    Raises:
        ProfileError: it cannot.
    """
    return replace(samples, rig=parse_rig(dump_rig(rig)))
