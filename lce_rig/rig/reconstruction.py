"""A channel's block for image reconstruction from its events."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from lce_rig.core.limits import MAX_EVENTS
from lce_rig.rig.settings import Settings, problem


class ReconstructionSettings(Settings):
    """Settings of image reconstruction from a channel's events.

    Attributes:
        method: a recurrent network, or the event map: sums of polarities, for comparison.
        model: ONNX file of another network than the shipped one; absolute in a loaded profile.
        window_s: windows of this duration; if neither is given, the rate of events decides.
        window_events: windows of this number of events.
    """

    method: Literal["network", "map"] = "network"
    model: Annotated[str, Field(min_length=1, max_length=4096)] | None = None
    window_s: Annotated[float, Field(ge=0.001, le=10)] | None = None
    window_events: Annotated[int, Field(ge=1, le=MAX_EVENTS)] | None = None

    @model_validator(mode="after")
    def _is_consistent(self) -> "ReconstructionSettings":
        if self.window_s is not None and self.window_events is not None:
            raise problem("window_s and window_events exclude each other", "window_events")
        if self.model is not None and self.method == "map":
            raise problem("the event map needs no network", "model")
        return self

    def located(self, folder: Path) -> "ReconstructionSettings":
        """Make the model's path absolute; a relative one starts at the profile's folder."""
        if self.model is None:
            return self
        path = (folder / Path(self.model).expanduser()).resolve()
        return self.model_copy(update={"model": str(path)})
