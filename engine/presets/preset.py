"""All options of a lift, and their values in the presets.

Each field is an option. It has the same name here, after --set, in a preset's file and in request.json; a field of a
group is called ``group.field``. What neither a preset nor an experiment varies is a constant beside the code that uses
it. Every schedule point is a fraction of the steps, so that a preset with 500 steps goes through the same stages as the
paper's 30 000 (see its "Implementation Details")."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar

SHORTEST_SIDE, LONGEST_SIDE = 16, 16384
"""The range of a picture's side in pixels."""


Number = TypeVar("Number")
Names = TypeVar("Names", str, tuple[str, ...])


def _ranged(default: Number, least: float = 0, most: float = math.inf) -> Number:
    """Declare a field with one or more numbers, each between ``least`` and ``most``."""
    value: Number = field(default=default, metadata={"least": least, "most": most})
    return value


def _named(kind: str, default: Names, *known: str) -> Names:
    """Declare a field that names one or more parts of a ``kind``: ``known`` ones, or parts of scripts (``parts``)."""
    value: Names = field(default=default, metadata={"part": kind, "choices": known})
    return value


@dataclass(frozen=True)
class Matching:
    """The options of Algorithm 1. ``tau_new``: a segment whose smallest cost is above it becomes a new instance.
    ``rule``: "hybrid" takes the Hungarian partner if its cost is at most tau, else the cheapest global instance if its
    cost is at most tau, else a new one; "literal" is the text of Algorithm 1. ``cost``: the terms used of cost O."""

    tau_new: float = _ranged(-0.1, -2.0, 0.0)
    rule: Literal["hybrid", "literal"] = "hybrid"
    cost: Literal["IoU+IoM", "IoU", "IoM"] = "IoU+IoM"


@dataclass(frozen=True)
class Segments:
    """Options for segments. Before Algorithm 1, they are eroded by ``erosion`` times the picture's width, and those
    with fewer than ``least_points`` pixels with depth are left out; the paper mentions neither. Regions of fewer than
    ``least_region`` pixels keep the rendered classes as pseudo labels."""

    erosion: float = _ranged(2 / 160, 0.0, 0.5)
    least_points: int = _ranged(30, 1)
    least_region: int = _ranged(16, 0)


@dataclass(frozen=True)
class Schedule:
    """When pseudo labels are made. ``self_training_every`` is the share of the steps after which each round is made;
    with 1 there is no round. The paper makes one every 5k of 30k steps; the first round ends its initial stage."""

    self_training_every: float = _ranged(1.0, 0.001, 1.0)


@dataclass(frozen=True)
class LossWeights:
    """The weights of L_total, which ``Trainer._losses`` computes. lambda_ssim, lambda_vol, lambda_sem and lambda_ins
    are those of the paper's section "Implementation Details"; ``depth`` is ours (see ``depth_loss``). ``cluster``
    weighs L_cluster within L_sem."""

    ssim: float = _ranged(0.2)
    volume: float = _ranged(0.001)
    semantic: float = _ranged(0.2)
    instance: float = _ranged(0.2)
    depth: float = _ranged(0.5)
    cluster: float = _ranged(1.0)


@dataclass(frozen=True)
class Growth:
    """When anchors are judged for growing and pruning. After ``least_visits`` visits an anchor is judged, however few
    steps have passed; otherwise a short lift of many views would never judge an anchor that few views see. None: only
    Scaffold-GS's shares of the steps count (``GrowthRules``)."""

    least_visits: int | None = _ranged(10)


@dataclass(frozen=True)
class SegmentVoting:
    """How segments vote on labels. ``rounds``: how often segments take the label of their points and vote again.
    ``neighbours``: neighbouring points on a thing share votes. ``near``: near views may overrule others on what they
    show as a whole. ``superpoints``: points share their superpoint's votes, if held-back views agree."""

    rounds: int = _ranged(2)
    neighbours: bool = True
    near: bool = True
    superpoints: bool = True


