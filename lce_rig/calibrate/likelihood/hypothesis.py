"""Likelihood of one camera's captures under assumptions other than those of its estimate.

For judging an estimate. Every placement has full weight, and the images' errors begin at their usual
levels. In the estimate, captures that contradict each other lose weight and raise the noise by which they are
judged. No unknown is held, and priors have no tails.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.likelihood.fit import (
    JointEstimate,
    approach,
    extrinsics_by_unknowns,
    fit_levels,
    settle,
    stack_captures,
    weigh_placements,
)
from lce_rig.calibrate.likelihood.images import StackedImages, image_rows
from lce_rig.calibrate.likelihood.layout import Layout, State
from lce_rig.calibrate.likelihood.levels import LOG_SIGMA, OF_IMAGES, Levels, Priors
from lce_rig.calibrate.likelihood.model import Reduced, Terms, assemble, linearise
from lce_rig.calibrate.observations import group_poses
from lce_rig.calibrate.session_lens import SessionLens
from lce_rig.core.geometry import Array, exp_so3, invert, perturb, pose, rotation_angle
from lce_rig.core.results import Observation

# Number of steps of captures' own poses under given extrinsics, maximum number of steps of all unknowns, and
# the length that ends these, in standard deviations.
_OWN_STEPS, _STEPS, _SHORT = 4, 80, 0.5
_LEVEL_ROUNDS = 8
_TURNS = pose(exp_so3(np.radians([0, 90, 180, 270])[:, None] * np.eye(3)[2]), np.zeros((4, 3)))


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """F captures of one camera under M mountings, at the optimum.

    Attributes:
        terms: linearised at the optimum; images of each mounting form a camera of their own. The camera
            that is the base comes last.
        images: images of all mountings.
        levels: noise levels.
        priors: prior standard deviations of the constant errors.
        captures: (F,) names, sorted.
        mounting: (F,) number of each capture's mounting.
        T_lidar_board: (F, 4, 4) poses of the boards by the scans alone.
        is_further: (F,) True for captures that the estimate does not use.
    """

    terms: Terms
    images: StackedImages
    levels: Levels
    priors: Priors
    captures: tuple[str, ...]
    mounting: NDArray[np.intp]
    T_lidar_board: Array
    is_further: NDArray[np.bool_]

    @property
    def state(self) -> State:
        """All unknowns at the optimum."""
        return self.terms.state

    @cached_property
    def reduced(self) -> Reduced:
        """The normal equations."""
        return assemble(self.terms, self.levels, self.priors)

    @property
    def depths_m(self) -> Array:
        """(F,) depths of the boards before the camera."""
        T_cam_board = self.state.T_cam_lidar[self.mounting] @ self.state.T_lidar_board
        return np.asarray(T_cam_board[:, 2, 3])

    @property
    def T_in_use(self) -> Array:
        """(4, 4) extrinsics of the mounting with the most captures, as used with the camera's intrinsics."""
        most = int(np.bincount(self.mounting).argmax())
        moves = extrinsics_by_unknowns(self.terms) @ self.state.z
        return perturb(self.state.T_cam_lidar[most], moves[most])

    @property
    def planes_apart_m(self) -> float:
        """Rms distance of the boards' centres in images from their planes in scans."""
        rows = np.concatenate([each[:, :3, -1] for each in self.terms.image_rows])
        normals = np.concatenate([each.T_cam_board[:, :3, 2] for each in self.terms.images])
        return float(np.sqrt(np.mean(np.einsum("pi,pi->p", rows, normals) ** 2)))

    @cached_property
    def deviance(self) -> float:
        """-2 ln p(captures, levels of the images) at the optimum, up to a constant."""
        off = [np.log(self.levels.ratio(name)) / LOG_SIGMA[name] for name in OF_IMAGES]
        return self.reduced.minus_2_log_likelihood + float(np.sum(np.square(off)))

    @cached_property
    def with_fitted_noise(self) -> "Hypothesis":
        """Return a copy with the levels of the images' errors fitted at the present expansion point."""
        usual = self.levels.with_usual_images
        fitted = fit_levels(self.terms, self.levels, usual, self.priors, _LEVEL_ROUNDS, OF_IMAGES)
        return replace(self, levels=fitted)

    def with_noise_up_to(self, ratio: float) -> "Hypothesis":
        """Return a copy whose images' errors have at most this ratio to their usual levels."""
        usual = self.levels.with_usual_images
        most = {name: min(getattr(self.levels, name), ratio * getattr(usual, name)) for name in OF_IMAGES}
        return replace(self, levels=replace(self.levels, **most))

    def mounting_of(self, members: NDArray[np.bool_]) -> Array:
        """Find the extrinsics (4, 4) that bring the boards of scans closest to those of images.

        Args:
            members: (F,) captures.
        """
        images = self.images.select(members[self.images.capture])
        errors = self.state.z[self.state.layout.errors(0)]
        most = int(np.bincount(self.mounting[members]).argmax())
        T, weights = self.state.T_cam_lidar[most], np.linalg.inv(images.total_cov(self.levels))
        for _ in range(_OWN_STEPS):
            rows = image_rows(images, T, self.T_lidar_board, errors)
            by_camera, residual = rows[:, :, :6], rows[:, :, -1]
            H = np.einsum("pia,pij,pjb->ab", by_camera, weights, by_camera)
            g = np.einsum("pia,pij,pj->a", by_camera, weights, residual)
            T = perturb(T, -np.linalg.solve(H, g))
        return np.asarray(T)

    def under(
        self,
        priors: Priors | None = None,
        mounting: NDArray[np.intp] | None = None,
        T_cam_lidar: Array | None = None,
    ) -> "Hypothesis":
        """Find the optimum under other assumptions.

        Args:
            priors: prior standard deviations of the constant errors; the present ones by default.
            mounting: (F,) of the captures; the present one by default.
            T_cam_lidar: (M, 4, 4) initial extrinsics of each mounting.
        """
        old, terms, priors = self.state, self.terms, priors or self.priors
        if mounting is None or T_cam_lidar is None:
            mounting = self.mounting
        else:
            shown = mounting[self.images.capture]
            split = [self.images.select(shown == m) for m in range(len(T_cam_lidar))]
            of_base = [] if old.layout.base is None else [terms.images[old.layout.base]]
            lens_of = [0] * len(split) + [1] * len(of_base)
            n_optics = [each.turns.shape[1] for each in (self.images, *of_base)]
            base = len(split) if of_base else None
            layout = Layout(n_optics, old.layout.n_rings, lens_of, base)
            T_cam_lidar = np.array([*T_cam_lidar, *([np.eye(4)] if of_base else [])])
            split += of_base
            # A wrong mounting has displaced boards from their positions in the scans, and constant errors.
            own_shift_m, z = np.zeros(len(mounting)), np.zeros(layout.z.size)
            state = State(layout, T_cam_lidar, self.T_lidar_board, own_shift_m, z)
            terms = linearise(terms.scans, split, terms.board, state, terms.trust)
            terms = approach(terms, self.levels, priors)
        terms = settle(terms, self.levels, priors, _STEPS, _SHORT)
        return replace(self, terms=terms, priors=priors, mounting=mounting)


