"""Opens a log of any supported format and reads its records in order of time; finds its skeleton topics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from hrcreplay.errors import LogError
from hrcreplay.logs import joints, log_files, messages, plausibility, presets
from hrcreplay.logs.capsule_track import CapsuleTrack, find_capsules, read_capsules
from hrcreplay.logs.cleaning import DEFECTS, STILL_M, STILL_S, Cleaner
from hrcreplay.logs.clocks import ArrivalOrder, CameraClock, clock_remarks
from hrcreplay.logs.decoders import DECODABLE, GenericDecoder, OwnDecoder, describe_arrays, frame_of, points_lacking
from hrcreplay.logs.joints import JointReading, JointTopic, JointTrack
from hrcreplay.logs.log_files import Header, LogFiles, Truth, open_source
from hrcreplay.logs.markers import MARKER_TYPE, MarkerDecoder, MarkerLayout, survey_markers
from hrcreplay.logs.messages import SkeletonDecoder, Topic, Undecodable, topic_list
from hrcreplay.logs.transforms import (
    TF_TYPES,
    FrameNames,
    Link,
    StaticPoses,
    TfDecoder,
    describe_transforms,
    find_poses,
    static_links,
    survey_people,
)
from hrcreplay.records import NOBODY, AxisFrame, CameraFrames
from hrcreplay.settings.sections import Decoder, Logs

_OWN = "hrcreplay.Skeleton"
_BODIES = "body_tracking"  # in the name of a topic: it carries bodies, even without a person in view
_NO_BODIES = (
    "sensor_msgs/JointState",
    "hrcreplay.JointState",
    "hrcreplay.RobotCapsules",
    "hrcreplay.Truth",
    "hrcreplay.Task",
    "rcl_interfaces/Log",
)
_PEEK = 300  # number of messages in which bodies by a preset are looked at
_FEW = 10  # with fewer bodies, proportions are not judged
_HOW = "Name a topic with --topic NAME, or a decoder for it in [[logs.decoders]] of the settings file."
_NO_SETTING = (
    "No setting makes bodies of these topics: write the bodies into a log of ours with "
    "hrcreplay.logs.writer.LogWriter, or publish them as markers of the Azure Kinect."
)


#: Default options for reading a log.
DEFAULT = Logs()


@dataclass(frozen=True)
class Chosen:
    """The decoders of a log's skeleton topics, and remarks on topics without one."""

    decoders: list[SkeletonDecoder]
    remarks: list[str]
    static: dict[str, Link] = field(default_factory=dict)  #: child -> its static transform


def choose_decoders(source: LogFiles, options: Logs) -> Chosen:
    """Chooses the decoders of a log's skeleton topics.

    Args:
        source: The log's files.
        options: Topics named by the user, () for all with a decoder; decoders described in the settings, which read
            their topics; units and numbering of markers.

    Returns:
        One decoder per topic; none if no topic carries skeletons.

    Raises:
        LogError: A named topic is not in the log, or carries no skeletons.
        SettingsError: A decoder names an unknown preset or order of points.
    """
    found = {topic.name: topic for topic in source.topics()}
    for name in (*options.topics, *(decoder.topic for decoder in options.decoders)):
        if name not in found:
            raise LogError(f"{source.path}: no topic {name}; found {topic_list(found.values())}")
    static = static_links(source.messages(names)) if (names := _static_topics(source)) else {}
    chosen = Chosen([], [], static)
    by_topic = {
        decoder.topic: _described(source, found[decoder.topic], decoder, static) for decoder in options.decoders
    }
    for topic in found.values():
        if options.topics and topic.name not in options.topics:
            continue
        decoder = by_topic.get(topic.name) or _known(source, topic, options, chosen)
        if decoder is not None:
            chosen.decoders.append(decoder)
        elif options.topics:
            told = "".join(f": {remark}" for remark in chosen.remarks[-1:])
            raise LogError(f"{source.path}: no skeletons on {topic.name} ({topic.type}){told}. {_HOW}")
    if not chosen.decoders:
        chosen.remarks.extend(_descriptions(source))
    _check_cameras(source, chosen.decoders)
    return chosen


