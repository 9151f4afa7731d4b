"""Convert camera descriptions of drivers and files to intrinsics of their images.

A description belongs to the sensor's full size. Binning and region of interest lead from there to the images,
and images that were rectified have the projection matrix P and no distortion.

References:
    https://docs.ros.org/en/noetic/api/sensor_msgs/html/msg/CameraInfo.html
    https://github.com/ros-perception/image_common (camera_calibration_parsers: ost.yaml, ost.txt)
    https://github.com/ethz-asl/kalibr/wiki/yaml-formats (camchain)
    https://github.com/xuankuzcr/rpg_vikit (camera_loader.h: FAST-LIVO2's camera)
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.camera import CUT_FRACTION, Intrinsics
from lce_rig.core.errors import ProfileError, UsageError, reading
from lce_rig.core.geometry import Array

FORMS = (
    "camera_info of ROS (YAML, ost.txt, or of ros2 topic echo), Kalibr's camchain, OpenCV's FileStorage "
    "(YAML or XML) with camera_matrix, dist_coeffs, image_width and image_height, or FAST-LIVO2's camera"
)
# Maximum size: descriptions are a few pages, and a recording given by mistake is not parsed.
_MAX_BYTES = 1 << 20
_MAX_DEPTH = 6
# Ends of keys of a second camera in one file, as OpenCV's stereo samples write them.
_SIDES = ("", "1", "2", "left", "right")
# Keys without underscores and capital letters.
_MATRIX = ("cameramatrix", "k", "m", "cameramat", "intrinsicmatrix", "intrinsics", "mtx")
_COEFFICIENTS = (
    *("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "distcoefs"),
    *("d", "distortion", "dist"),
)
_PROJECTION = ("projectionmatrix", "p")
_RECTIFICATION = ("rectificationmatrix", "r")
# Rotation by rectification that has no effect on a calibration, deg.
_TURNED_DEG = 0.005
_SIZE = ("imagesize", "resolution", "imgsize", "size")
_WIDTH, _HEIGHT = ("imagewidth", "width", "camwidth"), ("imageheight", "height", "camheight")
_MODEL = ("distortionmodel", "distmodel", "cammodel", "cameramodel", "modeltype", "model", "lensmodel")
_FISHEYE = ("fisheyemodel", "fisheye", "isfisheye", "usefisheye")
# Names of models that differ from those of ROS; perspective ones leave distortion to the coefficients.
_MODELS = {
    **dict.fromkeys(("pinhole", "perspective", "opencv", "rational", "brown", "brownconrady"), "radtan"),
    **dict.fromkeys(("equidistantcamera", "equi", "kannalabrandt", "kannalabrandt4"), "equidistant"),
}


@dataclass(frozen=True, eq=False)
class CameraDescription:
    """A camera as described by a driver or file.

    Attributes:
        K: (3, 3) px, at the full size.
        distortion: coefficients of the distortion.
        model: name of the distortion model, see `Intrinsics.from_ros`.
        size_px: (width, height) to which K belongs; zeros if not stated.
        P: (3, 4) px, of rectified images; zeros if not stated.
        turned_deg: angle by which rectification rotates the camera's frame.
        binning: pixels of the sensor per pixel of the images, in x and y.
        roi_px: (x offset, y offset, width, height) that is read out, at the full size; a width and height of
            zero for all of it.
        name: name of the camera, or "".
        topic: topic of its images, or "".
    """

    K: Array
    distortion: tuple[float, ...]
    model: str
    size_px: tuple[int, int]
    P: Array = field(default_factory=lambda: np.zeros((3, 4)))
    turned_deg: float = 0.0
    binning: tuple[int, int] = (1, 1)
    roi_px: tuple[int, int, int, int] = (0, 0, 0, 0)
    name: str = ""
    topic: str = ""

    def intrinsics(
        self, image_px: tuple[int, int] | None = None, *, is_rectified: bool = False
    ) -> tuple[Intrinsics, list[str]]:
        """Return the intrinsics of the images, and notes on the changes made to the description.

        Args:
            image_px: (width, height) of the images; None if unknown.
            is_rectified: whether their distortion has been removed.

        Raises:
            ValueError: the camera is not calibrated, of an unusable model, or of images of another size.
        """
        K, distortion, model, notes = self.K, self.distortion, self.model, list[str]()
        if is_rectified and self.P.any():
            K, distortion, model = self.P[:, :3], (), ""
            notes.append("its P without distortion, as the images are rectified")
            if self.turned_deg > _TURNED_DEG:
                notes.append(
                    f"optical_frame is that of the rectified images, {self.turned_deg:.2g} deg away (R)"
                )
        elif is_rectified and any(distortion):
            raise ValueError("P is all zero, and the images are rectified")
        lens = Intrinsics.from_ros(model, K, distortion, self.size_px)
        offset_px, binning, size_px = self._readout(image_px)
        if self.size_px == (0, 0):
            notes.append(f"it states 0x0 px, {size_px[0]}x{size_px[1]} px are the images'")
        (x, y), (across, down) = offset_px, binning
        notes += [f"binning {across}x{down} applied"] if binning != (1, 1) else []
        notes += [f"roi at {x}, {y} px applied"] if any(offset_px) else []
        is_windowed = self.binning != (1, 1) or any(self.roi_px[:2])
        if is_windowed and not any(offset_px) and binning == (1, 1):
            notes.append("its binning and roi are not those of the images, which have the full size")
        read = replace(
            lens,
            fx_px=lens.fx_px / across,
            fy_px=lens.fy_px / down,
            # A binned pixel's centre is the centre of its original pixels.
            cx_px=(lens.cx_px - x + 0.5) / across - 0.5,
            cy_px=(lens.cy_px - y + 0.5) / down - 0.5,
            width_px=size_px[0],
            height_px=size_px[1],
        )
        if image_px is not None and not _fits(size_px, image_px):
            raise ValueError(_other_size(read, image_px))
        return read, notes

    def _readout(
        self, image_px: tuple[int, int] | None
    ) -> tuple[tuple[int, int], tuple[int, int], tuple[int, int]]:
        """Return offset (px), binning and size (px) of the images within the full size.

        Raises:
            ValueError: a size is missing, or the region reaches beyond it.
        """
        x, y, *region = self.roi_px
        full = self.size_px
        if not all(full) and not all(region):
            if image_px is None:
                raise ValueError("it states no image size")
            return (x, y), self.binning, image_px
        if not all(region):
            region = [full[0] - x, full[1] - y]
        elif all(full) and (x + region[0] > full[0] or y + region[1] > full[1]):
            what = f"its roi of {region[0]}x{region[1]} px at {x}, {y}"
            raise ValueError(f"{what} reaches beyond its {full[0]}x{full[1]} px")
        size = region[0] // self.binning[0], region[1] // self.binning[1]
        # Some drivers report a mode that differs from the images.
        if image_px is not None and not _fits(size, image_px) and _fits(full, image_px):
            return (0, 0), (1, 1), full
        return (x, y), self.binning, size


def _fits(size_px: Sequence[int], image_px: Sequence[int]) -> bool:
    """Compare sizes; a readout may end a few lines early, and binning may round an odd size."""
    pairs = zip(size_px, image_px, strict=True)
    return all(-1 <= side - image <= max(CUT_FRACTION * side, 1) for side, image in pairs)


def _other_size(lens: Intrinsics, image_px: tuple[int, int]) -> str:
    """State that the intrinsics are for another image size; add scaled ones if the aspect ratio fits."""
    width, height = image_px
    text = f"it belongs to {lens.width_px}x{lens.height_px} px, the images have {width}x{height} px"
    share = width / lens.width_px
    if abs(share - height / lens.height_px) > 0.01 * share:
        return text
    c_px = [(value + 0.5) * share - 0.5 for value in (lens.cx_px, lens.cy_px)]
    numbers = [lens.fx_px * share, lens.fy_px * share, *c_px, *lens.distortion]
    values = ",".join(f"{value:.8g}" for value in numbers)
    return f"{text}. If they were scaled: --intrinsics {lens.model},{width}x{height},{values}"


def is_rectified(topic: str) -> bool:
    """Check whether a topic name denotes rectified images, such as /camera/image_rect_color."""
    return any(word in ("rect", "rectified") for word in re.split(r"[/_]", topic.lower()))


def describe_message(info: Any) -> CameraDescription:
    """Read the fields of a sensor_msgs/CameraInfo of ROS 1 or ROS 2.

    Raises:
        ValueError: a field is invalid.
    """
    names = ("distortion_model", "width", "height", "binning_x", "binning_y", "k", "d", "p", "r")
    fields = {name: getattr(info, name, None) for name in names}
    # ROS 1 has capital letters.
    fields |= {name: getattr(info, name.upper()) for name in "kdpr" if hasattr(info, name.upper())}
    roi = {name: getattr(info.roi, name) for name in ("x_offset", "y_offset", "width", "height")}
    return next(_describe({**fields, "roi": roi}))


@dataclass(frozen=True, eq=False)
class CameraFile:
    """The cameras described in a file.

    Attributes:
        path: the file.
        cameras: at least one description.
    """

    path: Path
    cameras: tuple[CameraDescription, ...]

    def intrinsics(
        self,
        name: str = "",
        topics: Sequence[str] = (),
        image_px: tuple[int, int] | None = None,
    ) -> tuple[Intrinsics, list[str]]:
        """Return a camera's intrinsics and notes, see `CameraDescription.intrinsics`.

        Args:
            name: name of the camera, which chooses among several.
            topics: topics of its images, which choose among several, too.
            image_px: (width, height) of its images; None if unknown.

        Raises:
            UsageError: there are several cameras, and none of this name or topic.
            ProfileError: the description cannot be used, or belongs to images of another size.
        """
        chosen = list(self.cameras)
        if len(chosen) > 1:
            plain = {topic.strip("/").removesuffix("/compressed") for topic in topics}
            chosen = [camera for camera in chosen if camera.topic and camera.topic.strip("/") in plain]
            chosen = chosen or [camera for camera in self.cameras if camera.name == name]
        if len(chosen) != 1:
            listed = ", ".join(f"{one.name} ({one.topic or 'no topic'})" for one in self.cameras)
            raise UsageError(
                f"{self.path} describes {len(self.cameras)} cameras, none of them is {name}: {listed}",
                f"Name yours as the file does: --camera {self.cameras[0].name}",
            )
        try:
            return chosen[0].intrinsics(image_px, is_rectified=any(map(is_rectified, topics)))
        except ValueError as error:
            raise ProfileError(f"{self.path}: not usable: {error}") from None


def read_cameras(path: Path) -> CameraFile:
    """Read a file that describes cameras, in any of `FORMS`.

    Raises:
        ProfileError: the file cannot be read, or describes no camera.
    """
    with reading(path, ProfileError, f"Give {FORMS}.", _MAX_BYTES):
        data = path.read_bytes()
        # A recorded `rostopic echo` repeats its camera.
        for document in _documents(data):
            if found := tuple(_describe(document)):
                return CameraFile(path, found)
        raise ValueError("it describes no camera")


def _documents(data: bytes) -> Iterator[Any]:
    """Parse YAML, XML of OpenCV's FileStorage, or the lines of ost.txt."""
    text = data.decode("utf-8-sig").replace("\r\n", "\n")
    if re.search(r"^camera matrix *$", text, re.MULTILINE):
        yield _parse_ini(text)
    elif text.lstrip().startswith("<"):
        import cv2

        file = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        yield _plain(file.root())
    else:
        import yaml

        # OpenCV's directive and tags are not valid YAML; without them the rest reads as plain mappings.
        text = re.sub(r"^%YAML.*\n|!!opencv-[a-z-]+", "", text)
        yield from yaml.safe_load_all(text)


