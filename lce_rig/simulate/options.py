"""Options of a simulated rig; defaults come from data sheets and real recordings."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from lce_rig.core.data_sheets import VLP_16, DataSheet
from lce_rig.core.geometry import Array
from lce_rig.simulate.surfaces import Mesh

Carrier = Literal["stand", "person", "none"]
Motion = Literal["still", "moving"]
Part = tuple[str, Mesh, str, Array]
"""Name, mesh in the room's frame, name of the material and T_room_part (4, 4) of a body."""


@dataclass(frozen=True)
class LidarNoise:
    """Errors of a spinning LiDAR; the defaults are those of a VLP-16.

    Attributes:
        range_sigma_m: white noise of each range.
        range_offset_m: constant offset of all ranges.
        laser_sigma_m: spread of the lasers' constant offsets (real ones repeat to +-10 mm).
        dark_bias_m: excess range of a return of reflectivity 0 over one of reflectivity 1.
        weak_bias_m: excess range of the weakest returns (intensity 0; none from intensity 30 on).
        rim_spread_rad: half-width of the azimuth error of points within a footprint of the board's border.
        edge_growth_m: width of the beam's rim beyond divergence and exit; with it the returns
            reach 9-10 mm beyond a board's border, as they do on real recordings.
        divergence_rad: full opening of the beam, horizontal and vertical.
        exit_size_m: size of the beam at the sensor's exit, horizontal and vertical.
        dropout: probability that a return is lost.
        range_step_m: resolution of ranges.
        is_quantised: whether ranges come in such steps and azimuths in steps of 0.01 deg.
    """

    range_sigma_m: float = VLP_16.range_sigma_m
    range_offset_m: float = 0.0
    laser_sigma_m: float = VLP_16.laser_bias_sigma_m
    dark_bias_m: float = 0.001
    weak_bias_m: float = 0.010
    rim_spread_rad: float = 0.0
    edge_growth_m: float = VLP_16.rim_m
    divergence_rad: tuple[float, float] = VLP_16.divergence_rad
    exit_size_m: tuple[float, float] = VLP_16.exit_m
    dropout: float = 0.002
    range_step_m: float = VLP_16.range_step_m
    is_quantised: bool = True

    @classmethod
    def of(cls, sheet: DataSheet) -> "LidarNoise":
        """Read the errors from a data sheet; the range error by brightness is a VLP-16's for all models."""
        return cls(
            range_sigma_m=sheet.range_sigma_m,
            laser_sigma_m=sheet.laser_bias_sigma_m,
            edge_growth_m=sheet.rim_m,
            divergence_rad=sheet.divergence_rad,
            exit_size_m=sheet.exit_m,
            range_step_m=sheet.range_step_m,
        )


@dataclass(frozen=True)
class CameraNoise:
    """Errors of a camera.

    Attributes:
        blur_px: sigma of the lens's point spread.
        full_well_e: electrons at full scale; sets the shot noise.
        read_noise_e: electrons of noise in the dark.
        vignetting: loss of light at the image's corners, 0..1.
    """

    blur_px: float = 0.6
    full_well_e: float = 9000.0
    read_noise_e: float = 8.0
    vignetting: float = 0.3


@dataclass(frozen=True)
class EventNoise:
    """Errors of an event camera; the defaults are those of a DAVIS346 indoors.

    Attributes:
        threshold_on, threshold_off: mean change of ln(intensity) that makes an event.
        threshold_sigma: spread of the pixels' own thresholds, fixed for a session.
        event_sigma: spread of one pixel's threshold from event to event.
        cutoff_hz: bandwidth of a pixel that sees full white; darker ones are slower. inf for no limit.
        refractory_s: dead time of a pixel after each event.
        leak_hz: rate of ON events of a pixel without any change.
        noise_hz: further events of each pixel, of either polarity, twice as many in the dark.
        hot_share: share of the pixels that fire all the time, at 10 to 300 Hz.
        dark_radiance: apparent radiance of a black pixel: stray light in the lens, and dark current.
    """

    threshold_on: float = 0.30
    threshold_off: float = 0.25
    threshold_sigma: float = 0.03
    event_sigma: float = 0.03
    cutoff_hz: float = 250.0
    refractory_s: float = 3e-4
    leak_hz: float = 0.05
    noise_hz: float = 0.06
    hot_share: float = 2e-4
    dark_radiance: float = 0.03