def no_skeletons_error(source: LogFiles, remarks: list[str]) -> LogError:
    """Returns the error for a log without skeleton topics, with a remedy."""
    told = "".join(f"\n{remark}." for remark in remarks)
    how = skeletons_remedy(source.topics(), remarks)
    text = f"{source.path}: no skeleton topic; found {topic_list(source.topics())}.{told}\n{how}"
    return LogError(text if len(remarks) > 1 else text.replace("\n", " "))


def skeletons_remedy(topics: Sequence[Topic], remarks: Sequence[str]) -> str:
    """Returns a remedy for a log without skeletons.

    Args:
        topics: All topics of the log.
        remarks: Remarks on them.
    """
    helped = any(topic.type == MARKER_TYPE for topic in topics) or any(DECODABLE in remark for remark in remarks)
    return _HOW if helped else _NO_SETTING


def _static_topics(source: LogFiles) -> list[str]:
    return [topic.name for topic in source.topics() if topic.type in TF_TYPES and topic.name.endswith("tf_static")]


def _described(source: LogFiles, topic: Topic, decoder: Decoder, static: dict[str, Link]) -> SkeletonDecoder:
    """Returns the decoder that a description of the settings stands for."""
    hows = presets.variants(decoder)
    if not hows[0].frames:
        lacks = points_lacking(hows, source.messages([topic.name])) if decoder.preset is not None else ""
        return GenericDecoder(hows, frame_of(source.messages([topic.name])), lacks)
    people = _people(source, topic, hows[0], static)
    if people is None:
        text = describe_transforms(source.messages([topic.name]))
        raise LogError(
            f"{source.path}: {topic.name}: found no frame with six joints by logs.decoders; {topic.name} {text}"
        )
    return people


def _people(source: LogFiles, topic: Topic, how: Decoder, static: dict[str, Link]) -> TfDecoder | None:
    """Returns the decoder of people in a tf topic; None if there are none by these names."""
    survey = survey_people(source.messages([topic.name]), FrameNames(how), static)
    cameras = tuple(survey.frames)
    return TfDecoder(topic.name, cameras, how.unit, how, survey, static) if cameras else None


def _known(source: LogFiles, topic: Topic, options: Logs, chosen: Chosen) -> SkeletonDecoder | None:
    if not topic.count:
        return None
    if topic.type == _OWN:
        return OwnDecoder(topic.name, messages.camera_of_topic(topic.name))
    if topic.type == MARKER_TYPE:
        return _markers(source, topic, options, chosen.remarks)
    described = presets.of_type(topic.type, topic.name, options.unit)
    if topic.type in TF_TYPES:
        if topic.name in _static_topics(source):
            return None
        people = [_people(source, topic, hows[0], chosen.static) for hows in described]
        return max((found for found in people if found is not None), key=lambda found: found.joints, default=None)
    return _preset(source, topic, described[0], chosen.remarks) if described else None


def _preset(source: LogFiles, topic: Topic, hows: tuple[Decoder, ...], remarks: list[str]) -> SkeletonDecoder | None:
    """Returns the decoder of a topic by a preset; None, with a remark, if it gives no bodies of people."""
    try:
        lacks = points_lacking(hows, source.messages([topic.name]))
        decoder = GenericDecoder(hows, frame_of(source.messages([topic.name])), lacks)
        peek = islice(source.messages([topic.name]), _PEEK)
        rows = [row.points_m for message in peek for row in decoder.rows(message) if row.body != NOBODY]
    except LogError as error:
        remarks.append(f"{topic.name} ({topic.type}) is left out: {error}")
        return None
    ratio = plausibility.bone_ratio(np.array(rows)) if len(rows) >= _FEW else 1.0
    if ratio <= plausibility.PROPORTION:
        return decoder
    remarks.append(
        f"{topic.name} ({topic.type}) is left out: its points in the order of preset {hows[0].preset!r} are no person, "
        f"{ratio:.1f} times as tall by one bone as by another; another order {DECODABLE} by topic, preset and index"
    )
    return None


