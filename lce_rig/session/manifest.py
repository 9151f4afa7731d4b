"""The schema of a capture's manifest; reading is strict, as a session may come from elsewhere."""

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from lce_rig.core.limits import MAX_FILE_BYTES, MAX_TIME_NS, describe
from lce_rig.rig.settings import Name

_Stamp = Annotated[int, Field(ge=-MAX_TIME_NS, le=MAX_TIME_NS)] | None
_Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class _Record(BaseModel):
    # Keys of later versions are ignored.
    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)


class _FileEntry(_Record):
    file: Annotated[str, Field(max_length=255)]
    bytes: Annotated[int, Field(ge=0, le=MAX_FILE_BYTES)]
    sha256: _Sha256
    host_ns: _Stamp


class ImageEntry(_FileEntry):
    """An image's file."""

    kind: Literal["image"]
    camera: Name
    channel: Name
    stamp_ns: _Stamp


class ScanEntry(_FileEntry):
    """A scan's file."""

    kind: Literal["scan"]
    lidar: Name
    stamp_ns: _Stamp


class EventsEntry(_FileEntry):
    """The file of a range of events."""

    kind: Literal["events"]
    camera: Name
    channel: Name
    first_ns: _Stamp
    last_ns: _Stamp


Entry = ImageEntry | ScanEntry | EventsEntry


class Manifest(_Record):
    """The whole file; `meta` holds any JSON of the collector."""

    format_version: Annotated[int, Field(ge=1)]
    content_sha256: str
    files: Annotated[list[Annotated[Entry, Field(discriminator="kind")]], Field(max_length=1000)]
    meta: dict[str, Any]

    @property
    def images(self) -> list[ImageEntry]:
        """Entries of images."""
        return [entry for entry in self.files if isinstance(entry, ImageEntry)]

    @property
    def scans(self) -> list[ScanEntry]:
        """Entries of scans."""
        return [entry for entry in self.files if isinstance(entry, ScanEntry)]

    @property
    def events(self) -> list[EventsEntry]:
        """Entries of stretches of events."""
        return [entry for entry in self.files if isinstance(entry, EventsEntry)]

    @model_validator(mode="after")
    def _sensors_are_named_once(self) -> "Manifest":
        names = list(self._sensors())
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"{name} is named twice")
        return self

    def _sensors(self) -> Iterator[str]:
        yield from (f"image of {entry.camera}.{entry.channel}" for entry in self.images)
        yield from (f"scan of {entry.lidar}" for entry in self.scans)
        yield from (f"events of {entry.camera}" for entry in self.events)


def parse_manifest(document: Any) -> Manifest:
    """Validate a manifest.

    Raises:
        ValueError: the first thing found wrong, with its key.
    """
    try:
        return Manifest.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"])
        given = "" if first["type"] in ("missing", "value_error") else f"; {describe(first['input'])} given"
        what = first["msg"].removeprefix("Value error, ").replace("Input should", "must")
        raise ValueError(f"{describe(key)[1:-1] + ': ' if key else ''}{what}{given}") from None
