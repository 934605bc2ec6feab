"""Every setting, with its unit and its default, in sections. Defaults are the paper's where it gives one.

The stages take these sections unchanged; only the drivers load them from files. docs/paper.md lists the corrections of
equations marked as corrected.
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
    """A group of settings; it is frozen, and an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    @model_validator(mode="before")
    @classmethod
    def _none(cls, given: Any) -> Any:
        """Converts the word "none" to a missing value for optional settings, as TOML has no null."""
        if not isinstance(given, dict):
            return given
        fields = cls.model_fields
        optional = {name for name, field in fields.items() if type(None) in get_args(field.annotation)}
        return {name: None if value == "none" and name in optional else value for name, value in given.items()}


Axis = Literal["x", "-x", "y", "-y", "z", "-z"]


class Decoder(Section):
    """Description of a topic with skeletons of people, from the message down to a body's points.

    A path is fields joined by dots. A number in it takes an element of a list; a name behind a list is taken from each
    element, and lists in lists are joined. Alternatives stand with | between: the first that exists counts.
    """

    topic: str
    """Topic of the messages."""
    camera: str | None = None
    """Name for the sensor; none: the topic's, or for transforms that of the frame in which they are."""
    preset: str | None = None
    """Shipped description to begin with; keys given here replace its keys. none: none."""
    bodies: str | None = None
    """Path to the list of bodies in the message; none: the message is one body."""
    only: dict[str, bool | int | str] = Field(default_factory=dict)
    """Path in a body -> value that it must have; other bodies are left out."""
    points: str | None = None
    """Path to the array of points, in a body or, without bodies, in the message."""
    numbers: Annotated[int, Field(ge=3)] | None = None
    """Numbers per point, where the array is one of numbers; the first three are the position."""
    body: str | None = None
    """Path in a body to its number or name; without bodies, in a point: points of one value are a body. none: bodies
    are numbered as in the list."""
    name: str | None = None
    """Path in a point to its name or number; none: its place in the array."""
    position: str | None = None
    """Path in a point to its position: x, y, z, a pose, or three numbers; none: the point itself."""
    frames: tuple[str, ...] = ()
    """Transforms: patterns of the joints' frames; {joint} is the joint, {user} digits, {id} five letters, * any."""
    index: dict[str, int | str] | str = Field(default_factory=dict)
    """Body point -> place or name of its point; a + b: their middle; a | b: the first that exists. Names compare
    without case, spaces and underscores. Or the name of a shipped order: points, names, azure, kinect2, mediapipe..."""
    unit: Literal["m", "cm", "mm"] = "m"
    """Unit of the points."""
    axes: tuple[Axis, Axis, Axis] = ("x", "y", "z")
    """The message's axes along which x, y and z of the log lie, as ["x", "-z", "y"]; no mirror image."""
    stamp: str | None = "header.stamp"
    """Path to the capture time; "none": the arrival time."""
    confidence: str | float | None = None
    """Path in a point, or to a number or an array of numbers, one per point, in a body or message; or a constant. none:
    every finite point has confidence 1."""
    confidence_max: Positive = 1.0
    """The value of a confidence that means certain."""

    def model_post_init(self, _context: Any) -> None:
        """Rejects unknown body points, axes that mirror, and a description of nothing."""
        if isinstance(self.index, dict):
            unknown = sorted(set(self.index) - set(POINTS))
            if unknown:
                raise ValueError(f"unknown body point {unknown[0]!r}; known are {', '.join(POINTS)}")
        if not is_rotation(self.axes):
            raise ValueError(f"axes: found {', '.join(self.axes)}; would be right: each axis once, and no mirror image")
        if self.preset is None and self.points is None and not self.frames:
            raise ValueError("found neither points, frames nor preset; name the points of a body")


def is_rotation(axes: tuple[Axis, Axis, Axis]) -> bool:
    """Returns True if the axes are those of a right-handed system, each once."""
    order = tuple("xyz".index(axis[-1]) for axis in axes)
    if sorted(order) != [0, 1, 2]:
        return False
    even = order in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    return even == (sum(axis.startswith("-") for axis in axes) % 2 == 0)


class RobotCapsules(Section):
    """Decoder of a robot that is recorded by the capsules of its links, in the frame of its base [m]."""

    topic: str
    """Topic of the messages."""
    capsules: str = "capsules.capsules"
    """Path to the array of capsules in the message, fields joined by dots."""
    start: str = "p1"
    """Field of a capsule: one end of its axis, with x, y, z."""
    end: str = "p2"
    """Field of a capsule: the other end; that of the last capsule is the TCP."""
    radius: str = "r"
    """Field of a capsule: its radius."""
    stamp: str | None = "header.stamp"
    """Path to the time of the message; "none": the arrival time."""


