"""Small sound sessions, profiles and results."""

import hashlib
import json
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fuzzing.samples import CAMERA, LIDAR, SIZE, Samples, small_rig
from fuzzing.seeds_of_recordings import Files
from lce_rig.core.diagnostics import Diagnostics
from lce_rig.core.findings import Refusal
from lce_rig.core.results import Calibration, Certificate, ImageBoard, Metrics, PointUncertainty
from lce_rig.rig import find_profile
from lce_rig.session import Session

CAPTURE = "s/captures/000000"
_JOURNAL = (
    '{"event": "created", "made_by": "lce-rig 1", "rig": "fuzz", "time": "2026-01-01T00:00:00.000+00:00"}\n'
    '{"capture": "000000", "event": "captured", "time": "2026-01-01T00:00:01.000+00:00"}\n'
    '{"capture": "000001", "event": "captured", "time": "2026-01-01T00:00:02.000+00:00"}\n'
)


def files_in(folder: Path) -> Files:
    """Read every file below a folder."""
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file() and file.name != ".lock"
    }


def session(samples: Samples) -> list[Files]:
    """A session of two captures, the first with events; images without a board, as detection takes long."""
    blank = np.add.outer(np.arange(SIZE[1]), np.arange(SIZE[0])).astype(np.uint8)
    with tempfile.TemporaryDirectory() as folder:
        with Session.create(Path(folder) / "s", samples.rig) as writer:
            for k in range(2):
                events = [samples.events] if k == 0 else []
                meta = {"source": {"label": "00000.png + 00000.pcd", "key": "00"}, "k": k}
                image = replace(samples.images[k], pixels=blank + np.uint8(k))
                writer.add_capture([image], [samples.scans[k].select(slice(0, 100))], meta, events)
        files = files_in(Path(folder))
    return [files | {"s/journal.jsonl": _JOURNAL.encode()}]


def resealed(files: Files) -> Files:
    """Let the manifest of the first capture vouch for its files as they are now."""
    manifest = json.loads(files[f"{CAPTURE}/meta.json"])
    for entry in manifest["files"]:
        data = files[f"{CAPTURE}/{entry['file']}"]
        entry |= {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    return files | {f"{CAPTURE}/meta.json": json.dumps(manifest).encode()}


def cache_entries(_samples: Samples) -> list[Files]:
    """A session's cache: a board in an image, one in a scan, and a refusal."""
    from lce_rig.core.results import LidarBoard
    from lce_rig.detect.detection import to_arrays
    from lce_rig.session import cache as stored

    rng = np.random.default_rng(0)
    items: Iterable[Any] = (
        _filled(ImageBoard, rng),
        [_filled(LidarBoard, rng)],
        Refusal("image.no_events"),
    )
    seeds = []
    for item in items:
        with tempfile.TemporaryDirectory() as folder:
            stored.store(Path(folder) / "a.npz", to_arrays(item), {"k": 1})
            seeds.append({"a.npz": (Path(folder) / "a.npz").read_bytes()})
    return seeds


def _filled(kind: type, rng: np.random.Generator) -> Any:
    """Fill a detection's class by the types of its fields."""
    import dataclasses

    values: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        name = str(field.type)
        if "NDArray" in name or "Array" in name:
            values[field.name] = rng.normal(size=(4, 3))
        elif "Mapping" in name or "dict" in name:
            values[field.name] = {"a": 1.0}
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            values[field.name] = "x" if "str" in name else 1 if "int" in name else 0.5
    return kind(**values)


def profile_text(_samples: Samples) -> list[Files]:
    """The shipped profiles."""
    return [{"rig.yaml": find_profile(name).read_bytes()} for name in ("rles", "rlfs", "sss")]


def profile_json(_samples: Samples) -> list[Files]:
    """The shipped profiles as JSON, which is YAML."""
    return [
        {"rig.yaml": json.dumps(yaml.safe_load(find_profile(name).read_bytes())).encode()}
        for name in ("rles", "rlfs", "sss")
    ]


@cache
def calibration() -> Calibration:
    """Build a plausible result of the small rig."""
    T = np.asarray(small_rig().nominal_extrinsics[0].to_matrix())
    figures = Metrics(0.009, 0.0085, 0.2)
    return Calibration(
        camera=CAMERA,
        channels=("frames",),
        lidar=LIDAR,
        T_cam_lidar=T,
        cov=np.diag([1e-6, 1e-6, 4e-6, 1e-8, 4e-8, 1e-8]),
        certificate=Certificate(True, 1.25e-9),
        metrics=figures,
        n_captures=4,
        n_detected=3,
        captures_used=("000000", "000002"),
        captures_refused={"000003": Refusal("pair.no_candidate")},
        verdict="pass",
        diagnostics=Diagnostics(n_placements=4.0, fit_plane_rms_m=1 / 300),
        uncertainty=_uncertainty(),
    )


def _uncertainty() -> tuple[PointUncertainty, ...]:
    import dataclasses

    values = {f.name: 1.0 for f in dataclasses.fields(PointUncertainty)}
    return (PointUncertainty(**values),) if values else ()  # type: ignore[arg-type]


def result(_samples: Samples) -> list[Files]:
    """A result.json."""
    from lce_rig.export.result import result_text

    return [{"result.json": result_text("fuzz", [calibration()], {"rig.yaml": "0" * 64}).encode()}]


def reference(_samples: Samples) -> list[Files]:
    """A matrix at the top, and one in a list of pairs."""
    T = calibration().T_cam_lidar.tolist()
    pairs = [{"camera": CAMERA, "lidar": LIDAR, "T_cam_lidar": T}]
    return [
        {"a.json": json.dumps(each).encode()} for each in ({"T_cam_lidar": T}, {"pairs": pairs, "seed": 0})
    ]


def truth(samples: Samples) -> list[Files]:
    """A simulated session with its truth.json."""
    document = {"seed": 0, **json.loads(reference(samples)[1]["a.json"])}
    return [session(samples)[0] | {"s/truth.json": json.dumps(document).encode()}]


def exports(_samples: Samples) -> list[Files]:
    """Every file of a result."""
    from lce_rig.export import export

    with tempfile.TemporaryDirectory() as folder:
        usual = ("extrinsics", "urdf", "camera_info", "static_tf", "kalibr", "autoware")
        export([calibration()], small_rig(), Path(folder), formats=(*usual, "ros2_launch", "koide3"))
        return [files_in(Path(folder))]


def network(_samples: Samples) -> list[Files]:
    """The shipped reconstruction network."""
    from lce_rig.detect.events.reconstruct.model import model_bytes

    return [{"a.onnx": model_bytes(None)}]