EvidenceKind = Literal["views", "root", "resolution", "pixels", "density"]
"""The number of a view's votes: 1 ("views"), the square root of its pixels ("root"), its pixels per centimetre
("resolution"), its pixels ("pixels"), or its pixels per square centimetre ("density", 1 / depth² for one lens)."""


@dataclass(frozen=True)
class ViewEvidence:
    """How a view's evidence is weighted: on the ``points`` of the cloud, on the classes of ``objects``, on the labels
    that ``segments`` give to points, and on the ``gaussians``. For ``masks``, a view that judges two masks is weighted
    by how well it resolves them, compared with other views of them."""

    points: EvidenceKind = "density"
    objects: EvidenceKind = "root"
    segments: EvidenceKind = "resolution"
    gaussians: EvidenceKind = "pixels"
    masks: EvidenceKind = "density"


@dataclass(frozen=True)
class Preset:
    """Everything that shapes a lift except its input and its seed. The defaults are those of the preset "preview"."""

    name: str
    steps: int = _ranged(500, 1, 10_000_000)
    size: tuple[int, int] = _ranged((200, 200), SHORTEST_SIDE, LONGEST_SIDE)
    """Pixels (width, height): frames are shrunk to fit into this box for the lift, never enlarged."""
    frames: int = _ranged(400, 0, 1_000_000)
    """At most this many frames are trained on (see ``choose_frames``); 0: all."""
    voxel_size: float = _ranged(0.06, 0.001, 10.0)
    """Metres (the paper's epsilon)."""
    gaussians_per_anchor: int = _ranged(4, 1, 32)
    instance_slots: int = _ranged(0, 0, 1000)
    """Least number of slots. With ``objects`` "none" there are exactly this many, and the linear assignment decides
    what they mean."""
    most_anchors: int = _ranged(400_000, 1)
    distance_input: bool = False
    """Decoders get the camera's distance in addition to its direction, as in the paper's formula."""
    label_view_input: bool = False
    """The label decoders get distance and direction too, so that labels depend on the view."""
    neighbours: int = _ranged(0, 0, 64)
    """N_w: the number of neighbouring views whose masks are compared with a view's."""
    agreement: float = _ranged(1.0, 0.0, 1.0)
    """Share of these views that must agree with a label if they see it; 1 is the paper's product."""
    majority: float = _ranged(0.0, 0.0, 1.0)
    """Share of the votes that a point of the cloud needs to get a class."""
    objects: str = _named("matcher", "agreement", "boxes", "agreement", "none")
    """How segments of all views become instances: Algorithm 1 by ``matching``, or our method, with a vote of the views
    on each object's class. With "none" nothing is matched in space."""
    most_instances: int = _ranged(1000, 1, 4000)
    """At most this many instances are kept, those with the most pixels."""
    one_class_an_object: bool = True
    """Every part of an instance is shown with the instance's class."""
    teach_no_object: bool = True
    """Pixels without an object are taught to show none; the paper supervises the pixels of things alone."""
    most_points: int = _ranged(200_000, 1)
    """The most points of the semantic point cloud."""
    most_pixels: int | None = _ranged(16_000_000, 1)
    """About how many pixels of all views become points: every s-th row and column; None: all of them."""
    seeded_features: bool = True
    """Features start from the anchors' colours and labels, not from zero."""
    warm_start: bool = True
    """The decoders are fitted to the anchors before training (see ``warm_start``)."""
    matching: Matching = Matching()
    segments: Segments = Segments()
    schedule: Schedule = Schedule()
    weights: LossWeights = LossWeights()
    losses: tuple[str, ...] = _named("loss", ("depth",), "depth")
    """Terms of the loss besides L_recon, L_sem and L_ins; "depth" has its weight in ``weights``."""
    head: str = _named("head", "structured", "structured")
    """The kind of decoders."""
    growth: Growth = Growth()
    steps_a_view: float = _ranged(5.0)
    """With many views, the steps suffice to see each view this often."""
    trained: float = _ranged(1.0, 0.001, 1.0)
    """The share of the steps that are done; ``lift --refine`` does the others."""
    judged: int = _ranged(100, 1)
    """At most this many training views judge the finished lift by their masks, evenly chosen."""
    scored: tuple[int, int] = _ranged((LONGEST_SIDE, LONGEST_SIDE), SHORTEST_SIDE, LONGEST_SIDE)
    """Pixels (width, height): held-out frames that are not baked are scored at a size that fits into this box."""
    all_frames_vote: bool = True
    """Frames that are not trained on also vote on the classes of objects and points."""
    fill_holes: bool = True
    """Planar holes in the depth are filled before pixels are unprojected."""
    free_space: bool = True
    """No Gaussians start where the measured depth of most views goes on behind them."""
    segment_voting: SegmentVoting = SegmentVoting()
    linear_assignment: bool = False
    """In each step, a view's segments are assigned to slots by what is drawn."""
    fit_exposure: bool = True
    """Each photo is compared with the model's picture at the photo's exposure."""
    weigh_sharpness: bool = True
    """Blurred photos have less weight."""
    labels: Literal["decoders", "votes"] = "votes"
    """What the finished scene shows: the output of the label decoders, or the views' votes on its Gaussians. Votes need
    objects by agreement, of one class each; otherwise the decoders are used."""
    vote_size: tuple[int, int] = _ranged((320, 320), SHORTEST_SIDE, LONGEST_SIDE)
    """Pixels (width, height) of the box within which the voting masks are read."""
    evidence: ViewEvidence = ViewEvidence()
    label_every: int = _ranged(4, 1)
    """Labels are trained in every step whose number is divisible by this."""

    @property
    def shows_votes(self) -> bool:
        """Whether the labels of the finished scene are those that the views vote for."""
        return self.labels == "votes" and self.can_vote

    @property
    def can_vote(self) -> bool:
        """Whether the frames' masks can vote on the label of each Gaussian. That needs objects of one class each, found
        by the agreement of the masks or by a script's matcher."""
        return self.objects not in ("boxes", "none") and self.one_class_an_object

    @property
    def last_step(self) -> int:
        """The number of training steps that are really done: the share ``trained`` of ``steps``."""
        return max(1, round(self.trained * self.steps))

    def views_of(self, train_frames: int) -> int:
        """Return how many of the ``train_frames`` training frames are lifted."""
        return min(train_frames, self.frames) if self.frames else train_frames

    def for_views(self, views: int) -> Preset:
        """Return the preset with the number of steps that suits this many ``views``."""
        return replace(self, steps=max(self.steps, round(self.steps_a_view * views)))