class Logs(Section):
    """Reading logs."""

    topics: tuple[str, ...] = ()
    """Skeleton topics to read; none: all with a decoder."""
    decoders: tuple[Decoder, ...] = ()
    """Decoders for message types that the package cannot read itself."""
    unit: Literal["m", "cm", "mm"] = "m"
    """Unit of the positions in markers, transforms and topics of a shipped preset."""
    world_frame: str | None = None
    """Frame of /tf_static that is the world, with z up and the floor at 0; none: world or map. Poses of cameras and
    robot base in it are taken where the cell gives none."""
    base_frame: str | None = None
    """Frame of /tf_static that is the robot's base; none: base_link, base or robot_base."""
    marker_ids_per_body: Annotated[int, Field(ge=1)] | None = None
    """Number of marker ids per body; the first ids of each body are the joints; none: 100, or 33 or 32 if only that
    fits the ids in the log."""
    joints_topic: str | None = None
    """Topic of the robot's joint states; none: all topics of sensor_msgs/JointState and of hrcreplay's own type, joined
    by joint."""
    joint_names: tuple[str, ...] = ()
    """Names of the robot's joints in the log, in the order of the axes; none: as in the robot."""
    joints_unit: Literal["rad", "deg"] = "rad"
    """Unit of the joint positions."""
    joints_offset_s: Annotated[float, Field(ge=-4e9, le=4e9)] | None = None
    """The robot's clock minus the log's; none: 0, or estimated if the stamps are clearly from another clock [s]."""
    robot_capsules: RobotCapsules | None = None
    """Capsules of the recorded robot, used if the log has no joints of the robot; none: those of a topic of the type
    reachable_occupancy/ReachableOccupancy."""
    people: Literal["all", "nearest"] = "all"
    """all: every body is tracked, predicted, and kept clear of; nearest: only the person that ``person_jump_m`` and
    ``person_memory_s`` choose, at first the body nearest to its camera."""
    person_jump_m: Positive = 0.8
    """A body further than this from a person's last position is another person [m]."""
    person_memory_s: Positive = 2.0
    """A person unseen for this time is forgotten; the last one is unknown until the nearest body becomes the person
    [s]."""
    gap_s: Positive = 0.2
    """A longer time without frames counts as a gap of the camera [s]."""

    def model_post_init(self, _context: Any) -> None:
        """Rejects a joint name that is given for two axes."""
        twice = [name for name in self.joint_names if self.joint_names.count(name) > 1]
        if twice:
            raise ValueError(f"found {twice[0]!r} for two axes in joint_names; name each joint once")