def _plain(node: Any) -> Any:
    """Convert a node of cv2.FileStorage to plain types."""
    if node.isMap():
        return {key: _plain(node.getNode(key)) for key in node.keys()}  # noqa: SIM118
    if node.isSeq():
        return [_plain(node.at(k)) for k in range(node.size())]
    return node.string() if node.isString() else node.real()


def _parse_ini(text: str) -> dict[str, Any]:
    """Read ost.txt of camera_calibration: a line with a name, then lines with its numbers."""
    values: dict[str, list[float]] = {}
    name = camera = ""
    for line in text.splitlines():
        words = line.partition("#")[0].split()
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            section = re.fullmatch(r"\[(.*)\]", " ".join(words))
            name = "" if section else " ".join(words)
            camera = section.group(1) if section and section.group(1) != "image" else camera
        else:
            values.setdefault(name, []).extend(numbers)
    if len(values.get("distortion", ())) == 4:
        what = "it has 4 coefficients and names no model"
        raise ValueError(f"{what}: give the ost.yaml beside it, which names plumb_bob or equidistant")
    flat = {key: numbers[0] if len(numbers) == 1 else numbers for key, numbers in values.items()}
    return {
        **flat,
        "projection matrix": flat.get("projection"),
        "r": flat.get("rectification"),
        "camera_name": camera,
    }


