"""The wide-baseline start: every camera's place in one world before tracking begins.

The classical default needs no network. Each camera's own video gives a map of its own (easy); what remains
is one similarity per camera, over-determined by matches pooled over the whole video. Hypotheses for it are
believed only after dense warping over many instants, cameras that nothing connects stay apart, and a joint
bundle adjustment has the last word.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.frontend.dense_flow import DenseFlow
from mvdyn_gtsam.frontend.grid_flow import OneWayFlow
from mvdyn_gtsam.frontend.start.bundle import FOCAL_EFFORT
from mvdyn_gtsam.frontend.start.camera_maps import MappedCamera, map_camera
from mvdyn_gtsam.frontend.start.dense_map import DenseMap
from mvdyn_gtsam.frontend.start.focal import doubts, found_intrinsics
from mvdyn_gtsam.frontend.start.groups import Judge, Placement, balance, connect
from mvdyn_gtsam.frontend.start.joint_adjustment import Adjusted, adjust_maps
from mvdyn_gtsam.frontend.start.lifted_points import lift_map, match_lifted
from mvdyn_gtsam.frontend.start.model import Start, found_cameras
from mvdyn_gtsam.frontend.start.placement import (
    PointMatches,
    agreeing_pairs,
    match_maps,
    propose_placements,
    same_placement,
)
from mvdyn_gtsam.frontend.start.settings import WideBaselineConfig
from mvdyn_gtsam.frontend.start.single_camera import CameraMap, choose_frames
from mvdyn_gtsam.frontend.start.still_cameras import SamePoint, StillPlacement, place_still_cameras
from mvdyn_gtsam.frontend.start.still_view import StillView, build_still_view, frames_of_view, lone_frames
from mvdyn_gtsam.frontend.start.trial import mend_placement
from mvdyn_gtsam.frontend.start.verification import Verdict, verify_placement
from mvdyn_gtsam.frontend.threads import flow_threads
from mvdyn_gtsam.geometry import Similarity
from mvdyn_gtsam.progress import NullProgress, Progress

logger = logging.getLogger(__name__)

NEAR = 2.0
"""How many times as much must speak for a believed placement as for another that need not be tried."""


class WideBaselineInitializer(Protocol):
    """Anything that places the cameras: classical, or a feed-forward network such as VGGT behind ONNX."""

    def __call__(self, capture: Capture, progress: Progress) -> Start:
        """Poses and sparse depths of some frames of every camera, and the intrinsics of those whose focal
        length is not known. Raises TrackingError when nothing can be placed at all, or a focal length is
        neither known nor found."""
        ...


@dataclass(frozen=True)
class Candidate:
    """A placement that is yet to be tried."""

    placement: Placement
    inliers: int
    """Matches that support it."""
    support: float
    """What they explain, as of ``Hypothesis``."""
    alone: bool
    """Whether they support it ``NEAR`` times as well as any other."""


class ClassicalInitializer:
    """The default start: structure from motion per camera, pooled matches, dense verification."""

    def __init__(self, flow: DenseFlow, config: WideBaselineConfig | None = None) -> None:
        self.flow = flow
        self.config = config if config is not None else WideBaselineConfig()

    def __call__(self, capture: Capture, progress: Progress | None = None) -> Start:
        """See ``WideBaselineInitializer``."""
        progress = progress if progress is not None else NullProgress()
        config = self.config
        mapped = self._maps(capture, progress)
        capture = replace(capture, cameras=tuple(own.camera for own in mapped))
        maps = [own.sparse for own in mapped]
        dense = {index: own.dense for index, own in enumerate(mapped) if own.dense is not None}
        links, matches = self._links(capture, dense, progress)
        more, matches, lifted = self._look_again(capture, dense, links, matches)
        links += more
        maps = [lifted[m.camera].sparse if m.camera in lifted else m for m in maps]
        views = self._still_views(capture, [m.camera for m in maps if not m.has_depth])
        placed = place_still_cameras(
            capture.cameras,
            dense,
            connect(list(dense), links, self._judge(dense)),
            views,
            config.still,
            config.verification,
        )
        # A still camera takes part as the one image that all its frames make up.
        maps = [placed.maps.get(camera_map.camera, camera_map) for camera_map in maps]
        cameras = [
            views[index].pinhole if index in placed.maps else camera
            for index, camera in enumerate(capture.cameras)
        ]
        adjusted = [self._adjusted(capture, cameras, maps, matches, placed, group) for group in placed.groups]
        frames = {camera: own for one in adjusted for camera, own in one.frames.items()}
        for camera in placed.maps:
            frames[camera] = frames_of_view(views[camera], capture.cameras[camera], frames[camera][0])
        start = Start(
            groups=tuple(tuple(sorted(group)) for group in placed.groups),
            frames=tuple(frames.get(camera, ()) for camera in range(len(maps))),
            notes=tuple(doubt for one in adjusted for doubt in doubts(cameras, one)),
            intrinsics={camera: own for one in adjusted for camera, own in found_intrinsics(one).items()},
        )
        capture = replace(capture, cameras=found_cameras(capture.cameras, start))
        return _with_lone_cameras(capture, start, views)

    def _adjusted(
        self,
        capture: Capture,
        cameras: Sequence[Camera],
        maps: Sequence[CameraMap],
        matches: Mapping[tuple[int, int], PointMatches],
        placed: StillPlacement,
        group: Mapping[int, Similarity],
    ) -> Adjusted:
        """The joint adjustment of one group."""
        same_point: list[SamePoint] = [
            (a, b, self._same_points(capture, matches[a, b], a, b, group))
            for a, b in matches
            if a in group and b in group
        ]
        same_point += [pairs for pairs in placed.same_point if pairs[0] in group and pairs[1] in group]
        adjustment = self.config.adjustment
        if any(camera in placed.maps or not cameras[camera].focal_known for camera in group):
            # One view from far aside, and a focal length, converge along a narrow valley: an early end was
            # 15 cm off.
            iterations, tolerance = FOCAL_EFFORT
            adjustment = replace(adjustment, maximum_iterations=iterations, relative_tolerance=tolerance)
        return adjust_maps(cameras, maps, group, same_point, adjustment, ask_focal=True)

    def _still_views(self, capture: Capture, cameras: Sequence[int]) -> dict[int, StillView]:
        """The one image that each of these cameras makes up; none for a camera that does more than turn."""
        views = {}
        for camera in cameras:
            times, _ = choose_frames(capture, camera, self.config.frame_step, self.config.still.frames)
            even = np.linspace(0, capture.frame_count - 1, self.config.still.frames).round()
            view = build_still_view(
                capture,
                camera,
                np.union1d(times, even.astype(np.int64)),
                features=self.config.features,
                contrast=0.5 * self.config.contrast,
            )
            name = capture.cameras[camera].name
            if view is None:
                logger.info("%s: neither parallax nor a mere turn", name)
                continue
            logger.info("%s: %s", name, "only turns" if view.turns else "stands still")
            views[camera] = view
        return views

    def _same_points(
        self, capture: Capture, matches: PointMatches, a: int, b: int, group: Mapping[int, Similarity]
    ) -> npt.NDArray[np.int64]:
        aSb = group[a].inverse().compose(group[b])
        intrinsics_a, intrinsics_b = capture.cameras[a].intrinsics, capture.cameras[b].intrinsics
        return agreeing_pairs(matches, aSb, intrinsics_a, intrinsics_b, self.config.placement)

    def _maps(self, capture: Capture, progress: Progress) -> list[MappedCamera]:
        """The map of every camera; cameras side by side."""
        cameras = range(len(capture.cameras))
        maps: list[MappedCamera] = []
        # any other flow than one that may be called from several threads gets one caller
        workers = flow_threads() if isinstance(self.flow, OneWayFlow) else 1
        mapped = partial(map_camera, capture, flow=self.flow, config=self.config)
        with ThreadPoolExecutor(workers) as pool:
            try:
                for own in pool.map(mapped, cameras):
                    maps.append(own)
                    progress.update("start", len(maps), 2 * len(cameras), "one map per camera")
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        return maps

    def _links(
        self, capture: Capture, dense: Mapping[int, DenseMap], progress: Progress
    ) -> tuple[list[Placement], dict[tuple[int, int], PointMatches]]:
        """Every believable placement of every pair of cameras, and the matches they come from."""
        known = [camera for camera, own in dense.items() if own.known >= self.config.minimum_known]
        for camera in sorted(set(dense) - set(known)):
            logger.info("%s moves too little to be placed", capture.cameras[camera].name)
        pairs = [(a, b) for a in known for b in known if a < b]
        links, matches = [], {}
        for number, (a, b) in enumerate(pairs):
            progress.update("start", len(pairs) + number, 2 * len(pairs), "placing cameras")
            matches[a, b] = match_maps(dense[a].sparse, dense[b].sparse, self.config.placement)
            found = self._place(capture, dense[a], dense[b], matches[a, b])
            names = f"{capture.cameras[a].name} - {capture.cameras[b].name}"
            if not found:
                logger.info("%s: no placement stands up to dense warping", names)
                continue
            trust = 100.0 * max(link.verdict.trust for link in found)
            logger.info("%s: %d placements believable, at best %.0f %% in favour", names, len(found), trust)
            links += found
        return links, matches

    def _place(
        self, capture: Capture, first: DenseMap, second: DenseMap, matches: PointMatches
    ) -> list[Placement]:
        """Every hypothesis that dense warping does not refute; repeated structure may leave several.

        Unless one is clear, those with most in their favour are tried out first.
        """
        likely = self._likely(capture, first, second, matches)
        if self._clear([candidate.placement for candidate in likely]):
            return [likely[0].placement]
        found: list[Placement] = []
        enough = -np.inf
        for candidate in likely[: self.config.trial.trials]:
            value = balance(candidate.placement.verdict)
            if value < enough:
                break
            tried = self._tried(capture, first, second, matches, candidate.placement)
            if self._believed(tried.verdict, self.config.minimum_trust):
                found.append(replace(tried, doubted=not candidate.alone))
                enough = max(enough, value / NEAR)
        return found

    def _look_again(
        self,
        capture: Capture,
        dense: Mapping[int, DenseMap],
        links: Sequence[Placement],
        matches: Mapping[tuple[int, int], PointMatches],
    ) -> tuple[list[Placement], dict[tuple[int, int], PointMatches], dict[int, DenseMap]]:
        """Place pairs that ``links`` leave apart, or place in doubt, by all keypoints with depth, not
        triangulated ones alone.

        Returns further links, the matches with those of the new links, and the maps of their cameras, whose
        rows these matches hold.
        """
        more: list[Placement] = []
        pooled = dict(matches)
        lifted: dict[int, DenseMap] = {}
        used: set[int] = set()
        for a, b in sorted(matches):
            believed = [link for link in links if (link.first, link.second) == (a, b)]
            groups = connect(list(dense), [*links, *more], self._judge(dense))
            together = any(a in group and b in group for group in groups)
            if together and not any(link.doubted for link in believed):
                continue
            for camera in (a, b):
                if camera not in lifted:
                    lifted[camera] = lift_map(capture, dense[camera], self.config.lift, self.config.contrast)
            own = match_lifted(lifted[a], lifted[b], self.config.lift, self.config.placement)
            found = [
                placement
                for placement in self._place_lifted(capture, lifted[a], lifted[b], own)
                if _is_news(placement, believed)
            ]
            names = f"{capture.cameras[a].name} - {capture.cameras[b].name}"
            logger.info("%s: %d placements believable on a second look", names, len(found))
            if found:
                more += found
                pooled[a, b] = own
                used |= {a, b}
        return more, pooled, {camera: lifted[camera] for camera in used}

    def _place_lifted(
        self, capture: Capture, first: DenseMap, second: DenseMap, matches: PointMatches
    ) -> list[Placement]:
        """The placement with most in its favour among those that stand up to more doubt than others need.

        Lifted keypoints propose more, so more that is false: patterns that repeat agree wherever they are
        shifted to. What could be compared has to agree, and so has nearly all of the testimony, unless the
        matches and the trials leave no other choice.
        """
        config = self.config
        likely = self._likely(capture, first, second, matches)
        enough = [c for c in likely if c.inliers >= config.lift.minimum_inliers][: config.trial.trials]
        mended = [self._tried(capture, first, second, matches, c.placement) for c in enough]
        untried = [(c, c.placement) for c in likely if not any(c is one for one in enough)]
        rivals = [*zip(enough, mended, strict=True), *untried]
        found: list[Placement] = []
        for candidate, tried in zip(enough, mended, strict=True):
            alone = _stands_alone(candidate, tried, rivals)
            trust = config.minimum_trust if alone else config.lift.minimum_trust
            if self._believed(tried.verdict, trust) and tried.verdict.share >= config.lift.minimum_share:
                found.append(tried)
        return sorted(found, key=lambda placement: -balance(placement.verdict))[:1]

    def _likely(
        self, capture: Capture, first: DenseMap, second: DenseMap, matches: PointMatches
    ) -> list[Candidate]:
        """Proposals that dense warping does not refute outright, those with most in their favour first."""
        config = self.config
        a, b = first.sparse.camera, second.sparse.camera
        intrinsics = capture.cameras[a].intrinsics, capture.cameras[b].intrinsics
        hypotheses = propose_placements(matches, *intrinsics, config.placement)
        likely = []
        for hypothesis in hypotheses:
            if hypothesis.inliers < config.trial.minimum_inliers:
                continue
            verdict = verify_placement(first.views, second.views, hypothesis.aSb, config.verification)
            if verdict.trust >= config.trial.minimum_trust:
                rivals = [h.support for h in hypotheses if not same_placement(h.aSb, hypothesis.aSb)]
                alone = hypothesis.support >= NEAR * max(rivals, default=0.0)
                placement = Placement(a, b, hypothesis.aSb, verdict)
                likely.append(Candidate(placement, hypothesis.inliers, hypothesis.support, alone))
        return sorted(likely, key=lambda candidate: -balance(candidate.placement.verdict))

    def _tried(
        self,
        capture: Capture,
        first: DenseMap,
        second: DenseMap,
        matches: PointMatches,
        placement: Placement,
    ) -> Placement:
        """The placement as a trial mends it, with the verdict after that."""
        config = self.config
        a, b = placement.first, placement.second
        cameras = capture.cameras[a], capture.cameras[b]
        same_point = agreeing_pairs(
            matches, placement.aSb, cameras[0].intrinsics, cameras[1].intrinsics, config.placement
        )
        aSb, moved = mend_placement(
            cameras,
            (first, second),
            placement.aSb,
            same_point,
            config.adjustment,
            config.trial,
            config.dense_map,
        )
        verdict = verify_placement(
            moved[0].views, moved[1].views, Similarity.identity(), config.verification, careful=True
        )
        logger.debug("%d - %d: %s became %s", a, b, placement.verdict, verdict)
        return Placement(a, b, aSb, verdict)

    def _believed(self, verdict: Verdict, trust: float) -> bool:
        enough = verdict.agreement >= self.config.minimum_agreement * verdict.frame_pairs
        return enough and verdict.trust >= trust

    def _clear(self, likely: Sequence[Placement]) -> bool:
        """Whether the first is to be believed as it is, and no other comes near it: no need for trials."""
        if not likely or not self._believed(likely[0].verdict, self.config.clear_trust):
            return False
        return all(NEAR * balance(other.verdict) < balance(likely[0].verdict) for other in likely[1:])

    def _judge(self, dense: Mapping[int, DenseMap]) -> Judge:
        def judge(a: int, b: int, aSb: Similarity) -> float:
            verdict = verify_placement(
                dense[a].views, dense[b].views, aSb, self.config.verification, careful=True
            )
            return balance(verdict)

        return judge


def _stands_alone(
    candidate: Candidate, tried: Placement, rivals: Sequence[tuple[Candidate, Placement]]
) -> bool:
    """Whether the matches support a candidate ``NEAR`` times as well as any rival, all as trials left them.

    What ended up in the same place, or with more against it than for it, is no rival.
    """
    return all(
        candidate.support >= NEAR * other.support
        or same_placement(tried.aSb, placement.aSb)
        or balance(placement.verdict) <= 0.0
        for other, placement in rivals
    )


def _is_news(placement: Placement, believed: Sequence[Placement]) -> bool:
    """Whether more speaks for ``placement`` than for any that is ``believed``, and it is none of them."""
    return all(
        balance(placement.verdict) > balance(other.verdict) and not same_placement(placement.aSb, other.aSb)
        for other in believed
    )


def _with_lone_cameras(capture: Capture, start: Start, views: Mapping[int, StillView]) -> Start:
    """Every camera that nothing places gets a group, and a depth of 1, of its own; notes say so."""
    lone = [camera for camera, frames in enumerate(start.frames) if not frames]
    frames, notes = list(start.frames), []
    for camera in lone:
        frames[camera] = lone_frames(capture.cameras[camera], capture.frame_count, views.get(camera))
        motion = "keeps its place" if camera in views else "moves too little or too unclearly for a map"
        notes.append(
            f"{capture.cameras[camera].name} {motion} and nothing connects it to cameras that would show its "
            "depth; it has a world of its own, in which the depth is made up (1 everywhere)"
        )
        logger.warning(notes[-1])
    return replace(
        start,
        groups=(*start.groups, *((camera,) for camera in lone)),
        frames=tuple(frames),
        notes=(*start.notes, *notes),
    )