def _markers(source: LogFiles, topic: Topic, options: Logs, remarks: list[str]) -> SkeletonDecoder | None:
    """Returns the decoder of a marker topic; None, with a remark, if its markers are not bodies."""
    layout = survey_markers(source.messages([topic.name]), options.marker_ids_per_body)
    if isinstance(layout, MarkerLayout):
        return MarkerDecoder(topic.name, layout, unit=options.unit)
    expected = bool(options.topics) or _BODIES in topic.name
    if layout.certain and _BODIES in topic.name:
        raise LogError(
            f"{source.path}: {topic.name}: found {layout.found}; would be right: a body's 32 joints of the Azure "
            "Kinect by their ids, how many ids a body has in logs.marker_ids_per_body, or other topics with --topic"
        )
    if layout.certain:
        remarks.append(f"{topic.name} is left out, as its markers are no skeletons: found {layout.found}")
        return None
    return MarkerDecoder(topic.name, layout.layout, unit=options.unit) if expected else None


def _descriptions(source: LogFiles) -> Iterator[str]:
    """Describes the topics of a log without skeletons that may contain bodies."""
    for topic in source.topics():
        if not topic.count or topic.type in _NO_BODIES:
            continue
        try:
            if topic.type in TF_TYPES:
                yield f"{topic.name} {describe_transforms(source.messages([topic.name]))}"
            elif topic.type != MARKER_TYPE:
                yield f"{topic.name} ({topic.type}) {describe_arrays(source.messages([topic.name]))}"
        except Undecodable as error:
            yield str(error)


def _check_cameras(source: LogFiles, decoders: list[SkeletonDecoder]) -> None:
    met: dict[str, str] = {}
    for decoder in decoders:
        for camera in decoder.cameras:
            if camera in met:
                raise LogError(
                    f"{source.path}: {met[camera]} and {decoder.topic} are both camera {camera!r}; "
                    "choose topics with --topic, or give another name in [logs.decoders]"
                )
            met[camera] = decoder.topic


_LATE_NS = 10**9  # s, minimum absence of a camera at either end of the log for a remark
_CONTRADICTING = 0.05  # share of a camera's rows
_FROZEN_S = 0.5  # s, minimum time of a repeated skeleton for a remark
#: Defects with a remark: points marked as missing, and repeated rows.
_TOLD = ("points_at_origin", "points_coincident", "points_not_finite", "points_too_far")


