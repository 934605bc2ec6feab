"""Every setting, with its unit and its default, in sections. Defaults are the paper's where it gives one.

The stages take these sections as they are; only the drivers load them from files. Where an equation is called
corrected, docs/paper.md says how.
"""

from __future__ import annotations

from collections.abc import Mapping
from ipaddress import IPv4Address
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from hrcreplay.records import POINTS

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Sigmas = tuple[NotNegative, NotNegative, NotNegative, NotNegative]
Share = Annotated[float, Field(ge=0, le=1)]


def _ipv4(given: str) -> str:
    return str(IPv4Address(given))


Ipv4 = Annotated[str, AfterValidator(_ipv4)]
Ipv4OrNone = Annotated[str, AfterValidator(lambda given: given and _ipv4(given))]


class Section(BaseModel):
    """A group of settings: frozen, and an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    @model_validator(mode="before")
    @classmethod
    def _none(cls, given: Any) -> Any:
        """Takes the word "none" for no value where a setting may have none: TOML has no other way to say it."""
        if not isinstance(given, dict):
            return given
        fields = cls.model_fields
        optional = {name for name, field in fields.items() if type(None) in get_args(field.annotation)}
        return {name: None if value == "none" and name in optional else value for name, value in given.items()}


class Decoder(Section):
    """Decoder of skeletons from a message type the package does not know."""

    topic: str
    """Topic of the messages."""
    camera: str
    """Name that the sensor gets."""
    points: str
    """Path to the array of points inside the message, fields joined by dots; its elements have x, y, z."""
    index: dict[str, int]
    """Which element is which body point: body point -> index."""
    unit: Literal["m", "mm"] = "m"
    """Unit of the points."""
    stamp: str | None = "header.stamp"
    """Path to the capture time; "none": the arrival time is used."""
    confidence: str | None = None
    """Path to an array of confidences in [0, 1], one a point; none: every finite point has confidence 1."""

    def model_post_init(self, _context: Any) -> None:
        """Refuses body points that are not in POINTS."""
        unknown = sorted(set(self.index) - set(POINTS))
        if unknown:
            raise ValueError(f"unknown body point {unknown[0]!r}; known are {', '.join(POINTS)}")


class Logs(Section):
    """Reading logs."""

    topics: tuple[str, ...] = ()
    """Skeleton topics to read; none: all that a decoder knows."""
    decoders: tuple[Decoder, ...] = ()
    """Decoders for message types the package does not know."""
    unit: Literal["m", "mm"] = "m"
    """Unit of the positions in markers and transforms."""
    marker_ids_per_body: Annotated[int, Field(ge=1)] | None = None
    """Ids of markers from one body to the next, of which the first are the joints; none: 100, or 33 or 32 where only
    that fits the ids in the log."""
    joints_topic: str | None = None
    """Topic of the robot's joint states; none: all of sensor_msgs/JointState and our own, joined by joint."""
    joint_names: tuple[str, ...] = ()
    """The log's names of the robot's joints, in the order of the axes; none: those of the robot."""
    joints_unit: Literal["rad", "deg"] = "rad"
    """Unit of the joint positions."""
    joints_offset_s: Annotated[float, Field(ge=-4e9, le=4e9)] | None = None
    """The robot's clock minus the log's; none: 0, or estimated where the stamps cannot be on the log's clock [s]."""
    person_jump_m: Positive = 0.8
    """A body further than this from where the person was last seen is somebody else [m]."""
    person_memory_s: Positive = 2.0
    """After this long without the person, the nearest body becomes the person [s]."""
    gap_s: Positive = 0.2
    """A camera silent for longer has a gap [s]."""

    def model_post_init(self, _context: Any) -> None:
        """Refuses a joint that is named for two axes."""
        twice = [name for name in self.joint_names if self.joint_names.count(name) > 1]
        if twice:
            raise ValueError(f"logs.joint_names: {twice[0]!r} stands for two axes; name each joint once")


