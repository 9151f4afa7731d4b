"""Image-scan matching from file names alone."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.errors import SourceError
from lce_rig.io.protocol import PairMethod

MOSTLY = 0.9


@dataclass(frozen=True)
class Pairing:
    """A choice of pairs, as positions in the two lists of names.

    Attributes:
        method: how the pairs were found.
        pairs: (image, point cloud) positions, by name of the image.
        lone_images, lone_clouds: positions that have no partner.
        explanation: what was chosen and why, one sentence.
    """

    method: Literal["stem", "order", "time"]
    pairs: tuple[tuple[int, int], ...]
    lone_images: tuple[int, ...]
    lone_clouds: tuple[int, ...]
    explanation: str


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """Give a sort key that puts "scan2" before "scan10"."""
    return [
        (0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part
    ]


def parse_times(stems: Sequence[str]) -> NDArray[np.int64] | None:
    """Read file names as times in ns; None where any is not a time.

    Seconds have a decimal point; 19 digits are ns since 1970, 16 are us and 13 are ms. Counters are not
    times.
    """
    times = []
    for stem in stems:
        if re.fullmatch(r"\d{1,10}\.\d{1,9}", stem):
            times.append(int(Decimal(stem) * 10**9))
        elif re.fullmatch(r"\d{19}|\d{16}|\d{13}", stem):
            times.append(int(stem) * 10 ** (19 - len(stem)))
        else:
            return None
    if not times or max(times) > np.iinfo(np.int64).max:
        return None
    return np.array(times, dtype=np.int64)


def pair_names(
    images: Sequence[str], clouds: Sequence[str], method: PairMethod = "auto", tolerance_s: float = 0.05
) -> Pairing:
    """Match images and point clouds by their names (without suffix).

    `auto` takes equal names where nine in ten match; else the nearest time, where names are times and nine in
    ten find a partner within the tolerance; else sorted order, where there are as many images as point
    clouds.

    Args:
        images, clouds: names in natural order.
        method: "stem", "order", "time", or "auto".
        tolerance_s: largest difference in time, for "time".

    Raises:
        SourceError: the names do not allow the method, or no method.
    """
    if method == "stem":
        return _require_pairs(_by_stem(images, clouds))
    if method == "order":
        return _by_order(images, clouds)
    times = parse_times(images), parse_times(clouds)
    if method == "time":
        if times[0] is None or times[1] is None:
            raise SourceError(
                "file names are not times: pairs cannot be matched by time", "Try --pair order."
            )
        return _require_pairs(_by_time(times[0], times[1], tolerance_s))
    return _choose(images, clouds, times, tolerance_s)


def _choose(
    images: Sequence[str],
    clouds: Sequence[str],
    times: tuple[NDArray[np.int64] | None, NDArray[np.int64] | None],
    tolerance_s: float,
) -> Pairing:
    candidates = [_by_stem(images, clouds)]
    if times[0] is not None and times[1] is not None:
        candidates.append(_by_time(times[0], times[1], tolerance_s))
    for pairing in candidates:
        if len(pairing.pairs) >= MOSTLY * min(len(images), len(clouds)):
            return pairing
    if len(images) == len(clouds):
        return _by_order(images, clouds)
    best = max(candidates, key=lambda pairing: len(pairing.pairs))
    if best.pairs:
        return best
    raise SourceError(
        f"{len(images)} images and {len(clouds)} point clouds cannot be paired: names and numbers differ",
        "Give both files of a pair the same name, or remove files without a partner.",
    )


def _by_stem(images: Sequence[str], clouds: Sequence[str]) -> Pairing:
    places: dict[str, list[int]] = {}
    for j in reversed(range(len(clouds))):
        places.setdefault(clouds[j], []).append(j)
    pairs = []
    for i, name in enumerate(images):
        if name in places:
            # Files may differ in their suffix only: the first goes with the first, the rest with the last.
            left = places[name]
            pairs.append((i, left.pop() if len(left) > 1 else left[0]))
    return _pairing("stem", pairs, len(images), len(clouds), "paired by equal file names")


def _by_order(images: Sequence[str], clouds: Sequence[str]) -> Pairing:
    if len(images) != len(clouds):
        raise SourceError(
            f"sorted order needs as many images as point clouds: {len(images)} and {len(clouds)} found",
            "Remove files without a partner, or pair by name or time.",
        )
    n = len(images)
    times = parse_times(images), parse_times(clouds)
    reason = "paired in sorted order"
    if times[0] is not None and times[1] is not None:
        apart_s = np.abs(times[0] - times[1]).max() * 1e-9
        reason += f" (names are times up to {apart_s:.3f} s apart)"
    return _pairing("order", [(i, i) for i in range(n)], n, n, reason)


def _by_time(image_ns: NDArray[np.int64], cloud_ns: NDArray[np.int64], tolerance_s: float) -> Pairing:
    """Pair what is nearest in time to each other, both ways."""
    nearest = _nearest(image_ns, cloud_ns)
    is_mutual = _nearest(cloud_ns, image_ns)[nearest] == np.arange(len(image_ns))
    is_near = np.abs(image_ns - cloud_ns[nearest]) <= tolerance_s * 1e9
    pairs = [(int(i), int(nearest[i])) for i in np.flatnonzero(is_mutual & is_near)]
    reason = f"paired by nearest time within {tolerance_s:g} s"
    return _pairing("time", pairs, len(image_ns), len(cloud_ns), reason)


def _nearest(times_ns: NDArray[np.int64], others_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Find the place of the nearest of `others_ns` to each time; of equally near ones the first."""
    # Equal timestamps are found at their first place, in any order.
    sorted_ns, place = np.unique(others_ns, return_index=True)
    above = np.clip(np.searchsorted(sorted_ns, times_ns), 0, len(sorted_ns) - 1)
    below = np.maximum(above - 1, 0)
    to_above, to_below = np.abs(sorted_ns[above] - times_ns), np.abs(times_ns - sorted_ns[below])
    is_below = (to_below < to_above) | ((to_below == to_above) & (place[below] < place[above]))
    return np.where(is_below, place[below], place[above])


def _pairing(
    method: Literal["stem", "order", "time"],
    pairs: list[tuple[int, int]],
    n_images: int,
    n_clouds: int,
    reason: str,
) -> Pairing:
    lone_images = tuple(sorted(set(range(n_images)) - {i for i, _ in pairs}))
    lone_clouds = tuple(sorted(set(range(n_clouds)) - {j for _, j in pairs}))
    text = f"{len(pairs)} pairs, {reason}"
    if lone_images or lone_clouds:
        text += f"; {len(lone_images)} images and {len(lone_clouds)} point clouds have no partner"
    return Pairing(method, tuple(pairs), lone_images, lone_clouds, text)


def _require_pairs(pairing: Pairing) -> Pairing:
    if not pairing.pairs:
        raise SourceError(
            f"no image matches a point cloud by {pairing.method}", "Try --pair order, or --pair time."
        )
    return pairing