class Fusion(Section):
    """Section 4: the Kalman filter.

    The sigmas and ``coast_s`` minimise the error against ground truth in a sweep on a recording with two cameras of 25
    and 30 Hz, 1-3 cm of noise and occlusions. The velocity's sigma dominates: people reach and rest, and a polynomial
    with a large jerk overshoots at both ends. On that recording, ignoring delays gives the smaller error while people
    stand, and compensating them while people move; the latter matters for safety.
    """

    rate_hz: Annotated[float, Field(gt=0, le=2000, allow_inf_nan=False)] = 250.0
    """Ticks a second of the filter and the controller [Hz]."""
    stale: Literal["skip", "reuse"] = "skip"
    """Between two frames of a camera: skip its rows, or reuse them with the sawtooth covariance of 4.1.1."""
    delay: Literal["compensate", "ignore"] = "compensate"
    """compensate: a frame measures the state at its capture time; ignore: the state at the tick."""
    confidence_min: Share = 0.2
    """An angle is used when the product of the confidences of its points is at least this."""
    outlier_m: Positive = 0.20
    """A point further than this from the predicted skeleton counts as an outlier [m]."""
    relearn_s: Positive = 0.1
    """Accept an outlier seen in one place for this time, if no camera sees the point near the filter's estimate [s]."""
    bone_m: Positive = 0.10
    """A point also counts as an outlier if its bone is longer or shorter than the person's by more than this [m]."""
    bone_memory_s: Positive = 5.0
    """Accept such an outlier after no camera has seen the expected bone length for this time [s]."""
    point_std_m: Positive = 0.02
    """Standard deviation of a skeleton point at full confidence [m]."""
    point_std_per_m: NotNegative = 0.0
    """Increase of that standard deviation with the distance from the camera [m/m]."""
    sigma_position: Sigmas = (300.0, 100.0, 5.0, 1.0)
    """Sigmas of Eq. (44) for x and y: p, v, a, j [m/s^2, m/s^2.5, m/s^3, m/s^3.5]."""
    sigma_height: Sigmas = (300.0, 200.0, 5.0, 1.0)
    """The same for z; larger, as people stand up faster than they walk."""
    sigma_angle: Sigmas = (1500.0, 600.0, 10.0, 1.0)
    """The same for the angles [rad]."""
    coast_s: Positive = 0.12
    """After this time without a valid row, a joint decelerates to rest in the estimate [s]."""
    delay_max_s: Positive = 0.25
    """Maximum age of a frame in the delay compensation; an older frame gets this age [s]."""
    residual_quantile: Share = 0.9
    """Quantile of the distance between each limb's measured points and the model that is tracked."""
    residual_memory_s: Positive = 20.0
    """Time constant of the weights of measured distances [s]."""
    residual_hold_s: NotNegative = 0.15
    """Time for which a distance above the quantile is used, unless a larger one follows [s]."""
    offset_memory_s: Positive = 0.5
    """Time constant of the running mean offset of shoulders, head and arms from the model [s]."""
    spread_memory_s: Positive = 1.0
    """The reported variances are scaled by the maximum normalised innovation squared, which decays to 1/e in this time
    [s]."""
    spread_least: Positive = 0.01
    """Minimum factor on the reported variances."""
    spread_most: Positive = 30.0
    """Maximum factor on the reported variances."""
    memory_s: Positive = 0.5
    """After this time without a valid row, a joint is lost: it restarts from the next valid row, and until then its
    limb may have moved as far as the limits allow [s]."""
    fresh_s: Positive = 0.3
    """Maximum age of a frame since its capture. An older frame is dropped; a person whose newest frame is older is
    unknown, and the robot brakes, also in a live session [s]."""


class LimitNames(Section):
    """Named limit sets (paper, human, people) or paths of TOML files."""

    tracking: str = "human"
    """Limit set for the filter's state, Eq. (62)-(65)."""
    prediction: str = "people"
    """Limit set for the reachable sets, Alg. 1. people: fitted on recordings; see docs/validation.md."""


class Prediction(Section):
    """Section 3: the space that the person can reach."""

    method: Literal["paper", "positions", "sound"] = "sound"
    """sound: encloses every motion within the limits, of whole limbs if the limits bound departures, else of the
    joints; paper: Eq. (20)-(30) and Alg. 1, 2 as printed; positions: from positions and velocity bounds alone [26]."""
    stop_s: Positive = 0.377
    """Worst-case braking time T_s of the robot, Eq. (70) [s]."""
    store_hz: Positive | Literal["all"] = 25.0
    """Rate of the ticks whose volumes are stored, or "all" [Hz]."""
    radius_head_m: NotNegative = 0.12
    """Table 2 [m]."""
    radius_thorax_m: NotNegative = 0.15
    """Table 2 [m]."""
    radius_upper_arm_m: NotNegative = 0.07
    """Table 2 [m]."""
    radius_lower_arm_m: NotNegative = 0.07
    """Table 2 [m]."""

    sigmas: NotNegative = 1.0
    """sound: number of standard deviations around the estimate that are enclosed, in all joints at once; not used for
    limbs with bounded departures, which were measured from the estimate."""
    latency_s: NotNegative = 0.0
    """sound: time from the newest capture to the robot's reaction; it is added to the horizon [s]."""
    hand_m: NotNegative = 0.19
    """sound: length of the hand beyond the wrist [m]."""
    legs_radius_m: Positive = 0.20
    """sound: minimum radius of the lower body around the line from the floor to the pelvis; it grows if legs are seen
    further off, as while sitting or squatting [m]."""
    legs: bool = True
    """sound: include a volume for the lower body."""
    residual: bool = True
    """sound: add the distance between the measured body and the model to the radii."""
    residual_unknown_m: NotNegative = 0.10
    """sound: value of that distance until enough measurements exist [m]."""