class Fusion(Section):
    """Section 4: the Kalman filter.

    The sigmas and ``coast_s`` are those with the least error against ground truth over a sweep on a recording with
    two cameras of 25 and 30 Hz, 1-3 cm of noise and occlusions: the velocity's sigma dominates, since people reach and
    rest, and a polynomial with a lively jerk overshoots at both ends. Ignoring delays has the smaller error there
    while people stand, compensating them while they move; what matters for safety is the latter.
    """

    rate_hz: Annotated[float, Field(gt=0, le=2000, allow_inf_nan=False)] = 250.0
    """Ticks a second of the filter and the controller [Hz]."""
    stale: Literal["skip", "reuse"] = "skip"
    """Between two frames: skip the camera's rows, or re-use them with the sawtooth covariance of 4.1.1."""
    delay: Literal["compensate", "ignore"] = "compensate"
    """Relate a frame to the state at its capture time, or take it for the state at the tick."""
    confidence_min: Share = 0.2
    """An angle is used when the product of the confidences of its points is at least this."""
    outlier_m: Positive = 0.20
    """A point further than this from the predicted skeleton is an outlier [m]."""
    relearn_s: Positive = 0.1
    """Accept an outlier seen in one place this long, while no camera sees it where the filter has it [s]."""
    bone_m: Positive = 0.10
    """A point is an outlier too where its bone is longer or shorter than the person's by more than this [m]."""
    bone_memory_s: Positive = 5.0
    """Accept such an outlier once no camera has seen that bone's right length for this long [s]."""
    point_std_m: Positive = 0.02
    """Standard deviation of a skeleton point at full confidence [m]."""
    point_std_per_m: NotNegative = 0.0
    """Its growth with the distance from the camera [m/m]."""
    sigma_position: Sigmas = (300.0, 100.0, 5.0, 1.0)
    """Sigmas of Eq. (44) for x and y: p, v, a, j [m/s^2, m/s^2.5, m/s^3, m/s^3.5]."""
    sigma_height: Sigmas = (300.0, 200.0, 5.0, 1.0)
    """The same for z: people get up faster than they walk about."""
    sigma_angle: Sigmas = (1500.0, 600.0, 10.0, 1.0)
    """The same for the angles [rad]."""
    coast_s: Positive = 0.12
    """A joint without a valid row for longer comes to rest [s]."""
    delay_max_s: Positive = 0.25
    """An older frame counts as this old [s]."""
    residual_quantile: Share = 0.9
    """Tracked quantile of the distance of each limb's measured points from the model's."""
    residual_memory_s: Positive = 20.0
    """Time constant with which a measured distance loses weight [s]."""
    residual_hold_s: NotNegative = 0.15
    """Time for which a distance above the quantile counts, unless a larger one follows [s]."""
    offset_memory_s: Positive = 0.5
    """Time constant of the mean offset of shoulders, head and arms from the model [s]."""
    spread_memory_s: Positive = 1.0
    """The reported variances are scaled by the highest normalised innovation squared; it decays to 1/e in this time
    [s]."""
    spread_least: Positive = 0.01
    """Least factor by which the reported variances are scaled."""
    spread_most: Positive = 30.0
    """Largest such factor."""
    memory_s: Positive = 0.5
    """A joint without a valid row for longer is lost: it starts anew from the next one, and its limb may have moved as
    far as the limits allow [s]."""
    fresh_s: Positive = 0.3
    """An older frame, by its capture, is not used, and a person whose newest frame is older is not known: the robot
    brakes, in a live session too [s]."""


class LimitNames(Section):
    """Named limit sets (paper, human, people) or paths of TOML files."""

    tracking: str = "human"
    """Bounds the filter's state, Eq. (62)-(65)."""
    prediction: str = "people"
    """Bounds the reachable sets, Alg. 1. people: fitted on recordings; see docs/validation.md."""


class Prediction(Section):
    """Section 3: what the person can reach."""

    method: Literal["paper", "positions", "sound"] = "sound"
    """sound: encloses every motion under the limits, of whole limbs where they bound departures, else of the joints;
    paper: Eq. (20)-(30) and Alg. 1, 2 as printed; positions: from positions and velocity bounds alone [26]."""
    stop_s: Positive = 0.377
    """Worst-case braking time T_s of the robot, Eq. (70) [s]."""
    store_hz: Positive | Literal["all"] = 25.0
    """Ticks a second whose volumes are stored, or "all" [Hz]."""
    radius_head_m: NotNegative = 0.12
    """Table 2 [m]."""
    radius_thorax_m: NotNegative = 0.15
    """Table 2 [m]."""
    radius_upper_arm_m: NotNegative = 0.07
    """Table 2 [m]."""
    radius_lower_arm_m: NotNegative = 0.07
    """Table 2 [m]."""

    sigmas: NotNegative = 1.0
    """sound: states within so many standard deviations of the estimate are enclosed, all joints off at once; not of
    limbs whose departures are bounded, for these were measured from the estimate."""
    latency_s: NotNegative = 0.0
    """sound: from the newest capture to the robot's reaction; the horizon is longer by it [s]."""
    hand_m: NotNegative = 0.19
    """sound: length of the hand beyond the wrist [m]."""
    legs_radius_m: Positive = 0.20
    """sound: least radius of the lower body around the line from the floor to the pelvis; legs seen further off, as of
    who sits or squats, make it larger [m]."""
    legs: bool = True
    """sound: whether there is a lower body."""
    residual: bool = True
    """sound: whether the measured body's distance from the model is added to the radii."""
    residual_unknown_m: NotNegative = 0.10
    """sound: that distance until enough of it has been seen [m]."""