class Log:
    """An open log. ``defects`` (names: clean.DEFECTS) and ``notes`` refer to the latest pass over its frames."""

    def __init__(self, source: LogFiles, chosen: Chosen, options: Logs) -> None:
        self._source = source
        self._decoders = decoders = chosen.decoders
        poses = _static_poses(source, chosen, options)
        self._topic_remarks = [*chosen.remarks, *poses.notes]
        self._options = options
        self._joint_topics = joints.find_topics(source, options.joints_topic)
        self._capsules = find_capsules(source, options.robot_capsules)
        self._truth = log_files.truth_topic(source)
        self._reading: Counter[str] = Counter()
        self._remarks: list[str] = []
        self._refusals: list[str] = []
        self._track: Counter[str] = Counter()
        self.joint_notes: tuple[str, ...] = ()  #: remarks of the latest reading of the joints
        self.clocks: dict[str, CameraClock] = {}  #: camera -> its clock in the latest pass
        self.stature_m: dict[str, float] = {}  #: camera -> stature of its bodies in the latest pass; NaN: unknown
        self.side_cue: dict[str, str | None] = {}  #: camera -> cue for left and right; None: not checked
        self.points_seen = 0  #: number of points with a position and a confidence in the latest pass
        self.header = _header(source, decoders, self._joint_topics, self._truth, poses, chosen=bool(options.topics))

    @property
    def defects(self) -> Counter[str]:
        """Defects found so far: in the files, in the latest pass over the frames and over the joints."""
        found = self._source.damage().defects + self._track
        found.update(self._reading)  # keeps counts of zero, unlike +
        return Counter(dict(sorted(found.items())))

    @property
    def joint_defects(self) -> Counter[str]:
        """The part of ``defects`` from the latest pass over the joints."""
        return Counter(self._track)

    @property
    def notes(self) -> list[str]:
        """Remarks for the user."""
        return [*self._source.damage().notes, *self._topic_remarks, *self._remarks]

    @property
    def skeletons_remedy(self) -> str:
        """Returns a remedy for a log without skeletons."""
        return skeletons_remedy(self.topics, self._topic_remarks)

    @property
    def topics(self) -> list[Topic]:
        """All topics of the log."""
        return self._source.topics()

    def frames(
        self, start_ns: int | None = None, end_ns: int | None = None, *, nobody: bool = False
    ) -> Iterator[CameraFrames]:
        """Yields frames with start <= arrival < end in order of arrival, in chunks of at most 1 s of arrival time.

        Args:
            start_ns: First arrival [ns]; None: the log's.
            end_ns: End of the arrivals, exclusive [ns]; None: the log's end.
            nobody: True: also yield frames without a body.

        Raises:
            LogError: The log is damaged beyond recovery.
        """
        self._reading.clear()
        self._remarks = list(dict.fromkeys(note for decoder in self._decoders for note in decoder.notes))
        decoders = {decoder.topic: decoder.fresh_copy() for decoder in self._decoders}
        self._refusals, self.points_seen = [], 0
        cleaner = Cleaner(self.header.cameras, self._options.gap_s, self._reading, nobody=nobody)
        shapes = {camera: plausibility.BodyShape() for camera in self.header.cameras}
        places, order = plausibility.Alternation(), ArrivalOrder()
        for message in self._source.messages(list(decoders), start_ns, end_ns):
            decoder = decoders[message.topic.name]
            try:
                rows = decoder.rows(message)
            except Undecodable:
                self._reading["messages_undecodable"] += 1
                continue
            if decoder.shows_camera_alive:
                cleaner.note_arrival(decoder.cameras[0], message.arrival_ns)
            for row in rows:
                if row.body != NOBODY:
                    shapes[row.camera].add(row.points_m, row.confidence)
                    order.add((message.topic.parse, row.camera, row.body), message.arrival_ns, message.position)
                    places.add(row.camera, row.body, message.arrival_ns, row.points_m)
                chunk = cleaner.add(row, message.arrival_ns)
                if chunk is not None:
                    yield chunk
        chunk = cleaner.flush()
        if chunk is not None:
            yield chunk
        self._remark(cleaner, start_ns, end_ns)
        self.clocks = cleaner.clocks
        self._judge(cleaner, shapes)
        self._refuse(_contradictions(cleaner))
        self._refuse(places.remarks())
        self._refuse(order.remarks(self.header.start_ns))

    def check(self) -> None:
        """Rejects a log whose latest complete pass showed bodies that are certainly not a person.

        Raises:
            LogError: The bodies are not a person; with a remedy.
        """
        if self._refusals:
            raise LogError(f"{self.header.path}: {self._refusals[0]}")

    def _judge(self, cleaner: Cleaner, shapes: dict[str, plausibility.BodyShape]) -> None:
        self.points_seen = cleaner.points.total()
        self.stature_m = {camera: shape.stature_m for camera, shape in shapes.items()}
        self.side_cue = {camera: shape.side_cue for camera, shape in shapes.items()}
        for camera, shape in shapes.items():
            size = plausibility.size_remark(camera, shape.stature_m, self._unit_of(camera))
            if size is not None:
                self._remarks.append(size)
                if shape.certain and plausibility.impossible_size(shape.stature_m):
                    self._refusals.append(size)
            proportion = plausibility.proportion_remark(camera, shape.ratio)
            if proportion is not None and shape.certain:
                self._remarks.append(proportion)
            self._remarks.extend(shape.remarks(camera))
        self._remarks.extend(plausibility.unmeasured_limbs(cleaner.seen))

    def _refuse(self, remarks: Iterator[str]) -> None:
        found = list(remarks)
        self._remarks.extend(found)
        self._refusals.extend(found)

    def _unit_of(self, camera: str) -> str:
        """Returns the setting of the unit of a camera's points."""
        for decoder in self._decoders:
            if camera in decoder.cameras and isinstance(decoder, GenericDecoder):
                unit = decoder.hows[0].unit
                other = "m" if unit == "mm" else "mm"
                return f'would be right, in its [[logs.decoders]]: unit = "{other}", or points in {unit}'
            if camera in decoder.cameras and not isinstance(decoder, OwnDecoder):
                other = "m" if self._options.unit == "mm" else "mm"
                return f"would be right: --set logs.unit={other}, or points in {self._options.unit}"
        return "would be right: points in metres"

    def joints(self, axes: Sequence[str], frames: Sequence[AxisFrame] = ()) -> JointTrack | None:
        """Returns the recorded track of the robot's axes; None if the log has no joint positions.

        Args:
            axes: The robot's joints, from the base on.
            frames: Links at both sides of each axis; a log without joint states is searched for their poses.

        Raises:
            LogError: The joints of the log do not fit the robot.
            SettingsError: ``logs.joint_names`` does not.
        """
        topics = self.joint_states() or self.link_states(axes, frames)
        return self.read_joints(topics, axes).track if topics else None

    def link_states(self, axes: Sequence[str], frames: Sequence[AxisFrame]) -> list[JointTopic]:
        """Returns the robot's axes by the poses of its links, for a log without joint states; none if a link lacks one.

        Args:
            axes: The robot's joints, from the base on.
            frames: Links at both sides of each axis; none: there is nothing to search for.

        Raises:
            LogError: A link turns about another axis than that of the robot.
        """
        names = [topic.name for topic in self.topics if topic.type in TF_TYPES] if frames else []
        defects: Counter[str] = Counter()
        found = joints.read_frames(self._source, names, axes, frames, defects) if names else None
        if found is None:
            return []
        self._track.update(defects)
        return [found]

    def read_joints(self, topics: Sequence[JointTopic], axes: Sequence[str]) -> JointReading:
        """Makes the track of the robot's axes from the result of ``joint_states``; raises as ``joints``."""
        reading = joints.read_track(topics, axes, self._options, str(self.header.path), self._track)
        covered = joints.coverage_remarks(reading, self.header.start_ns, self.header.end_ns)
        told = [
            f"robot joints: from the poses of its links on {topic.name}, each first within half a turn of 0"
            for topic in topics
            if topic.by_links
        ]
        self.joint_notes = (*told, *reading.notes, *covered)
        return reading

    def joint_states(self) -> list[JointTopic]:
        """Returns the joint states of each topic with positions, as stored in the log."""
        self._track.clear()
        self.joint_notes = ()
        return joints.read_topics(self._source, self._joint_topics, self._track)

    @property
    def capsules_topic(self) -> str | None:
        """Topic of the capsules of the recorded robot; None without them."""
        return None if self._capsules is None else self._capsules.topic

    def capsules(self) -> CapsuleTrack | None:
        """Returns the capsules of the recorded robot, in the frame of its base; None without them.

        Raises:
            LogError: The messages do not have the fields of ``logs.robot_capsules``.
        """
        if self._capsules is None:
            return None
        self._track.clear()
        return read_capsules(self._source, self._capsules, self._track)

    def truth(self) -> Iterator[Truth]:
        """Yields the true person in order of time, in chunks of at most 1 s; nothing without ground truth."""
        if self._truth is not None:
            yield from log_files.truth(self._source, self._truth)

    def _remark(self, cleaner: Cleaner, start_ns: int | None, end_ns: int | None) -> None:
        if self._reading["frames_header_stamp_zero"]:
            self._remarks.append("header stamps are zero: arrival times used")
        begin = max(self.header.start_ns, start_ns or self.header.start_ns)
        end = min(self.header.end_ns, end_ns or self.header.end_ns)
        for camera in self.header.cameras:
            if camera not in cleaner.arrivals:
                self._remarks.append(f"camera {camera} is never heard")
                continue
            first, last = cleaner.arrivals[camera]
            if first - begin > _LATE_NS:
                self._remarks.append(f"camera {camera} starts {(first - begin) / 1e9:.2f} s after the log")
            if end - last > _LATE_NS:
                self._remarks.append(f"camera {camera} ends {(end - last) / 1e9:.2f} s before the log")
            self._remarks.extend(_flaws(camera, cleaner, begin))


