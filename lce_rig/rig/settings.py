"""Base class and shared types of the profile's settings."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

_NAME = r"^[a-z][a-z0-9_]*$"
_RIG_NAME = r"^[a-z0-9][a-z0-9_-]*$"
_ROBOT = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"
_FRAME = r"^[A-Za-z][A-Za-z0-9_/-]*$"
_TOPIC = r"^/?[A-Za-z][A-Za-z0-9_/]*$"

# The meaning of each pattern, for errors.
PATTERNS = {
    _NAME: "a name has lower-case letters, digits and _ and begins with a letter",
    _RIG_NAME: "a rig's name has lower-case letters, digits, - and _",
    _ROBOT: "a robot's name has letters, digits, ., - and _ and begins with a letter or digit",
    _FRAME: "a frame has letters, digits, _, - and / and begins with a letter",
    _TOPIC: "a topic has letters, digits, _ and /",
}

Name = Annotated[str, Field(pattern=_NAME, max_length=64)]
RobotName = Annotated[str, Field(pattern=_ROBOT, max_length=64)]
RigName = Annotated[str, Field(pattern=_RIG_NAME, max_length=64)]
FrameName = Annotated[str, Field(pattern=_FRAME, max_length=128)]
TopicName = Annotated[str, Field(pattern=_TOPIC, max_length=256)]
# Bounds of all figures of a rig, so that their squares and quotients do not overflow.
_LARGEST = 1e6
Text = Annotated[str, Field(max_length=1000)]
Positive = Annotated[float, Field(ge=1 / _LARGEST, le=_LARGEST)]
NotNegative = Annotated[float, Field(ge=0, le=_LARGEST)]
Figure = Annotated[float, Field(ge=-_LARGEST, le=_LARGEST)]
Row = tuple[Figure, Figure, Figure]
# Standard deviation of a length, m; larger figures are in millimetres, or a sensor is broken.
Deviation = Annotated[float, Field(ge=0, le=0.2)]
Rate = Annotated[float, Field(ge=0.1, le=10_000)]


class Settings(BaseModel):
    """A block of a profile: immutable, no unknown keys, no infinities."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _has_no_truth_values(cls, data: Any) -> Any:
        """Refuse `yes` and `no`, which would become 1 and 0; no setting is a truth value."""
        if not isinstance(data, dict):
            return data
        for key, value in data.items():
            if any(isinstance(item, bool) for item in (value if isinstance(value, list) else [value])):
                raise problem("a truth value (true, yes, on, false, no, off) is not allowed", str(key))
        return data


def require(is_met: bool, what: str, key: str = "") -> None:
    """Raise the error `problem` unless a condition is met."""
    if not is_met:
        raise problem(what, key)


def problem(what: str, key: str = "") -> PydanticCustomError:
    """Build the error of a check across several keys.

    Args:
        what: the fault, with its figures.
        key: the key at fault, relative to the block that is checked; empty for the block itself.
    """
    return PydanticCustomError("profile", "{what}", {"what": what, "key": key})
