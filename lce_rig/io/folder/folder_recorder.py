"""Recording of all sensor data, as files in one folder that other programs read."""

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from lce_rig.core.data import Events, Sample
from lce_rig.core.errors import SourceError
from lce_rig.io.events.aedat4_writer import Aedat4Writer
from lce_rig.io.ros.bag_recorder import BagRecorder, not_writable
from lce_rig.rig import Rig
from lce_rig.timing.rig_time import event_channel

BAG_NAMES = {1: "recording.bag", 2: "recording"}
"""By the version of ROS; a ROS 2 bag is a folder."""


class FolderRecorder:
    """A new folder with a bag of all samples and an AEDAT4 file of each camera's events; a context manager.

    Attributes:
        folder: what it fills: recording.bag or, for ROS 2, recording/; events.aedat4, or CAMERA.aedat4 for
            each where several cameras have events.
        bag: the bag's path.
    """

    def __init__(self, folder: Path, rig: Rig, ros: int = 1) -> None:
        """Make the folder.

        Raises:
            SourceError: it is there already, or cannot be made.
        """
        self.folder = folder
        self.bag = folder / BAG_NAMES[ros]
        self._event_cameras = [name for name in rig.cameras if event_channel(rig, name)]
        self._aedat4: dict[str, Aedat4Writer] = {}
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            hint = "Name another folder: recordings are never overwritten."
            raise SourceError(f"{folder} exists already", hint) from None
        except OSError as error:
            raise not_writable(folder, error) from error
        self._open = ExitStack()
        self._recorder = self._open.enter_context(BagRecorder(self.bag, rig))

    def write(self, sample: Sample) -> None:
        """Add a sample to every file that holds its kind.

        Raises:
            SourceError: the disk is full, or the rig lacks the sensor.
        """
        self._recorder.write(sample)
        if isinstance(sample, Events):
            is_only = self._event_cameras == [sample.sensor]
            path = self.folder / ("events.aedat4" if is_only else f"{sample.sensor}.aedat4")
            try:
                if sample.sensor not in self._aedat4:
                    writer = Aedat4Writer(path, (sample.width_px, sample.height_px), sample.sensor)
                    self._aedat4[sample.sensor] = self._open.enter_context(writer)
                self._aedat4[sample.sensor].write(sample)
            except OSError as error:
                raise not_writable(path, error) from error

    def close(self) -> None:
        """Finish the files; does nothing the second time.

        Raises:
            SourceError: the disk is full.
        """
        self.__exit__(None, None, None)

    def __enter__(self) -> "FolderRecorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._open.__exit__(kind, error, trace)
        except OSError as failure:
            raise not_writable(self.folder, failure) from failure