@dataclass(frozen=True)
class HandMotion:
    """The motion of a hand-held board.

    Attributes:
        speed_mps: range of the board's mean speed, redrawn for each capture; from the slowest that gives
            events to the fastest at which a held board is still detected.
        turn_deg_s: maximum rotation rate at the greatest speed.
        tremor_m: amplitude of the hand's trembling, 5 to 9 Hz.
        carry_mps: maximum speed between two placements of a recording.
        rest_s: time of rest at each placement of a recording.
    """

    speed_mps: tuple[float, float] = (0.05, 0.3)
    turn_deg_s: float = 12.0
    tremor_m: float = 3e-4
    carry_mps: float = 0.6
    rest_s: float = 1.0


@dataclass(frozen=True)
class SimulationOptions:
    """The content of a simulated session and the errors of its sensors.

    Attributes:
        carrier: support of the board: a stand, a person or none.
        lidar: errors of all LiDARs; None for those of each one's data sheet.
        camera: the cameras' errors.
        distance_m: range of the board's distance from the camera; no board is placed where the LiDAR would
            see less than four fifths of the plate (a diamond of 1 m nearer than about 1.4 m).
        roll_deg: mean and half-width of the board's rotation in its plane, 0 = upright, 45 = a diamond.
        decoys: bodies instead of the room's furniture; None keeps the furniture.
        truth_rotation_deg, truth_translation_m: maximum distance of the true extrinsics from the profile's
            nominal ones; never more than 0.8 of the profile's tolerances.
        mounting_seed: seed of true extrinsics and sensor errors; None for the session's seed.
            Sessions of one mounting seed are of one rig, with other placements, room and noise.
        motion: whether the board is held still or moved by hand; only a moving one generates events.
        hand: movement of the person's hand.
        events: errors of cameras with a channel of events; their optics are `camera`'s.
        events_span_s: time that a capture's events cover before and after a scan's timestamp.
        exposure_s: exposure time of a moving board's images.
        frame_every_s: interval between the images of a camera that runs freely while the board moves.
        frame_offset_s, event_offset_s: lead of the timestamps of images and of events over the LiDAR's clock,
            which is the rig's.
    """

    carrier: Carrier = "stand"
    lidar: LidarNoise | None = None
    camera: CameraNoise = field(default_factory=CameraNoise)
    distance_m: tuple[float, float] = (1.2, 4.0)
    roll_deg: tuple[float, float] = (45.0, 15.0)
    decoys: Sequence[Part] | None = None
    truth_rotation_deg: float = 2.0
    truth_translation_m: float = 0.02
    mounting_seed: int | None = None
    motion: Motion = "still"
    hand: HandMotion = field(default_factory=HandMotion)
    events: EventNoise = field(default_factory=EventNoise)
    events_span_s: tuple[float, float] = (1.2, 0.15)
    exposure_s: float = 0.008
    frame_every_s: float = 0.05
    frame_offset_s: float = 0.0
    event_offset_s: float = 0.0

    def mounting_of(self, seed: int) -> int:
        """Return the seed of the mounting in the session of a seed."""
        return seed if self.mounting_seed is None else self.mounting_seed

    @classmethod
    def for_rig(cls, name: str, motion: Motion = "still") -> "SimulationOptions":
        """Choose the content of recordings of the rig of this name, with a board held still or moving."""
        if name.startswith("sss"):
            # The paper's simulated rig: a board hung in the air, and exactly known extrinsics.
            return cls(carrier="none", motion=motion, truth_rotation_deg=0.0, truth_translation_m=0.0)
        return cls(carrier="person" if name.startswith("rles") else "stand", motion=motion)