def at_full_weight(
    joint: JointEstimate,
    observations: Sequence[Observation],
    lenses: Sequence[SessionLens | None],
    camera: int = 0,
) -> Hypothesis:
    """State the assumptions of an estimate for the captures of one camera.

    Args:
        joint: the estimate.
        observations: observations of the camera, also of captures that the estimate does not use.
        lenses: lenses of the camera, and of one that is the base; None if exact.
        camera: index of the camera.
    """
    board, T_cam_lidar = joint.terms.board, joint.state.T_cam_lidar[camera]
    names, scans, images = stack_captures([observations], board, lenses, None)
    base = None if len(images) == 1 else 1
    T_cameras = np.stack([T_cam_lidar, *([] if base is None else [np.eye(4)])])
    by_scan = {o.capture: _nearest_turn(o, T_cam_lidar) for o in observations}
    starts = {name: (T, 0.0) for name, T in by_scan.items()}
    settled = zip(joint.state.T_lidar_board, joint.state.own_shift_m.tolist(), strict=True)
    starts |= dict(zip(joint.captures, settled, strict=True))
    T_lidar_board = np.array([starts[name][0] for name in names])
    own_shift_m = np.array([starts[name][1] for name in names])
    layout = Layout([each.turns.shape[1] for each in images], len(scans.rings), base=base)
    z = joint.state.common_to(layout, joint.terms.scans.rings, scans.rings)
    state = State(layout, T_cameras, T_lidar_board, own_shift_m, z)
    trust = weigh_placements(group_poses(T_lidar_board), images)
    terms = linearise(scans, images, board, state, trust)
    levels, priors = joint.levels.with_usual_images, replace(joint.priors, freedoms=np.inf)
    for _ in range(_OWN_STEPS):
        own = -assemble(terms, levels, priors).own_steps[:, :, -1]
        terms = linearise(scans, images, board, terms.state.moved(np.zeros(layout.z.size), own), trust)
    alike = np.zeros(len(names), dtype=np.intp)
    is_further = np.array([name not in joint.captures for name in names])
    T_by_scan = np.array([by_scan[name] for name in names])
    return Hypothesis(terms, images[0], levels, priors, names, alike, T_by_scan, is_further).under()


def _nearest_turn(observation: Observation, T_cam_lidar: Array) -> Array:
    """Rotate the scan's pose about the plate's normal by the multiple of 90 deg nearest to the image's."""
    expected = invert(T_cam_lidar) @ observation.pose.T_cam_board
    turned = observation.surface.T_lidar_board @ _TURNS
    return np.asarray(turned[int(np.argmin(rotation_angle(turned[:, :3, :3], expected[:3, :3])))])