def _contradictions(cleaner: Cleaner) -> Iterator[str]:
    """Returns a sentence for each camera with many rows that contradict the previous row of the same instant."""
    for (camera, name), count in sorted(cleaner.flaws.items()):
        if name == "frames_contradicting" and count > _CONTRADICTING * cleaner.rows[camera]:
            yield (
                f"camera {camera}: {count} of {cleaner.rows[camera]} rows are of the same body and instant as the row "
                "before, but elsewhere: two bodies or cameras under one name; would be right: ids, frames or topics of "
                "their own"
            )


def _flaws(camera: str, cleaner: Cleaner, begin_ns: int) -> Iterator[str]:
    """Returns remarks on a camera's points and stamps."""
    for name in _TOLD:
        count = cleaner.flaws[(camera, name)]
        if count:
            share = 100.0 * count / (count + cleaner.points[camera])
            shown = "100" if share >= 99.5 else f"{share:.2g}"
            yield f"camera {camera}: {count} {DEFECTS[name]} ({shown} % of its points)"
    yield from clock_remarks(camera, cleaner.clocks[camera], begin_ns, cleaner.flaws[(camera, "frames_out_of_order")])
    longest = cleaner.frozen.get(camera)
    if longest is not None and longest.seconds > _FROZEN_S:
        rows = cleaner.flaws[(camera, "frames_repeated")]
        begin_s = (longest.begin_ns - begin_ns) / 1e9
        yield (
            f"camera {camera} froze: for {longest.seconds:.2f} s from {begin_s:.2f} s on it gave one and the same "
            f"skeleton with new stamps; its {rows} rows that repeat count as silence"
        )
    still = cleaner.trembling.get(camera)
    if still is not None:
        rows = cleaner.flaws[(camera, "frames_trembling")]
        begin_s = (still.begin_ns - begin_ns) / 1e9
        yield (
            f"camera {camera} only trembles: for {still.seconds:.2f} s from {begin_s:.2f} s on no point of the body "
            f"moved by more than {1e3 * STILL_M:g} mm, which is impossible for a person; the {rows} rows "
            f"after the first {STILL_S:g} s count as silence"
        )


