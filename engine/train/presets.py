"""How much work a lift may take: three presets, and what a user may override.

Every schedule point is a fraction of the steps, so that a preset of 500 steps goes through the same stages as the
paper's 30 000 (paper, "Implementation Details").
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from ..instances.consensus import ConsensusOptions
from ..instances.matching import MatchingOptions
from ..instances.segment_votes import SegmentVoting
from ..job.effort import EFFORTS, Effort
from ..model.growing import GrowthRules
from ..model.label_voting import VotingOptions
from ..model.plain import PlainRules
from .contrastive_loss import ContrastiveRules
from .identity_loss import IdentityRules


@dataclass(frozen=True)
class Schedule:
    """Fractions of all steps. ``self_training_every`` is the paper's 5k of 30k: the first round of pseudo labels ends
    the initial stage. Growing as in Scaffold-GS: every 100/30000 from 1500/30000 to 15000/30000, statistics from
    500/30000; in short lifts no more often than ``grow_every_at_least_steps``, since a round judges by how often it
    has seen an anchor. Segments are kept consistent from ``segments_from`` on, where that loss has a weight: earlier it
    teaches what is not learned yet, and all classes become one. Panoptic Lifting begins it at its sixth epoch."""

    self_training_every: float = Effort.self_training_every
    statistics_from: float = 500 / 30000
    grow_from: float = 1500 / 30000
    grow_until: float = 0.5
    grow_every: float = 100 / 30000
    grow_every_at_least_steps: int = 40
    segments_from: float = 0.6


@dataclass(frozen=True)
class LearningRates:
    """Start and end of log-linear decays (Scaffold-GS's, and ours for the two label decoders). ``offset`` is multiplied
    by the scene's extent in metres."""

    feature: tuple[float, float] = (0.0075, 0.0075)
    offset: tuple[float, float] = (0.01, 1e-4)
    log_scale: tuple[float, float] = (0.007, 0.007)
    opacity: tuple[float, float] = (0.002, 2e-5)
    covariance: tuple[float, float] = (0.004, 0.004)
    colour: tuple[float, float] = (0.008, 5e-5)
    semantic: tuple[float, float] = (0.004, 4e-4)
    instance: tuple[float, float] = (0.004, 4e-4)


@dataclass(frozen=True)
class LossWeights:
    """lambda_ssim, lambda_vol, lambda_sem, lambda_ins of the paper's section "Implementation Details"; ``depth`` is
    ours (see ``depth_loss``). Within L_sem, ``cluster`` weighs L_cluster, and ``segment`` the consistency of segments,
    which is Panoptic Lifting's (see ``segment_targets``)."""

    ssim: float = 0.2
    volume: float = 0.001
    semantic: float = 0.2
    instance: float = 0.2
    depth: float = 0.5
    cluster: float = 1.0
    segment: float = 0.0


@dataclass(frozen=True)
class WarmStart:
    """Fitting the decoders to the initial anchors, ``batch`` of them a step; ``opacity_bias`` is added before the tanh,
    so that fewer Gaussians start invisible (and without a gradient)."""

    steps: int = 400
    batch: int = 4096
    rate: float = 0.01
    opacity_bias: float = 0.3


@dataclass(frozen=True)
class Preset:
    """Everything that shapes a lift except its input and its seed."""

    name: str
    steps: int
    size_within: tuple[int, int]
    """(width, height): frames are brought into this box for the lift, never enlarged."""
    voxel_size: float
    """Metres (the paper's epsilon)."""
    gaussians_per_anchor: int
    features: int = 32
    instance_slots: int = 0
    """The least number of slots. Without matching, ``objects`` "none", there are so many, which mean what the linear
    assignment makes of them."""
    most_anchors: int = Effort.most_anchors
    distance_input: bool = False
    """Decoders are told the camera's distance beside its direction, as the paper's formula has it."""
    label_view_input: bool = False
    """The label decoders are told both, too, so that labels depend on who looks."""
    neighbours: int = 0
    """N_w: views whose masks a view's are compared with. None are compared with 0."""
    agreement: float = 1.0
    """The share of these views that must agree; 1 is the paper's product."""
    vote_by: Literal["views", "pixels"] = "views"
    majority: float = 0.0
    """How the cloud's points vote, with ``vote_by``: see CloudOptions."""
    objects: Literal["boxes", "agreement", "none"] = "agreement"
    """How segments of all views become instances: Algorithm 1 by ``matching``, or ours, with a vote of the views on
    each object's class. With "none" nothing is matched in space."""
    most_instances: int = 1000
    """Of what was matched, those with the most pixels are kept."""
    one_class_an_object: bool = True
    """What is shown of an instance has the instance's class."""
    most_points: int = Effort.most_points
    """Of the semantic point cloud."""
    seeded_features: bool = True
    """Features start from colour and label of the anchors, not from zero."""
    warm_start: WarmStart | None = WarmStart()
    """How the decoders are fitted to these before training, if they are."""
    matching: MatchingOptions = MatchingOptions()
    schedule: Schedule = Schedule()
    rates: LearningRates = LearningRates()
    weights: LossWeights = LossWeights()
    growth: GrowthRules = GrowthRules(least_visits=10)
    steps_a_view: float = 0.0
    """Where there are many views, the steps are as many as let each be seen so often."""
    most_frames: int = Effort.most_frames
    """Trained on, see ``choose_frames``; 0: all."""
    all_frames_vote: bool = Effort.all_frames_vote
    """Frames that are not trained on vote on the classes of objects and points."""
    fill_holes: bool = True
    """Planar holes of the depth are filled before anything is placed in space."""
    consensus: ConsensusOptions = ConsensusOptions()
    segment_voting: SegmentVoting = SegmentVoting()
    """How segments and points vote on the labels of objects found by agreement."""
    linear_assignment: bool = False
    """A view's segments are assigned to slots in each step, by what is drawn."""
    fit_exposure: bool = True
    """Each photo is compared after the model's picture was brought to its exposure."""
    weigh_sharpness: bool = True
    """Blurred photos count less."""
    labels: Literal["decoders", "votes"] = "votes"
    """What the finished scene shows: what the label decoders say, or what the views vote on its Gaussians. Votes need
    objects by agreement, of one class each, else decoders serve."""
    vote_size_within: tuple[int, int] = (320, 320)
    """(width, height) of the box within which the voting masks are read."""
    vote_rounds: int = 2
    label_every: int = 4
    """Labels are trained in every so many steps."""
    voting: VotingOptions = VotingOptions()
    representation: Literal["structured", "plain"] = "structured"
    """With "plain" it is 3DGS with labels on each Gaussian, grown by ``plain``."""
    plain: PlainRules = PlainRules()
    semantic_targets: Literal["projected", "masks", "none"] = "projected"
    """Classes are learnt from the projected cloud, or the votes; from the machine's masks; or by L_cluster alone."""
    matched_masks: bool = True
    """M_match, or the votes' objects, supervise instances, if anything was matched."""
    labelled_start: bool = True
    """Without it anchors and decoders begin with the cloud's colours alone."""
    vote_from: Literal["objects", "masks"] = "objects"
    """The labels that are voted onto Gaussians come from the voted objects, or straight from the masks."""
    instances: Literal["slots", "identity", "contrastive"] = "slots"
    """What tells instances apart: probabilities of slots; an encoding that the matched masks teach (Gaussian
    Grouping's, by ``identity``); or one that needs nothing matched, whose clusters are the instances (Contrastive
    Lift's, by ``contrastive``). The finished scene then shows these, not the votes."""
    identity: IdentityRules = IdentityRules()
    contrastive: ContrastiveRules = ContrastiveRules()

    def __post_init__(self) -> None:
        if self.vote_rounds < 1 or self.label_every < 1:
            raise ValueError(f"vote_rounds and label_every must be at least 1: {self.vote_rounds}, {self.label_every}")

    @property
    def encoding(self) -> int:
        """Channels of the encoding that tells instances apart; 0 where slots do."""
        channels = {"identity": self.identity.channels, "contrastive": self.contrastive.channels}
        return channels.get(self.instances, 0)

    def for_views(self, views: int) -> Preset:
        """With as many steps as so many views need."""
        return replace(self, steps=max(self.steps, round(self.steps_a_view * views)))


def _of_effort(effort: Effort, **others: Any) -> Preset:
    return Preset(
        effort.name,
        steps=effort.steps,
        size_within=effort.size_within,
        voxel_size=effort.voxel_size,
        gaussians_per_anchor=effort.gaussians_per_anchor,
        most_points=effort.most_points,
        most_anchors=effort.most_anchors,
        schedule=Schedule(self_training_every=effort.self_training_every),
        steps_a_view=effort.steps_a_view,
        most_frames=effort.most_frames,
        all_frames_vote=effort.all_frames_vote,
        vote_size_within=effort.vote_size_within,
        vote_rounds=max(1, effort.vote_rounds),
        **others,
    )


PRESETS = {
    preset.name: preset
    for preset in (
        _of_effort(EFFORTS["preview"]),
        _of_effort(EFFORTS["standard"]),
        _of_effort(
            EFFORTS["paper"],
            distance_input=True,
            label_view_input=True,
            neighbours=4,
            objects="boxes",
            one_class_an_object=False,
            vote_by="pixels",
            majority=0.5,
            seeded_features=False,
            warm_start=None,
            weights=LossWeights(depth=0.0),
            growth=GrowthRules(),
            fill_holes=False,
            linear_assignment=True,
            instance_slots=25,
            fit_exposure=False,
            weigh_sharpness=False,
            labels="decoders",
            label_every=1,
        ),
    )
}


def chosen_preset(
    name: str, steps: int | None = None, size: tuple[int, int] | None = None, frames: int | None = None
) -> Preset:
    """The preset of that name with the user's steps, size and number of frames (0 = all). Raises KeyError for a name
    that is none."""
    preset = PRESETS[name]
    if steps is not None:
        preset = replace(preset, steps=steps, steps_a_view=0.0)
    if size is not None:
        preset = replace(preset, size_within=size)
    return preset if frames is None else replace(preset, most_frames=frames)