class LinkSettings(Section):
    """One link segment of a robot."""

    name: str
    """Name in outputs."""
    body: str
    """Body (URDF link or joint frame) that both ends are fixed on."""
    start_m: tuple[float, float, float]
    """First end in that body's frame [m]."""
    end_m: tuple[float, float, float]
    """Second end in that body's frame [m]."""
    radius_m: Positive
    """Radius of the capsule [m]."""


class Offset(Section):
    """A pose seen from another frame."""

    position_m: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """Its origin [m]."""
    rpy_deg: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """Its orientation, Rz(yaw) Ry(pitch) Rx(roll) [deg]."""


class Robot(Section):
    """The manipulator. Default: ABB IRB 140."""

    urdf: Path | None = None
    """Another robot's URDF; none: the IRB 140. Joints that do not lie between base and tool are locked at zero. In a
    settings file a relative path is looked for beside that file first, as are packages, plan.task and files of
    limits."""
    packages: tuple[Path, ...] = ()
    """Directories of the packages whose meshes that URDF names (package://); searched before the directories at and
    above the URDF, and those of ROS_PACKAGE_PATH."""
    base_frame: str | None = None
    """Frame of that URDF that stands on T_world_base; none: its root."""
    tcp_frame: str | None = None
    """Frame of that URDF that carries the tool; none: the last one that revolute joints move."""
    tool_m: NotNegative = 0.10
    """TCP beyond the flange, along its z axis [m]."""
    tcp_offset: Offset = Offset()
    """TCP from there, for a tool that is not straight."""
    links: tuple[LinkSettings, ...] = ()
    """Link segments; none: the IRB 140's, or derived from the URDF's collision shapes, meshes (STL, Collada, OBJ) among
    them."""
    tool_links: tuple[LinkSettings, ...] = ()
    """Further link segments, of what is mounted at the tool; also beside the IRB 140's."""
    acceleration: tuple[Positive, ...] = ()
    """Joint acceleration limits [rad/s^2]; none: top speed / T_s of every axis."""


class Plan(Section):
    """Section 5: the trajectory generator."""

    method: Literal["qp", "scaling", "shield", "ssm", "none"] = "qp"
    """qp: Eq. (66); scaling: the largest factor on the programmed speed that meets the same constraints [24];
    shield: the programmed speed while the next stop is certified; ssm: stop and go by the protective separation
    distance of ISO/TS 15066; none: the programme, whoever is there."""
    baselines: tuple[Literal["qp", "scaling", "shield", "ssm", "none"], ...] = ("scaling", "none")
    """Methods run beside it, for comparison."""
    horizon: Literal["adaptive", "fixed"] = "adaptive"
    """adaptive: the volumes reach to the end of the stop that would follow; fixed: always to prediction.stop_s."""
    certify: bool = True
    """Whether a step is taken only if it and the stop after it keep clear of every volume; else the stop that was found
    clear before goes on. False: as printed, where Eq. (67) brakes when Eq. (66) has no solution."""
    rows: Literal["soft", "hard"] = "soft"
    """qp: whether Eq. (66i) may be broken at a cost, so that there is always a solution, or not."""
    constraint_rhs: Literal["product", "square"] = "product"
    """Right-hand side of Eq. (14): distance (distance - clearance), or (distance - clearance)^2 as printed."""
    lead_s: NotNegative = 0.05
    """The rows of Eq. (66i) look this much further ahead than the horizon, so that the robot slows down early [s]."""
    give_way_m: NotNegative = 0.03
    """qp: the robot moves away from a volume that is nearer than this [m]."""
    jerk_s: NotNegative = 0.03
    """qp: time from no acceleration to the largest; 0: any change within a tick [s]."""
    smooth_s: NotNegative = 0.08
    """qp: time constant with which the velocity approaches the best one that keeps the rows; 0: as fast as the limits
    allow [s]."""
    retreat_m: NotNegative = 0.03
    """qp: a robot that is inside a volume by no more than this moves out of it, at 0.25 m/s at most, if no point of it
    comes nearer to any point of the volume; deeper inside, or with 0, it stands [m]."""
    posture: NotNegative = 0.01
    """qp: weight of the way back to the programmed joint positions, relative to the cost as printed."""
    human_speed: Positive = 1.6
    """ssm: speed at which a person may approach, ISO 13855 [m/s]."""
    task: Path | None = None
    """Task file (TOML); none: the one inside the log, else the joint track inside the log."""
    reference: Literal["time", "path"] = "path"
    """time: the reference runs with the clock; path: only as far as the robot has followed."""
    max_reference_lead_m: Positive = 0.4
    """path: the reference waits when the TCP is this far away, so no way round a person leads further off [m]."""
    catch_up_speed_m_per_s: NotNegative | Literal["free"] = 0.0
    """qp: the TCP is never faster than the programme's speed limit where the reference is, not even to catch up; this
    speed is allowed where that limit is lower; free: only tcp_speed_max bounds it [m/s]."""
    waypoint_m: Positive = 0.02
    """path: the reference leaves a waypoint when the TCP has come this close [m]."""
    q_p: tuple[NotNegative, NotNegative] = (0.10, 0.10)
    """Eq. (71): weights of the position error, translation and orientation."""
    q_v: tuple[NotNegative, NotNegative] = (1.0, 1.0)
    """Eq. (72): weights of the velocity error, translation and orientation."""
    path_gain_per_s: NotNegative = 5.0
    """Position error fed into the reference velocity [1/s]; 0 as printed: no error decays, so use reference "time"."""
    clearance_m: NotNegative = 0.0
    """Clearance beyond limb radius + link radius [m]."""
    tcp_speed_max: Positive = 2.5
    """Eq. (66g), each axis of the world [m/s]; the rotation's bound is 2 pi rad/s for each 2.5 m/s."""
    tcp_acceleration_max: Positive = 25.0
    """Eq. (66h), corrected, each axis of the world [m/s^2]."""