class LinkSettings(Section):
    """One link segment of a robot."""

    name: str
    """Name in outputs."""
    body: str
    """Body (URDF link or joint frame) to which both ends are fixed."""
    start_m: tuple[float, float, float]
    """First end in that body's frame [m]."""
    end_m: tuple[float, float, float]
    """Second end in that body's frame [m]."""
    radius_m: Positive
    """Radius of the capsule [m]."""


class Offset(Section):
    """A pose in another frame."""

    position_m: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """Its origin [m]."""
    rpy_deg: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """Its orientation, Rz(yaw) Ry(pitch) Rx(roll) [deg]."""


class Robot(Section):
    """The manipulator. Default: ABB IRB 140."""

    urdf: Path | None = None
    """URDF of another robot; none: the IRB 140. Joints that do not lie between base and tool are locked at zero. A
    relative path in a settings file is searched beside that file first, like packages, plan.task and limit files."""
    srdf: Path | None = None
    """SRDF of the robot: the pairs of links in its disable_collisions are not kept apart; with it the robot's own links
    are kept apart also in a cell without objects."""
    packages: tuple[Path, ...] = ()
    """Directories of the packages of the meshes in that URDF (package://); searched before the directories at and above
    the URDF and those of ROS_PACKAGE_PATH."""
    base_frame: str | None = None
    """Frame of that URDF whose pose is T_world_base; none: its root."""
    tcp_frame: str | None = None
    """Frame of that URDF that carries the tool; none: the last one moved by revolute joints."""
    tool_m: NotNegative = 0.10
    """TCP beyond the flange, along its z axis [m]."""
    tcp_offset: Offset = Offset()
    """Pose of the TCP relative to that point, for a tool that is not straight."""
    links: tuple[LinkSettings, ...] = ()
    """Link segments; none: the IRB 140's, or derived from the URDF's collision shapes, including meshes (STL, Collada,
    OBJ)."""
    tool_links: tuple[LinkSettings, ...] = ()
    """Additional link segments for parts mounted at the tool; also for the IRB 140."""
    acceleration: tuple[Positive, ...] = ()
    """Joint acceleration limits [rad/s^2]; none: top speed / T_s of every axis."""
    mass_kg: Positive | None = None
    """Mass of the moving parts, for the force of a contact [kg]; none: by the inertias of the URDF, for the IRB 140 the
    98 kg of the whole robot."""
    payload_kg: NotNegative | None = None
    """Mass of tool and workpiece that the URDF lacks [kg]; none: 0, for the IRB 140 its largest payload, 6 kg."""