PRESETS: dict[str, Preset] = {
    preset.name: preset
    for preset in (
        Preset("draft", trained=0.12, vote_size=(200, 200), judged=20, scored=(320, 320)),
        Preset("preview"),
        Preset(
            "standard",
            steps=1500,
            size=(320, 320),
            frames=900,  # as many as Panoptic Lifting uses
            voxel_size=0.05,
            steps_a_view=15.0,
            vote_size=(640, 640),
        ),
        Preset(
            "paper",
            steps=30_000,
            size=(640, 640),
            frames=900,
            voxel_size=0.02,
            gaussians_per_anchor=10,
            instance_slots=25,
            most_instances=25,
            most_anchors=2_000_000,
            distance_input=True,
            label_view_input=True,
            neighbours=4,
            evidence=ViewEvidence(points="pixels"),
            majority=0.5,
            objects="boxes",
            one_class_an_object=False,
            teach_no_object=False,
            most_points=2_000_000,
            most_pixels=None,
            seeded_features=False,
            warm_start=False,
            schedule=Schedule(self_training_every=1 / 6),
            weights=LossWeights(depth=0.0),
            growth=Growth(least_visits=None),
            steps_a_view=0.0,
            all_frames_vote=False,
            fill_holes=False,
            free_space=False,
            linear_assignment=True,
            fit_exposure=False,
            weigh_sharpness=False,
            labels="decoders",
            label_every=1,
        ),
    )
}