class Report(Section):
    """Computation of metrics and figures."""

    near_m: Positive = 0.50
    """The stationary share counts ticks with a separation of at most this [m]."""
    stationary_m_per_s: Positive = 0.001
    """A TCP slower than this stands [m/s]."""
    leg_radius_m: NotNegative = 0.08
    """Radius of thighs and shanks of the recorded person, of which Table 2 says nothing [m]."""


class ZenohKey(Section):
    """The Zenoh keys of one camera."""

    key: str
    """Key expression: 0/kinect/skeleton/** of rmw_zenoh, kinect/skeleton of the DDS bridge."""
    payload: Literal["hrcreplay", "cdr"] = "hrcreplay"
    """Our own message, or the CDR of a ROS 2 system."""
    type: str | None = None
    """cdr: message type; none: as the keys of rmw_zenoh tell."""
    definition: str = ""
    """cdr: text of the type's .msg, where no release of ROS 2 has it."""
    points: str | None = None
    """cdr: path to the points in a type without a decoder of its own, as in logs.decoders."""
    index: dict[str, int] = Field(default_factory=dict)
    """cdr: which element is which body point."""
    unit: Literal["m", "mm"] = "m"
    """cdr: unit of the points, also of markers and transforms."""
    stamp: str | None = "header.stamp"
    """cdr: path to the capture time; "none": the arrival time is used."""
    confidence: str | None = None
    """cdr: path to an array of confidences."""


class Zenoh(Section):
    """Live skeletons over Zenoh."""

    mode: Literal["peer", "client"] = "peer"
    """How we take part."""
    connect: tuple[str, ...] = ()
    """Endpoints to connect to, as tcp/192.168.0.1:7447."""
    listen: tuple[str, ...] = ()
    """Endpoints to listen on."""
    scouting: bool = False
    """Whether to look for others by multicast."""
    keys: dict[str, ZenohKey] = Field(default_factory=dict)
    """Camera -> where its skeletons are."""
    config: Path | None = None
    """File of Zenoh's own configuration, with its authentication and encryption, in place of mode to scouting."""
    secret: Path | None = None
    """File of a secret shared with the cameras: then frames without a seal made with it are not used."""
    sources: tuple[str, ...] = ()
    """secret: names of the sources that may seal frames; empty: whoever has the secret."""
    late_s: Positive = 0.3
    """secret: a frame whose seal is older or newer by our clock is not used [s]."""

    @model_validator(mode="after")
    def _one_of_both(self) -> Zenoh:
        """Refuses what a configuration of its own would silently leave out."""
        if self.config is not None and (self.connect or self.listen or self.scouting or self.mode != "peer"):
            raise ValueError("config has mode, connect, listen and scouting in it; would be right: one of both")
        return self