class Plan(Section):
    """Section 5: the trajectory generator."""

    method: Literal["qp", "scaling", "shield", "ssm", "pfl", "none"] = "qp"
    """qp: Eq. (66); scaling: the largest factor on the programmed speed under the same constraints [24]; shield: the
    programmed speed while the next stop is certified; ssm: stop and go by the protective separation
    distance of ISO/TS 15066; pfl: power and force limiting of ISO/TS 15066, so slow near people that a contact keeps
    its energy limit; none: the programme without reaction to people."""
    baselines: tuple[Literal["qp", "scaling", "shield", "ssm", "pfl", "none"], ...] = ("scaling", "none")
    """Additional methods to run for comparison."""
    horizon: Literal["adaptive", "fixed"] = "adaptive"
    """Horizon of the volumes. adaptive: the end of the stop that would follow; fixed: always prediction.stop_s."""
    certify: bool = True
    """true: a step is taken only if it and the stop after it are clear of every volume; otherwise the last certified
    stop continues. false: as printed, Eq. (67) brakes if Eq. (66) has no solution."""
    rows: Literal["soft", "hard"] = "soft"
    """qp: soft: Eq. (66i) may be violated at a cost, so that a solution always exists; hard: it may not."""
    constraint_rhs: Literal["product", "square"] = "product"
    """Right-hand side of Eq. (14): distance (distance - clearance), or (distance - clearance)^2 as printed."""
    lead_s: NotNegative = 0.05
    """Time added to the horizon in the rows of Eq. (66i), so that the robot slows down early [s]."""
    give_way_m: NotNegative = 0.03
    """qp: distance to a volume below which the robot moves away [m]."""
    jerk_s: NotNegative = 0.03
    """qp: time from zero to maximum acceleration; 0: any change within a tick [s]."""
    smooth_s: NotNegative = 0.08
    """qp: time constant of the approach to the best velocity under the constraints; 0: as fast as the limits allow
    [s]."""
    retreat_m: NotNegative = 0.03
    """qp: maximum penetration of a volume at which the robot moves out, at 0.25 m/s at most and only if no point of it
    approaches any point of the volume; deeper inside, or with 0, it stops [m]."""
    posture: NotNegative = 0.01
    """qp: weight of the return to the programmed joint positions, relative to the printed cost."""
    human_speed: Positive = 1.6
    """ssm: speed at which a person may approach, ISO 13855 [m/s]."""
    contact_limbs: tuple[Literal["THX", "URA", "LRA", "ULA", "LLA", "LEGS"], ...] = (
        *("THX", "URA", "LRA", "ULA", "LLA"),
        "LEGS",
    )
    """pfl: limbs that the slow robot may touch; it stops before the others, and always before the head."""
    task: Path | None = None
    """Task file (TOML); none: the task in the log, else the joint track in the log."""
    waiting_s: Positive | Literal["keep"] = 0.5
    """Programme from recorded joints: a standstill of at least this time in the middle of a move counts as waiting of
    the recorded robot's own safety function and is cut from the programme; keep: none is cut [s]."""
    reference: Literal["time", "path"] = "path"
    """time: the reference advances with the clock; path: only as far as the robot has followed."""
    max_reference_lead_m: Positive = 0.4
    """path: the reference waits if the TCP is this far away; this limits the length of detours around people [m]."""
    catch_up_speed_m_per_s: NotNegative | Literal["free"] = 0.0
    """qp: the TCP speed is limited to the programme's limit at the reference or to this value, whichever is larger,
    also while the robot catches up; free: only tcp_speed_max holds [m/s]."""
    waypoint_m: Positive = 0.02
    """path: the reference leaves a waypoint once the TCP is this close [m]."""
    q_p: tuple[NotNegative, NotNegative] = (0.10, 0.10)
    """Eq. (71): weights of the position error, translation and orientation."""
    q_v: tuple[NotNegative, NotNegative] = (1.0, 1.0)
    """Eq. (72): weights of the velocity error, translation and orientation."""
    path_gain_per_s: NotNegative = 5.0
    """Gain of the position error in the reference velocity [1/s]; 0 as printed: errors do not decay, so use reference
    "time"."""
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
    """A TCP slower than this counts as stationary [m/s]."""
    leg_radius_m: NotNegative = 0.08
    """Radius of thighs and shanks of the recorded person, which Table 2 does not give [m]."""


class ZenohKey(Section):
    """The Zenoh keys of one camera."""

    key: str
    """Key expression: 0/kinect/skeleton/** of rmw_zenoh, kinect/skeleton of the DDS bridge."""
    payload: Literal["hrcreplay", "cdr"] = "hrcreplay"
    """hrcreplay's own message, or the CDR of a ROS 2 system."""
    type: str | None = None
    """cdr: message type; none: taken from the keys of rmw_zenoh."""
    definition: str = ""
    """cdr: text of the type's .msg, for a type that no release of ROS 2 contains."""
    points: str | None = None
    """cdr: path to the points in a type without a built-in decoder, as in logs.decoders."""
    index: dict[str, int] = Field(default_factory=dict)
    """cdr: body point -> index of its element."""
    unit: Literal["m", "mm"] = "m"
    """cdr: unit of the points, also of markers and transforms."""
    stamp: str | None = "header.stamp"
    """cdr: path to the capture time; "none": the arrival time is used."""
    confidence: str | None = None
    """cdr: path to an array of confidences."""


class Zenoh(Section):
    """Live skeletons over Zenoh."""

    mode: Literal["peer", "client"] = "peer"
    """Mode of this Zenoh session."""
    connect: tuple[str, ...] = ()
    """Endpoints to connect to, as tcp/192.168.0.1:7447."""
    listen: tuple[str, ...] = ()
    """Endpoints to listen on."""
    scouting: bool = False
    """Search for other participants by multicast."""
    keys: dict[str, ZenohKey] = Field(default_factory=dict)
    """Camera -> keys of its skeletons."""
    config: Path | None = None
    """File with Zenoh's configuration, including authentication and encryption; replaces mode, connect, listen and
    scouting."""
    secret: Path | None = None
    """File with a secret shared with the cameras; frames without a seal from this secret are then rejected."""
    sources: tuple[str, ...] = ()
    """secret: names of the sources that may seal frames; empty: every source with the secret."""
    late_s: Positive = 0.3
    """secret: maximum difference between the time of a seal and the local clock; other frames are rejected [s]."""

    @model_validator(mode="after")
    def _one_of_both(self) -> Zenoh:
        """Rejects settings that the configuration file would override silently."""
        if self.config is not None and (self.connect or self.listen or self.scouting or self.mode != "peer"):
            raise ValueError("config has mode, connect, listen and scouting in it; would be right: one of both")
        return self