def open_log(path: Path, options: Logs = DEFAULT, *, skeletons: bool = True) -> Log:
    """Opens a log.

    Args:
        path: MCAP file, ROS 1 bag, ROS 2 bag (folder or .db3 file).
        options: Options for reading.
        skeletons: True: reject a log without skeletons.

    Raises:
        LogError: The log cannot be read, has no messages, lacks a named topic, or has no skeletons.
    """
    source = open_source(path)
    chosen = choose_decoders(source, options)
    if skeletons and not chosen.decoders:
        raise no_skeletons_error(source, chosen.remarks)
    return Log(source, chosen, options)


def _static_poses(source: LogFiles, chosen: Chosen, options: Logs) -> StaticPoses:
    """Returns the poses of cameras and robot base in /tf_static. Raises LogError if it lacks a frame that is named."""
    given = {"world_frame": options.world_frame, "base_frame": options.base_frame}
    known = {name for link in chosen.static.values() for name in (link.parent, link.child)}
    for setting, frame in given.items():
        if frame is not None and frame.lstrip("/") not in known:
            raise LogError(
                f"{source.path}: logs.{setting}: found {frame!r}; would be right: a frame of /tf_static: "
                f"{', '.join(sorted(known)) or 'it has none'}"
            )
    frames = {camera: frame for decoder in chosen.decoders for camera, frame in decoder.frames.items()}
    return find_poses(chosen.static, frames, options.world_frame, options.base_frame)


def _header(
    source: LogFiles,
    decoders: list[SkeletonDecoder],
    joint_topics: tuple[str, ...],
    truth: str | None,
    poses: StaticPoses,
    *,
    chosen: bool,
) -> Header:
    known = log_files.latched(source)
    seen = [camera for decoder in decoders for camera in decoder.cameras]
    declared = [camera for camera in known.cameras if camera in seen or not chosen]  # a camera may never send
    cameras = tuple(dict.fromkeys([*declared, *seen]))
    # Not the first message: recorders use stamp zero before the clock of a simulation starts.
    used = [*(decoder.topic for decoder in decoders), *joint_topics, *([truth] if truth else [])]
    first = next(source.messages(used), None)
    return Header(
        path=source.path,
        kind=source.kind,
        cameras=cameras,
        T_world_camera=poses.T_world_camera
        | {camera: T for camera, T in known.T_world_camera.items() if camera in cameras},
        task=known.task,
        start_ns=first.arrival_ns if first else source.start_ns,
        end_ns=source.end_ns,
        T_world_base=known.T_world_base if known.T_world_base is not None else poses.T_world_base,
        has_truth=truth is not None,
        joint_topics=joint_topics,
        static_poses=bool(poses.notes) and not known.T_world_camera and known.T_world_base is None,
    )