def _describe(data: Any, name: str = "", depth: int = 0) -> Iterator[CameraDescription]:
    """Find the descriptions in plain mappings, which may be nested.

    Args:
        data: parsed YAML.
        name: key of the mapping.
        depth: nesting depth of the mapping.

    Raises:
        ValueError: a camera that cannot be used.
    """
    if not isinstance(data, Mapping) or depth > _MAX_DEPTH:
        return
    flat = {re.sub(r"[^a-z0-9]", "", str(key).lower()): value for key, value in data.items()}
    matrices = {side: _camera_matrix(flat, side) for side in _SIDES}
    for side, K in matrices.items():
        if K is not None:
            label = str(flat.get("cameraname") or name) + side
            yield _one_camera(flat, K, side, label if not label.isdigit() else f"cam{label}")
    if all(K is None for K in matrices.values()):
        for key, value in data.items():
            yield from _describe(value, str(key), depth + 1)


def _camera_matrix(flat: Mapping[str, Any], side: str) -> Array | None:
    """Return the camera matrix (3, 3) px of a mapping; None without one."""
    for key in _MATRIX:
        for numbers in (_numbers(flat.get(key + side)), _numbers(flat.get(side + key))):
            if numbers is not None and len(numbers) == 9:
                return np.reshape(numbers, (3, 3))
    if side:
        return None
    # FAST-LIVO2, then Kalibr.
    values = _numbers([flat.get(f"cam{key}") for key in ("fx", "fy", "cx", "cy")])
    if "intrinsics" in flat:
        values = _numbers(flat["intrinsics"])
        if values is not None and len(values) != 4:
            what = f"camera_model {flat.get('cameramodel')!r} with {len(values)} intrinsics cannot be used"
            raise ValueError(f"{what}: calibrate it as pinhole with radtan or equidistant")
    if values is None or not np.isfinite(values).all():
        return None
    fx, fy, cx, cy = values
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _one_camera(flat: Mapping[str, Any], K: Array, side: str, name: str) -> CameraDescription:
    coefficients = _first_numbers(flat, [key + side for key in _COEFFICIENTS])
    if coefficients is None and side:
        coefficients = _first_numbers(flat, [side + key for key in _COEFFICIENTS])
    if coefficients is None and "camfx" not in flat:
        raise ValueError("it has a camera matrix, but no distortion_coefficients")
    if coefficients is None:
        # FAST-LIVO2 has a key for each.
        singles = (flat.get(key) for key in chain(*((f"camd{k}", f"k{k + 1}") for k in range(5))))
        coefficients = [float(value) for value in singles if isinstance(value, int | float)]
    P = _first_numbers(flat, _PROJECTION) or []
    turn = _first_numbers(flat, _RECTIFICATION) or []
    R = np.reshape(turn, (3, 3)) if len(turn) == 9 and any(turn) else np.eye(3)
    size = _first_numbers(flat, _SIZE) or [_number(flat, keys) for keys in (_WIDTH, _HEIGHT)]
    roi = flat.get("roi")
    roi = roi if isinstance(roi, Mapping) else {}
    binning = [max(int(flat.get(key) or 1), 1) for key in ("binningx", "binningy")]
    return CameraDescription(
        K,
        tuple(coefficients),
        _model_name(flat),
        (int(size[0]), int(size[1])),
        np.reshape(P, (3, 4)) if len(P) == 12 else np.zeros((3, 4)),
        float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))),
        (binning[0], binning[1]),
        (
            int(roi.get("x_offset") or 0),
            int(roi.get("y_offset") or 0),
            int(roi.get("width") or 0),
            int(roi.get("height") or 0),
        ),
        name,
        str(flat.get("rostopic") or ""),
    )