class Live(Section):
    """The live session: EGM link, watchdog, person."""

    port: Annotated[int, Field(ge=0, le=65535)] = 6510
    """UDP port at which the robot's packets arrive."""
    robot_address: Ipv4 = "127.0.0.1"
    """The robot's address, the only one that is heard; as it is, that of a robot double on this machine."""
    listen_address: Ipv4OrNone = ""
    """Address of ours to listen on; empty: that from which the robot is reached."""
    joint_order: tuple[int, ...] = ()
    """Axis of the robot, 1 next to its base, that each joint of EGM is, external ones last; empty: as they stand.
    [1, 2, 4, 5, 6, 7, 3] for a YuMi, whose seventh joint is its third axis."""
    cycle_s: Annotated[float, Field(ge=0.001, le=0.1)] = 0.004032
    """The robot's cycle: every answer moves the reference by this much time [s]."""
    reaction_s: NotNegative = 0.05
    """Latency from perception to robot response: up to two cycles until a look is used, the delay of an answer, a cycle
    and the robot's own lag. The swept volumes of method sound reach this much further than T_s [s]."""
    perception_max_age_s: Positive = 0.016
    """plan.certify: largest age of a perception update that a step may use; after it the certified stop goes on [s]."""
    approach_speed: Annotated[float, Field(gt=0, le=1)] = 0.1
    """Share of the axes' top speeds on the way from where the robot stands to its programme."""
    resume: bool = False
    """Whether motion goes on by itself once the reason of a stop is gone."""
    resume_s: Positive = 1.0
    """How long it must be gone before that [s]."""
    uncertain_m: Positive = 0.2
    """A larger standard deviation of the person's position stops the robot [m]."""
    uncertain_rad: Positive = 0.8
    """The same for heading and bend of the trunk [rad]."""
    person_late_s: Positive = 0.2
    """The human side's process without a sign of life for longer stops the robot [s]."""
    overrun_s: Positive = 0.02
    """An answer later than this stops the robot [s]."""
    silent_s: Positive = 0.1
    """A robot that sends nothing for longer counts as gone [s]."""
    tracking_rad: Positive = 0.2
    """A robot further than this from its reference stops [rad]."""
    utilization_max: Positive = 100.0
    """A robot above this cannot follow, and stops [%]."""
    keep_recorder: bool = True
    """Whether the robot stops when nobody records any more."""
    disk_start_mb: NotNegative = 1000.0
    """A session does not begin with less space on the disk of its record, which takes some 30 MB a minute [MB]."""
    disk_low_mb: NotNegative = 200.0
    """With less the robot stops, so that the record of its stop finds room [MB]."""
    real_time: bool = True
    """Whether to ask the system to run the control loop before all else and to keep it in memory."""
    zenoh: Zenoh = Zenoh()
    """Where live skeletons come from when no recording is played."""


class Settings(Section):
    """Everything a run depends on beside the log and the cell."""

    logs: Logs = Logs()
    fusion: Fusion = Fusion()
    limits: LimitNames = LimitNames()
    prediction: Prediction = Prediction()
    robot: Robot = Robot()
    plan: Plan = Plan()
    report: Report = Report()
    live: Live = Live()


def setting(recorded: Mapping[str, Any], section: str, key: str) -> Any:
    """A setting as a run recorded it, or its default where the run did not.

    Args:
        recorded: ``settings`` of run.json.
        section: Name of the section.
        key: Name of the setting.
    """
    known, _ = with_new_names(recorded)
    return known.get(section, {}).get(key, getattr(getattr(Settings(), section), key))


#: Names of sections and of settings before version 0.9; read for one version more.
RENAMED = {
    "occupancy": "prediction",
    "plan.leash_m": "plan.max_reference_lead_m",
    "plan.room": "plan.constraint_rhs",
    "live.look_s": "live.perception_max_age_s",
}


def with_new_names(table: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Replace the old names of sections and settings by the new ones.

    Args:
        table: Section -> key -> value.

    Returns:
        The table by new names, and old name -> new name of those that it had. A name that is there in both forms
        stays as it is, so that it is refused as unknown.
    """
    found: dict[str, Any] = dict(table)
    replaced = {}
    for old, new in RENAMED.items():
        section, _, key = old.partition(".")
        if not key and section in found and new not in found:
            found[new] = found.pop(section)
            replaced[old] = new
        elif key and isinstance(within := found.get(section), Mapping) and key in within:
            name = new.partition(".")[2]
            if name not in within:
                found[section] = {name if k == key else k: value for k, value in within.items()}
                replaced[old] = new
    return found, replaced