class Live(Section):
    """The live session: EGM link, watchdog, person."""

    port: Annotated[int, Field(ge=0, le=65535)] = 6510
    """UDP port at which the robot's packets arrive."""
    robot_address: Ipv4 = "127.0.0.1"
    """The robot's address; other senders are ignored. Default: a robot double on this machine."""
    listen_address: Ipv4OrNone = ""
    """Local address to listen on; empty: the one on the network of the robot."""
    joint_order: tuple[int, ...] = ()
    """Axis of the robot for each joint of EGM, 1 next to the base, external joints last; empty: same order. [1, 2, 4,
    5, 6, 7, 3] for a YuMi, whose seventh joint is its third axis."""
    cycle_s: Annotated[float, Field(ge=0.001, le=0.1)] = 0.004032
    """The robot's cycle: every answer moves the reference by this much time [s]."""
    reaction_s: NotNegative = 0.05
    """Latency from perception to robot response: up to two cycles until an update is used, the delay of an answer, one
    cycle and the robot's own lag. It is added to the horizon T_s of method sound [s]."""
    perception_max_age_s: Positive = 0.016
    """plan.certify: maximum age of a perception update that a step may use; with an older one the certified stop
    continues [s]."""
    approach_speed: Annotated[float, Field(gt=0, le=1)] = 0.1
    """Share of the axes' top speeds on the way from the initial position to the programme."""
    resume: bool = False
    """Resume motion automatically once the reason for a stop has ended."""
    resume_s: Positive = 1.0
    """Time without that reason before motion resumes [s]."""
    uncertain_m: Positive = 0.2
    """Maximum standard deviation of the person's position; a larger one stops the robot [m]."""
    uncertain_rad: Positive = 0.8
    """The same for heading and bending of the trunk [rad]."""
    person_late_s: Positive = 0.2
    """Maximum time without a heartbeat of the perception process; a longer one stops the robot [s]."""
    overrun_s: Positive = 0.02
    """Maximum delay of an answer; a longer one stops the robot [s]."""
    silent_s: Positive = 0.1
    """After this time without a message, the robot counts as disconnected [s]."""
    tracking_rad: Positive = 0.2
    """Maximum distance of the robot from its reference; a larger one stops it [rad]."""
    utilization_max: Positive = 100.0
    """Maximum utilisation of the robot; above it the robot cannot follow and is stopped [%]."""
    keep_recorder: bool = True
    """Stop the robot if recording fails."""
    disk_start_mb: NotNegative = 1000.0
    """Minimum free disk space to begin a session; its record takes about 30 MB per minute [MB]."""
    disk_low_mb: NotNegative = 200.0
    """Minimum free disk space during a session; below it the robot stops, so that its stop can still be recorded
    [MB]."""
    real_time: bool = True
    """Request real-time priority and locked memory for the control loop."""
    zenoh: Zenoh = Zenoh()
    """Source of live skeletons if no recording is played."""


class Settings(Section):
    """All inputs of a run except the log and the cell."""

    logs: Logs = Logs()
    fusion: Fusion = Fusion()
    limits: LimitNames = LimitNames()
    prediction: Prediction = Prediction()
    robot: Robot = Robot()
    plan: Plan = Plan()
    report: Report = Report()
    live: Live = Live()


def setting(recorded: Mapping[str, Any], section: str, key: str) -> Any:
    """Returns a setting as a run recorded it, or its default if the run did not record it.

    Args:
        recorded: ``settings`` of run.json.
        section: Name of the section.
        key: Name of the setting.
    """
    known, _ = with_new_names(recorded)
    return known.get(section, {}).get(key, getattr(getattr(Settings(), section), key))


#: Old names of sections and settings, accepted in this version only.
RENAMED = {
    "occupancy": "prediction",
    "plan.leash_m": "plan.max_reference_lead_m",
    "plan.room": "plan.constraint_rhs",
    "live.look_s": "live.perception_max_age_s",
}


def with_new_names(table: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Replaces the old names of sections and settings by the new ones.

    Args:
        table: Section -> key -> value.

    Returns:
        The table with new names, and old name -> new name of the replaced ones. If both forms of a name are present,
        the old one is kept and later rejected as unknown.
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