def _model_name(flat: Mapping[str, Any]) -> str:
    """Return the distortion model's name as stated; by default radtan, OpenCV's order of coefficients."""
    if any(str(flat.get(key, "")).lower() in ("1", "1.0", "true", "yes") for key in _FISHEYE):
        return "equidistant"
    stated = next((flat[key] for key in _MODEL if isinstance(flat.get(key), str)), "radtan")
    return _MODELS.get(re.sub(r"[^a-z0-9]", "", stated.lower()), stated)


def _number(flat: Mapping[str, Any], keys: Sequence[str]) -> float:
    return next((float(flat[key]) for key in keys if flat.get(key) is not None), 0.0)


def _first_numbers(flat: Mapping[str, Any], keys: Sequence[str]) -> list[float] | None:
    """Return the numbers of the first key that has any; None without."""
    lists = (_numbers(flat.get(key)) for key in keys)
    return next((numbers for numbers in lists if numbers is not None), None)


def _numbers(value: Any) -> list[float] | None:
    """List the numbers of a matrix in OpenCV's or ROS's form, or of nested lists; None for others."""
    value = value.get("data") if isinstance(value, Mapping) else value
    if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray):
        return None
    try:
        return [float(number) for number in np.ravel(np.array(value, dtype=np.float64))]
    except (ValueError, TypeError):
        return None
